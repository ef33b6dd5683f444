// Small helpers. All text goes through textContent, so a name can hold anything.

/** Return a new element with properties, attributes (`aria-...`, `data-...`, `role`) and children. */
function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-") || name === "role") element.setAttribute(name, value);
    else element[name] = value;
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

const find = (selector, root = document) => root.querySelector(selector);
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));
const plural = (count, one, many = `${one}s`) => `${count} ${count === 1 ? one : many}`;

/** Return the content of a JSON block of the page. */
const block = (id) => JSON.parse(document.getElementById(id).textContent);

/** Return a number with a minus sign and as many digits as asked for. */
const number = (value, digits) => value.toFixed(digits).replace(/^-(?=.*[1-9])/, "\u2212").replace(/^-/, "");
const signed = (value, digits) => (Number(value.toFixed(digits)) > 0 ? "+" : "") + number(value, digits);

/** Fill a select with [value, text] pairs. */
function options(select, pairs, chosen) {
  select.replaceChildren(...pairs.map(([value, text]) => make("option", { value, textContent: text })));
  if (chosen !== undefined) select.value = chosen;
}

/** Return what a problem is called. */
const problemName = (problem) => `${problem.dataset}, \u00d7${problem.scale}, ${problem.downsampling}`;
