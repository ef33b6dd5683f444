// Tables that sort, by mouse and by keyboard; what is missing stands at the end whichever way.

const DASH = "\u2013";
const plural = (count, one, many = `${one}s`) => `${count} ${count === 1 ? one : many}`;

/** Return a number with a minus sign and as many digits as asked for. */
const number = (value, digits) => value.toFixed(digits).replace(/^-(?=.*[1-9])/, "\u2212").replace(/^-/, "");
const signed = (value, digits) => (Number(value.toFixed(digits)) > 0 ? "+" : "") + number(value, digits);

/** Return what a problem is called. */
const problemName = (problem) => `${problem.dataset}, \u00d7${problem.scale}, ${problem.downsampling}`;

/**
 * Return a sortable table.
 * columns: {title, unit, word, value(row), cell(row)}; rows: anything. `visible(row)` filters; `foot` stays below.
 */
function sortable(columns, rows, { caption, visible = () => true, foot } = {}) {
  const state = { column: null, down: false };
  const body = make("tbody");
  const headers = columns.map((column) => {
    const header = make("th", { scope: "col", tabIndex: 0, "aria-sort": "none", className: column.word ? "word" : "" }, make("span", { className: "heading", textContent: column.title }));
    if (column.unit) header.append(make("small", { textContent: column.unit }));
    const act = () => sortBy(column);
    header.addEventListener("click", act);
    header.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      act();
    });
    return header;
  });

  function sortBy(column) {
    if (state.column === column && state.down) state.column = null;
    else {
      state.down = state.column === column;
      state.column = column;
    }
    columns.forEach((each, k) => {
      const sorted = each === state.column ? (state.down ? "descending" : "ascending") : "none";
      headers[k].setAttribute("aria-sort", sorted);
    });
    refresh();
  }

  function refresh() {
    const shown = rows.filter(visible);
    if (state.column !== null) {
      const keys = new Map(shown.map((row) => [row, state.column.value(row)]));
      shown.sort((a, b) => compare(keys.get(a), keys.get(b), state.down));
    }
    body.replaceChildren(...shown.map((row) => make("tr", {}, ...columns.map((column) => {
      const content = column.cell ? column.cell(row) : column.value(row);
      return make("td", { className: column.word ? "word" : "" }, content ?? missing());
    }))));
  }

  const last = foot ? make("tfoot", {}, make("tr", {}, ...columns.map((column, k) => make("td", { className: column.word ? "word" : "" }, foot[k] ?? missing())))) : null;
  const table = make("table", {}, caption ? make("caption", { textContent: caption, className: "skip" }) : null, make("thead", {}, make("tr", {}, ...headers)), body, last);
  refresh();
  return { element: make("div", { className: "box", tabIndex: -1 }, table), refresh };
}

const isMissing = (value) => value === null || value === undefined || Number.isNaN(value);
const missing = () => make("span", { className: "missing", textContent: DASH, title: "missing" });

/** Order two values, numbers by size and words by the alphabet; what is missing comes last whichever way. */
function compare(a, b, down) {
  if (isMissing(a) || isMissing(b)) return Number(isMissing(a)) - Number(isMissing(b));
  const order = typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b;
  return down ? -order : order;
}

/** Return over how many scenes the means of a problem are: those that all methods with a metric have. */
function meanOver(problem) {
  const total = problem.scenes.length;
  const counts = problem.means.flatMap((row) => [...Object.keys(row.values), ...Object.keys(row.counts)].map((id) => row.counts[id] ?? total));
  const [least, most] = [Math.min(total, ...counts), counts.length ? Math.max(...counts) : total];
  if (least === total) return `mean over ${plural(total, "scene")}`;
  if (most === 0) return `no mean: the methods have none of the ${plural(total, "scene")} in common`;
  return `mean over the ${least === most ? most : `${least} to ${most}`} of ${plural(total, "scene")} that all methods have`;
}

/** Return the two best shown values of a column: what is shown alike shares its place. */
function ranked(rows, metric) {
  const shown = rows.filter((row) => row.values[metric.id]).map((row) => Number(row.values[metric.id][0].toFixed(metric.digits)));
  const places = [...new Set(shown)].sort((a, b) => (metric.higher ? b - a : a - b));
  return shown.length > 1 ? places.slice(0, 2) : [];
}

/** Return a score's cell: the mean, its spread, how it ranks, how many scenes it lacks, and the published value. */
function scoreCell(row, metric, places, total, published) {
  const values = row.values[metric.id];
  const paper = row.paper[metric.id];
  const cell = make("span");
  if (values) {
    const text = number(values[0], metric.digits);
    const place = places.indexOf(Number(values[0].toFixed(metric.digits)));
    cell.append(make("span", { textContent: text, className: ["best", "second"][place] ?? "" }));
    if (values.length > 1) cell.append(make("small", { textContent: ` \u00b1 ${number(values[1], metric.digits)}` }));
  } else cell.append(missing());
  if (row.counts && metric.id in row.counts) {
    cell.append(make("small", { textContent: ` (${row.counts[metric.id]} of ${total})`, title: "over the scenes that all methods have" }));
  }
  if (published) {
    const text = paper === undefined ? DASH : number(paper, paperDigits(paper, metric));
    cell.append(make("span", { className: "paper", textContent: text }));
  }
  return cell;
}

