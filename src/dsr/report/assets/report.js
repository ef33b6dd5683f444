// The page: summary, settings, and the start of everything.

/** Fill the summary. */
function showSummary(data) {
  document.querySelectorAll(".title").forEach((each) => { each.textContent = data.title; });
  const runs = plural(data.runs.length, "run");
  find("#summary .lead").textContent =
    `Guided depth super-resolution, judged by depth, normals (RMSE_v) and renderings (the worst of four lights). ${runs}; ${directions(data.metrics)}.`;
  const distinct = (of) => [...new Set(data.problems.map(of))];
  const scenes = new Set(data.problems.flatMap((problem) => problem.scenes.map((scene) => JSON.stringify([problem.dataset, scene]))));
  const facts = [
    ["Data", distinct((problem) => problem.dataset).join(", ")],
    ["Scenes", String(scenes.size)],
    ["Scale", distinct((problem) => problem.scale).map((scale) => `\u00d7${scale}`).join(", ")],
    ["Downsampling", distinct((problem) => problem.downsampling).join(", ")],
    ["Methods", data.methods.join(", ")],
    [data.seeds.length === 1 ? "Seed" : "Seeds", data.seeds.join(", ")],
  ];
  find(".facts").append(...facts.map(([name, value]) => make("div", {}, make("dt", { textContent: name }), make("dd", { textContent: value }))));
  find(".overview").append(...data.problems.map((problem) => overview(problem, data.metrics.filter((metric) => metric.family === data.metrics[0].family))));
  if (data.notes.length) {
    find(".notes").append(make("h3", { textContent: "Notes" }), make("ul", {}, ...data.notes.map((note) => make("li", { textContent: note }))));
  }
  if (data.links.length) {
    const anchors = data.links.map((link) => make("a", { href: link.address, textContent: link.name }));
    find(".links").append(make("h3", { textContent: "Files beside this page" }), make("p", {}, ...anchors));
  }
}

/** Return which way is better. */
function directions(metrics) {
  const higher = metrics.filter((metric) => metric.higher).map((metric) => metric.name);
  if (!higher.length) return "lower is better throughout";
  if (higher.length > 4 && higher.length < metrics.length) return "lower is better, but where a table says higher";
  return higher.length === metrics.length ? "higher is better throughout" : `lower is better, of ${higher.join(", ")} higher`;
}

/** Return bars of each metric's means. */
function overview(problem, metrics) {
  const charts = metrics.map((metric) => {
    const rows = problem.means.filter((row) => row.values[metric.id]);
    if (!rows.length) return null;
    const largest = Math.max(...rows.map((row) => row.values[metric.id][0]), 1e-12);
    const [best] = ranked(problem.means, metric);
    const items = rows.map((row) => {
      const value = row.values[metric.id][0];
      const fill = make("span", { className: "fill" });
      fill.style.width = `${(100 * value) / largest}%`;
      return make("li", { className: Number(value.toFixed(metric.digits)) === best ? "best" : "" },
        make("span", { className: "label", textContent: row.method, title: row.method }),
        make("span", { className: "track" }, fill),
        make("span", { className: "value", textContent: number(value, metric.digits) }));
    });
    return make("div", { className: "chart" }, make("h4", {}, `${metric.name} `, make("small", { textContent: metric.unit })), make("ul", {}, ...items));
  });
  return make("section", {},
    make("h3", {}, problemName(problem), make("small", { textContent: ` \u00b7 ${meanOver(problem)}` })),
    make("div", { className: "charts" }, ...charts));
}

/** Fill the section of settings: of each run its keys and values; what differs between runs is bold. */
function showRuns(data) {
  const differing = (part) => {
    const keys = new Set(data.runs.flatMap((run) => Object.keys(run[part])));
    return new Set([...keys].filter((key) => new Set(data.runs.map((run) => run[part][key])).size > 1));
  };
  const differs = { settings: differing("settings"), versions: differing("versions") };
  const pairs = (run, part, heading) => {
    const entries = Object.entries(run[part]);
    if (!entries.length) return null;
    const rows = entries.map(([key, value]) => make("tr", { className: differs[part].has(key) ? "differs" : "" }, make("td", { textContent: key }), make("td", { textContent: value })));
    return make("div", {}, make("h4", { textContent: heading }), make("table", {}, make("tbody", {}, ...rows)));
  };
  const home = find("#runs .runs");
  if (data.runs.length > 1) home.append(make("p", { className: "lead", textContent: "What differs between the runs is bold." }));
  for (const run of data.runs) {
    const about = `${problemName(run)}, seed ${run.seed} \u00b7 ${run.folder}`;
    home.append(make("details", {},
      make("summary", {}, `${run.label} `, make("small", { textContent: about })),
      make("div", { className: "pairs" }, pairs(run, "settings", "Settings"), pairs(run, "versions", "Environment"))));
  }
}

/** Open everything that is folded while the page is printed. */
function unfoldForPrint() {
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("#tables details:not([open])")];
    folded.forEach((details) => { details.open = true; });
  });
  addEventListener("afterprint", () => folded.forEach((details) => { details.open = false; }));
}

const data = block("data");
showSummary(data);
const viewer = data.scenes.length ? new Viewer(data) : null;
if (viewer === null) document.querySelectorAll("[data-needs=scenes]").forEach((each) => { each.hidden = true; });
showTables(data, data.scenes, (problem, scene, method) => viewer.open(problem, scene, method));
showCalibration(data);
showTimes(data);
showRuns(data);
unfoldForPrint();
