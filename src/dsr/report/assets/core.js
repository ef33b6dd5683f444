// What the pages of `dsr report` and `dsr view` share: elements, embedded data, colours, the light, and two fingers.

const find = (selector, root = document) => root.querySelector(selector);
const findAll = (selector, root = document) => [...root.querySelectorAll(selector)];
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/**
 * Return a new element with properties, attributes (`aria-...`, `data-...`, `role`) and children. All text is text, so
 * a name can hold anything.
 */
function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-") || name === "role") element.setAttribute(name, value);
    else element[name] = value;
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Fill a select with [value, text] pairs. */
function options(select, pairs, chosen) {
  select.replaceChildren(...pairs.map(([value, text]) => make("option", { value, textContent: text })));
  if (chosen !== undefined) select.value = chosen;
}

// Data in the page.

/** Return the text of a block of data, null if there is none. */
const textOf = (id) => document.getElementById(id)?.textContent ?? null;

/** Return the content of a JSON block. */
const block = (id) => JSON.parse(textOf(id));

/** Return the bytes of base64 text. */
const decode = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

/** Return the colours of hexadecimal digits as bytes: red, green, blue, 255. */
const paletteOf = (digits) => Uint8Array.from(digits.match(/.{6}/g).flatMap((colour) => [...colour.match(/../g).map((pair) => parseInt(pair, 16)), 255]));

// The light: a unit vector towards it in the camera frame, x right, y down, z forward.

const degreesOf = (value) => Math.round((Math.asin(clamp(value, -1, 1)) * 180) / Math.PI);

/** Return the light over a place of the half sphere towards the viewer, -1 to 1 both ways. */
function lightOver(x, y) {
  const shrink = Math.min(1, 0.98 / Math.hypot(x, y));
  const [across, down] = shrink < 1 ? [x * shrink, y * shrink] : [x, y];
  return [across, down, -Math.sqrt(1 - across * across - down * down)];
}

/** Return the light over the place of an event in a box, the whole of which is the half sphere. */
const lightIn = (event, box) => lightOver((2 * (event.clientX - box.left)) / box.width - 1, (2 * (event.clientY - box.top)) / box.height - 1);

/** Return the light over the place of an event in an element. */
const lightAt = (event, element) => lightIn(event, element.getBoundingClientRect());

/** Return where a light comes from, in words. */
function lightText([x, y]) {
  const part = (degrees, low, high) => (degrees === 0 ? [] : [`${Math.abs(degrees)}\u00b0 ${degrees < 0 ? low : high}`]);
  const parts = [...part(degreesOf(x), "left", "right"), ...part(degreesOf(y), "up", "down")];
  return parts.length ? `from ${parts.join(", ")}` : "from the viewer";
}

/** Show a light on its sphere. */
function showLight(ball, light, name) {
  const [x, y] = [50 + 50 * light[0], 50 + 50 * light[1]];
  ball.style.background = `radial-gradient(circle at ${x}% ${y}%, #f2f2f2, #8c8c8c 45%, #1c1c1c)`;
  Object.assign(find(".spot", ball).style, { left: `${x}%`, top: `${y}%` });
  ball.setAttribute("aria-valuenow", String(degreesOf(light[0])));
  ball.setAttribute("aria-valuetext", lightText(light));
  ball.title = `${name} ${lightText(light)}; drag to move it`;
}

/** Let a sphere move the light: `current()` returns it, `set(light)` takes another. */
function listenToBall(ball, current, set) {
  const point = (event) => { if (event.buttons) set(lightAt(event, ball)); };
  ball.addEventListener("pointerdown", (event) => { ball.setPointerCapture(event.pointerId); point(event); });
  ball.addEventListener("pointermove", point);
  ball.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!by) return;
    event.preventDefault();
    const [x, y] = current();
    set(lightOver(x + (Math.PI / 60) * by[0], y + (Math.PI / 60) * by[1]));
  });
}

// Zoom.

/** Return the factor by which the wheel zooms. */
const wheelFactor = (event) => Math.exp(-clamp(event.deltaY, -100, 100) / (event.ctrlKey ? 120 : 400));

/** Return what two fingers do, one of which was elsewhere before: the factor, its centre and the shift, in pixels. */
function pinchOf(fingers, id, before) {
  const [other] = [...fingers].filter(([key]) => key !== id).map(([, finger]) => finger);
  const finger = fingers.get(id);
  const apart = (a) => Math.max(Math.hypot(a.x - other.x, a.y - other.y), 1);
  return {
    factor: apart(finger) / apart(before),
    centre: [(finger.x + other.x) / 2, (finger.y + other.y) / 2],
    shift: [(finger.x - before.x) / 2, (finger.y - before.y) / 2],
  };
}