/** Return with how many digits the paper's value is shown: those that it has. */
const paperDigits = (value, metric) => Math.min(metric.digits, (String(value).split(".")[1] ?? "").length);

/** Return the columns that say what a row is; some have cells of their own. */
const factColumns = (facts, cells = {}) => facts.map(({ name, word }) => (
  { title: name[0].toUpperCase() + name.slice(1), unit: "\u00a0", word, value: (row) => row[name], cell: cells[name] }));

/** Return the columns of the metrics. */
function metricColumns(metrics, places, total, options) {
  return metrics.map((metric) => ({
    title: metric.higher ? `${metric.name} \u2191` : metric.name,
    unit: metric.unit || "\u00a0",
    value: (row) => row.values[metric.id]?.[0],
    cell: (row) => scoreCell(row, metric, places(row, metric), total, options.published),
  }));
}

/** Return the standings of the methods over all settings; a click on one shows it, where it has pictures. */
function standingsTable(data, entries, open) {
  const total = data.problems.length;
  const shown = (method) => entries.find((entry) => data.problems[entry.problem].methods.includes(method));
  const rows = data.standings.map((row, index) => ({ ...row, place: index + 1, paper: {} }));
  const places = new Map(data.metrics.map((metric) => [metric.id, ranked(rows, metric)]));
  const button = (method) => {
    const entry = shown(method);
    return entry ? make("button", { type: "button", className: "go", textContent: method, title: "show its surfaces", onclick: () => open(entry.problem, entry.name, method) }) : method;
  };
  const columns = [
    { title: "Place", unit: "\u00a0", value: (row) => row.place },
    { title: "Method", unit: "\u00a0", word: true, value: (row) => row.method, cell: (row) => button(row.method) },
    { title: "Mean rank", unit: "\u00a0", value: (row) => row.rank, cell: (row) => number(row.rank, 2) },
    { title: "Settings", unit: `of ${total}`, value: (row) => row.settings },
    ...metricColumns(data.metrics.filter((metric) => rows.some((row) => row.values[metric.id])), (_, metric) => places.get(metric.id), 0, { published: false }),
  ];
  return make("div", { className: "block" },
    make("h3", {}, "Leaderboard", make("small", { textContent: ` \u00b7 ${plural(total, "setting")}` })),
    sortable(columns, rows, { caption: "Leaderboard" }).element,
    make("p", { className: "foot", textContent: "Mean rank: of each metric in each setting, averaged within families of metrics, then over families, then over settings, over the metrics and scenes that all methods have. Values are means over all settings." }));
}

/** Fill the section of tables; `open(problem, scene)` shows a scene, where it has pictures. */
function showTables(data, entries, open) {
  const options = { published: false, scene: "", method: "" };
  const matches = (text, part) => text.toLowerCase().includes(part.toLowerCase());
  const all = [];
  const home = find("#tables .tables");
  if (data.standings.length > 1) home.append(standingsTable(data, entries, open));
  const families = [...new Set(data.metrics.map((metric) => metric.family))];
  const both = (problem, index, family) => {
    const metrics = data.metrics.filter((metric) => metric.family === family);
    const name = problemName(problem) + (family === families[0] ? "" : `, ${family}`);
    const meanPlaces = new Map(metrics.map((metric) => [metric.id, ranked(problem.means, metric)]));
    const means = sortable(
      [
        ...factColumns(problem.facts.filter(({ name }) => name !== "scene")),
        ...metricColumns(metrics, (_, metric) => meanPlaces.get(metric.id), problem.scenes.length, options),
      ],
      problem.means,
      { caption: `${name}: means`, visible: (row) => matches(row.method, options.method) },
    );
    const places = new Map();
    for (const scene of problem.scenes) {
      const own = problem.rows.filter((row) => row.scene === scene);
      places.set(scene, new Map(metrics.map((metric) => [metric.id, ranked(own, metric)])));
    }
    const has = new Set(entries.filter((entry) => entry.problem === index).map((entry) => entry.name));
    const scenes = sortable(
      [
        ...factColumns(problem.facts, { scene: (row) => has.has(row.scene)
          ? make("button", { type: "button", className: "go", textContent: row.scene, title: "show its pictures", onclick: () => open(index, row.scene, row.method) })
          : row.scene }),
        ...metricColumns(metrics, (row, metric) => places.get(row.scene).get(metric.id), 0, options),
      ],
      problem.rows,
      { caption: `${name}: scenes`, visible: (row) => matches(row.method, options.method) && matches(row.scene, options.scene) },
    );
    all.push(means, scenes);
    const details = make("details", { open: data.problems.length === 1 },
      make("summary", {}, "Scene by scene ", make("small", { textContent: `${plural(problem.scenes.length, "scene")}, ${plural(problem.methods.length, "method")}` })),
      scenes.element);
    return [means.element, details];
  };
  data.problems.forEach((problem, index) => {
    const seeds = Math.max(...problem.means.map((row) => row.seeds));
    const used = families.filter((family) => data.metrics.some((metric) => metric.family === family && problem.rows.some((row) => row.values[metric.id])));
    const others = used.slice(1).map((family) => make("details", {}, make("summary", {}, family[0].toUpperCase() + family.slice(1)), ...both(problem, index, family)));
    home.append(make("div", { className: "block" },
      make("h3", {}, problemName(problem), make("small", { textContent: ` \u00b7 ${meanOver(problem)}${seeds > 1 ? `, mean \u00b1 standard deviation over up to ${seeds} seeds` : ""}` })),
      ...(used.length ? both(problem, index, used[0]) : []), ...others));
  });
  const foot = make("p", { className: "foot", hidden: true, textContent: "Below ours, the published values." });
  home.append(foot);
  const refresh = () => all.forEach((table) => table.refresh());
  find(".filter-scene").addEventListener("input", (event) => {
    options.scene = event.target.value;
    if (options.scene) home.querySelectorAll("details").forEach((details) => { details.open = true; });
    refresh();
  });
  find(".filter-method").addEventListener("input", (event) => { options.method = event.target.value; refresh(); });
  const any = data.problems.some((problem) => [...problem.rows, ...problem.means].some((row) => Object.keys(row.paper).length));
  find(".show-published").parentElement.hidden = !any;
  find(".show-published").addEventListener("change", (event) => {
    options.published = event.target.checked;
    foot.hidden = !options.published;
    refresh();
  });
}

/** Fill the section of expected errors, which is hidden where no method has any. */
function showCalibration(data) {
  const KINDS = { depth: "depth", angle: "normal" };
  const percent = (value) => (isMissing(value) ? null : `${number(100 * value, 1)} %`);
  const shown = data.problems.filter((problem) => problem.calibration.length);
  find("#calibration").hidden = find("nav [href='#calibration']").hidden = !shown.length;
  for (const problem of shown) {
    const rows = problem.calibration.flatMap((row) => Object.entries(KINDS).map(([kind, text]) => ({ ...row[kind], text, method: row.method, scenes: row.scenes })));
    const deciles = rows[0].ratios.map((_, k) => ({
      title: String(k + 1), unit: k === 0 ? "smallest" : k === rows[0].ratios.length - 1 ? "largest" : "\u00a0",
      value: (row) => row.ratios[k], cell: (row) => (isMissing(row.ratios[k]) ? null : number(row.ratios[k], 2)),
    }));
    const columns = [
      { title: "Method", unit: "\u00a0", word: true, value: (row) => row.method },
      { title: "Error", unit: "of the", word: true, value: (row) => row.text },
      ...deciles,
      { title: "Squared error", unit: "in 80 % of the pixels", value: (row) => row.share, cell: (row) => percent(row.share) },
      { title: "Least", unit: "possible", value: (row) => row.least, cell: (row) => percent(row.least) },
    ];
    const table = sortable(columns, rows, { caption: `${problemName(problem)}: measured over expected errors` });
    const counts = [...new Set(rows.map((row) => row.scenes))];
    find("#calibration .calibrations").append(make("div", { className: "block" },
      make("h3", {}, problemName(problem), make("small", { textContent: ` \u00b7 over ${counts.length === 1 ? plural(counts[0], "scene") : `${Math.min(...counts)} to ${Math.max(...counts)} scenes`}` })),
      table.element));
  }
}

/** Fill the section of times. */
function showTimes(data) {
  const home = find("#times .times");
  for (const problem of data.problems) {
    const timed = problem.methods.filter((method) => Object.keys(problem.seconds[method]).length);
    if (!timed.length) continue;
    const show = (seconds) => (isMissing(seconds) ? null : number(seconds, seconds < 0.0995 ? 3 : seconds < 9.95 ? 2 : 1));
    const scenes = [...new Set(timed.flatMap((method) => Object.keys(problem.seconds[method])))];
    const of = (method, scene) => problem.seconds[method][scene];
    const shared = scenes.filter((scene) => timed.every((method) => !isMissing(of(method, scene))));
    const mean = (method) => (shared.length ? shared.reduce((sum, scene) => sum + of(method, scene), 0) / shared.length : null);
    const columns = [
      { title: "Scene", word: true, value: (row) => row.scene },
      ...timed.map((method) => ({ title: method, value: (row) => of(method, row.scene), cell: (row) => show(of(method, row.scene)) })),
    ];
    const foot = [shared.length < scenes.length ? `mean over ${shared.length} of ${scenes.length} scenes` : "mean", ...timed.map((method) => show(mean(method)))];
    const table = sortable(columns, scenes.map((scene) => ({ scene })), { caption: `${problemName(problem)}: seconds`, foot });
    home.append(make("div", { className: "block" }, make("h3", { textContent: problemName(problem) }), table.element));
  }
}
