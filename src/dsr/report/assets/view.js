// The page of `dsr view`: choices, the surfaces that they show, and what is written about them.

const NAMES = { grey: "grey", photo: "the photo", filled: "grey with filled pixels in colour", depth: "the expected error of the depth", angle: "the expected error of the normal" };
const UNITS = { depth: { factor: 1000, unit: "mm", title: "Expected error of the depth, mm" }, angle: { factor: 1, unit: "degrees", title: "Expected error of the normal, degrees" } };

const TURN = (2 * Math.PI) / 3; // by dragging over the whole stage
const NARROW = 560; // pixels of a stage below which panels are one below another
const HIGHEST = 0.82; // of the window, the height of a stage with panels, as in view.css

class View {
  /** Show the results of the page. */
  constructor(content) {
    this.content = content;
    this.palette = paletteOf(content.colours);
    this.stage = find("#stage");
    this.canvas = find("canvas", this.stage);
    this.scene = new Scene(this.canvas, this.palette, content.tones);
    this.state = { side: "both", colour: "grey", drag: "turn", split: 0.5, light: content.light, doubtful: false, number: -1 };
    find("#viewer").hidden = false;
    find("#stills").hidden = true;
    this.listen();
    this.makeChoice();
    this.setLight(content.light);
    this.setSplit(this.state.split);
    this.set("drag", this.state.drag);
    const named = content.results.findIndex((result) => `#${encodeURIComponent(result.name)}` === location.hash);
    this.show(Math.max(named, 0));
  }

  // What is shown.

  /** Show a result. */
  async show(number) {
    const count = this.content.results.length;
    this.state.number = (number + count) % count;
    const [result, shown] = [this.content.results[this.state.number], this.state.number];
    this.result = result;
    this.stage.setAttribute("aria-busy", "true");
    find(".busy").hidden = false;
    const photo = textOf(`photo-${shown}`);
    const names = ["after", "before"].filter((name) => result[name]);
    const [image, ...grids] = await Promise.all([photo && decodePhoto(photo), ...names.map((name) => decodeGrid(result[name], textOf(`${name}-${shown}`)))]);
    if (this.state.number !== shown) return;
    this.grids = Object.fromEntries(names.map((name, k) => [name, grids[k]]));
    this.scene.setPhoto(image);
    find(".flat").src = photo ? `data:image/jpeg;base64,${photo}` : "";
    this.pose = new Pose(result.pivot);
    this.fitStage();
    this.build();
    this.offer();
    this.describe();
    if (count > 1) history.replaceState(null, "", `#${encodeURIComponent(result.name)}`);
    find(".busy").hidden = true;
    this.stage.removeAttribute("aria-busy");
    this.stage.dataset.shown = String(shown);
    this.refresh();
  }

  /** Build the surfaces as triangles. */
  build() {
    this.triangles = {};
    for (const name of ["before", "after"]) {
      this.scene.dropSurface(name);
      const grid = this.grids[name];
      if (!grid) continue;
      const mesh = buildMesh(grid, name === "after" && this.withDoubtful);
      this.triangles[name] = mesh.corners.length / 3;
      this.scene.setSurface(name, grid, mesh);
    }
    this.showAmounts();
  }

  /** Offer what the result has. */
  offer() {
    const { result, state } = this;
    const has = { grey: true, photo: Boolean(this.scene.photo), depth: Boolean(result.errors), angle: Boolean(result.errors), filled: result.filled > 0 };
    for (const button of findAll("[data-colour]")) button.hidden = !has[button.dataset.colour];
    find(".colours").parentElement.hidden = !has.photo && !has.depth && !has.filled;
    find(".sides").hidden = !result.before;
    find(".doubtful").hidden = !result.doubtful;
    this.set("colour", has[state.colour] ? state.colour : "grey");
    this.set("side", state.side);
    for (const [k, button] of findAll(".strip button").entries()) button.setAttribute("aria-pressed", String(k === state.number));
    find("#result").value = String(state.number);
  }

  /** Give the stage the shape of the photo, or of its panels, not higher than the window allows and not tiny. */
  fitStage() {
    const [width, height] = this.result.after.size;
    this.aspect = width / height;
    const apart = this.state.side === "apart";
    this.columns = apart ? this.columnsOf(this.panels().length) : 1;
    const panels = apart ? this.panels() : [];
    const rows = Math.max(1, Math.ceil(panels.length / this.columns));
    this.stage.style.aspectRatio = `${this.columns * width} / ${rows * height}`;
    this.stage.classList.toggle("stacked", panels.length > 1 && this.columns === 1);
    this.stage.classList.toggle("apart", panels.length > 0);
    const flat = find(".flat");
    flat.hidden = !panels.length || !this.scene.photo;
    flat.style.width = `${100 / this.columns}%`;
    flat.style.height = `${100 / rows}%`;
    const cells = find(".panels");
    cells.hidden = !panels.length;
    cells.style.gridTemplateColumns = `repeat(${this.columns}, 1fr)`;
    cells.replaceChildren(...panels.map(({ name, surface }) => make("div", {}, make("span", { className: "name name-left", textContent: name }), surface && make("span", { className: "spot" }))));
    this.showSpots();
  }

  /** Return in how many columns so many panels are largest; one below another in a narrow window, which scrolls. */
  columnsOf(count) {
    const [across, down] = [this.stage.clientWidth, HIGHEST * innerHeight];
    if (across < NARROW) return 1;
    const sizes = Array.from({ length: count }, (_, k) => Math.min(across / (k + 1), (down / Math.ceil(count / (k + 1))) * this.aspect));
    return 1 + sizes.indexOf(Math.max(...sizes));
  }

  /** Return the panels: the photo, where there is one, the surfaces in the chosen colour, and the result in another. */
  panels() {
    const { colour } = this.state;
    const surfaces = this.sides().map((surface) => ({ name: surface, surface, colour }));
    if (!this.scene.photo) return surfaces;
    const [other, name] = colour === "photo" ? ["grey", "after, in grey"] : ["photo", "after, with the photo"];
    const [photo, second] = [{ name: "photo", surface: null }, { name, surface: "after", colour: other }];
    // In two columns, before is above after.
    return this.columns === 2 ? [photo, ...surfaces.slice(0, -1), second, surfaces.at(-1)] : [photo, ...surfaces, second];
  }

  /** Return the place of a panel, from its upper left corner on, as fractions of the stage. */
  panelBox(number, count) {
    const [width, height] = [1 / this.columns, 1 / Math.ceil(count / this.columns)];
    return [(number % this.columns) * width, Math.floor(number / this.columns) * height, width, height];
  }

  /** Show where the light is over each panel, while dragging moves it. */
  showSpots() {
    const [x, y] = this.state.light;
    for (const spot of findAll(".panels .spot")) {
      spot.hidden = this.state.drag !== "light";
      Object.assign(spot.style, { left: `${50 + 50 * x}%`, top: `${50 + 50 * y}%` });
    }
  }

  /** Whether uncertain parts are shown; what is filled often is uncertain. */
  get withDoubtful() {
    return this.state.doubtful || this.state.colour === "filled";
  }

  set(name, value) {
    const before = this.withDoubtful;
    this.state[name] = value;
    if (this.withDoubtful !== before && this.result?.doubtful && this.triangles) this.build();
    for (const button of findAll(`[data-${name}]`)) button.setAttribute("aria-pressed", String(button.dataset[name] === value));
    const apart = this.state.side === "apart";
    const both = this.sides().length === 2 && !apart;
    find(".divider").hidden = !both;
    find(".name-left").hidden = apart;
    find(".name-left").textContent = this.sides()[0];
    find(".name-right").textContent = this.sides()[1] ?? "";
    find(".name-right").hidden = !both;
    this.stage.classList.toggle("lighting", this.state.drag === "light");
    this.stage.classList.toggle("errors", this.state.colour in UNITS); // the smallest errors are black, holes must not be
    if (name === "colour" || name === "side") this.showScale();
    if (this.grids && (name === "side" || this.state.side === "apart")) this.fitStage();
    this.refresh();
  }

  sides() {
    if (!this.result?.before) return ["after"];
    return ["both", "apart"].includes(this.state.side) ? ["before", "after"] : [this.state.side];
  }

  setLight(light) {
    this.state.light = light;
    showLight(find(".ball"), light, "Light");
    this.showSpots();
    this.refresh();
  }

  setSplit(split) {
    this.state.split = clamp(split, 0, 1);
    const percent = Math.round(100 * this.state.split);
    const divider = find(".divider");
    divider.style.left = `${100 * this.state.split}%`;
    divider.setAttribute("aria-valuenow", String(percent));
    divider.setAttribute("aria-valuetext", `${percent} % before`);
    this.refresh();
  }

  // Drawing.

  /** Draw before the next frame, however often it is asked for. */
  refresh() {
    if (!this.grids || this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    const [first, second] = this.sides();
    const { colour, split, light, side } = this.state;
    const apart = side === "apart";
    const whole = [0, 0, 1, 1];
    let parts = second ? [{ surface: first, colour, view: whole, from: 0, to: split }, { surface: second, colour, view: whole, from: split, to: 1 }] : [{ surface: first, colour, view: whole, from: 0, to: 1 }];
    if (apart) parts = this.panels().map((panel, k, all) => ({ ...panel, view: this.panelBox(k, all.length), from: 0, to: 1 }));
    this.scene.draw(parts, this.pose.uniforms, light, this.aspect);
    this.canvas.setAttribute("aria-label", `Surface of ${this.result.name}, ${second && !apart ? `${first} on the left, ${second} on the right` : this.sides().join(" beside ")}, in ${NAMES[colour]}, ${this.pose.text}, lit ${lightText(light)}`);
  }

  // What is written.

  showAmounts() {
    const lines = ["after", "before"].filter((name) => this.grids[name]).map((name) => {
      const { width, height, size, factor, holes } = this.result[name];
      const reduced = factor > 1 ? `, reduced from ${size[0]} \u00d7 ${size[1]} by ${factor} each way` : "";
      const gaps = holes ? `, ${percent(holes)} holes` : "";
      return `${name === "after" ? "After" : "Before"}: ${(width * height).toLocaleString("en")} vertices (${width} \u00d7 ${height}${reduced}${gaps}), ${this.triangles[name].toLocaleString("en")} triangles, cut at depth steps.`;
    });
    if (this.result.filled) lines.push(`${percent(this.result.filled)} of the result is filled: the input has no depth there.`);
    if (this.result.doubtful) lines.push(`${percent(this.result.doubtful)} of the result is uncertain, and left out as in mesh.glb unless \u201cuncertain parts\u201d is ticked.`);
    find(".amounts").textContent = lines.join(" ");
  }

  describe() {
    const { facts, notes } = this.result;
    find(".facts").replaceChildren(...Object.entries(facts).map(([name, text]) => make("div", {}, make("dt", { textContent: name }), make("dd", { textContent: text }))));
    find(".notes").hidden = !notes.length;
    find(".notes ul").replaceChildren(...notes.map((textContent) => make("li", { textContent })));
  }

  showScale() {
    const about = UNITS[this.state.colour];
    const limits = about && this.result?.errors?.[this.state.colour];
    const filled = this.state.colour === "filled" && this.result?.filled;
    find(".scale").hidden = !limits && !filled;
    for (const part of [".scale-bar", ".ticks"]) find(part).hidden = !limits;
    if (filled) {
      find(".scale-title").textContent = `Orange: filled, where the input has no depth; ${percent(filled)} of the result`;
      find(".scale-note").textContent = "";
    }
    if (!limits) return;
    const [low, high] = [about.factor * limits.low, about.factor * limits.high];
    find(".scale-title").textContent = about.title;
    const bar = find(".scale-bar");
    const stops = Array.from({ length: 17 }, (_, k) => 1 + Math.round((254 * k) / 16)).map((k) => `rgb(${this.palette.slice(4 * k, 4 * k + 3).join(" ")})`);
    bar.style.background = `linear-gradient(to right, ${stops.join(", ")})`;
    bar.setAttribute("aria-label", `Colours from ${short(low)} ${about.unit}, dark, to ${short(high)} ${about.unit}, bright`);
    find(".ticks").replaceChildren(...ticksOf(low, high).map((value, k, all) => {
      const tick = make("span", { textContent: `${k === 0 ? "\u2264 " : k === all.length - 1 ? "\u2265 " : ""}${short(value)}` });
      tick.style.left = `${(100 * Math.log(value / low)) / Math.log(high / low)}%`;
      return tick;
    }));
    const before = this.sides().includes("before") ? "The input has no expected errors and stays grey." : "";
    find(".scale-note").textContent = before;
  }

  // Choices.

  makeChoice() {
    const { title, notes, results } = this.content;
    find(".lead").textContent = notes.join(" ");
    find(".lead").hidden = !notes.length;
    document.title = title;
    if (results.length < 2) return;
    find(".choice").hidden = false;
    find(".strip").hidden = false;
    options(find("#result"), results.map(({ name }, k) => [String(k), name]));
    find(".strip").replaceChildren(...results.map(({ name, thumb }, k) => make("button", { type: "button", title: name, onclick: () => this.show(k) },
      make("img", { src: thumb, alt: "" }), make("span", { className: "text", textContent: name }))));
  }

  listen() {
    for (const name of ["side", "colour", "drag"]) {
      for (const button of findAll(`[data-${name}]`)) button.addEventListener("click", () => this.set(name, button.dataset[name]));
    }
    const pixels = () => Math.min(this.stage.clientWidth, this.stage.clientHeight);
    const panelOf = (event) => {
      const box = this.stage.getBoundingClientRect();
      const count = this.state.side === "apart" ? this.panels().length : 1;
      const [columns, rows] = count > 1 ? [this.columns, Math.ceil(count / this.columns)] : [1, 1];
      const cell = (along, cells) => clamp(Math.floor(along * cells), 0, cells - 1);
      const number = cell((event.clientX - box.left) / box.width, columns) + columns * cell((event.clientY - box.top) / box.height, rows);
      const [x, y, width, height] = count > 1 ? this.panelBox(number, count) : [0, 0, 1, 1];
      return { left: box.left + x * box.width, top: box.top + y * box.height, width: width * box.width, height: height * box.height };
    };
    const actions = {
      turn: (right, down) => this.look((pose) => pose.turnBy((TURN * right) / pixels(), (TURN * down) / pixels())),
      move: (right, down) => this.look((pose) => {
        const { lens, width } = this.grids.after;
        const across = Math.min(this.stage.clientWidth, this.stage.clientHeight * this.aspect);
        pose.moveBy(right / across, down / across, lens, width);
      }),
      zoom: (factor) => this.look((pose) => pose.zoomBy(factor)),
      light: (event) => this.setLight(lightIn(event, panelOf(event))),
      split: (place) => this.setSplit(place),
      mode: () => this.state.drag,
    };
    this.actions = actions;
    new Pointers(this.stage, actions);
    listenToBall(find(".ball"), () => this.state.light, (light) => this.setLight(light));
    find(".zoom-in").addEventListener("click", () => actions.zoom(1.25));
    find(".zoom-out").addEventListener("click", () => actions.zoom(0.8));
    find(".zoom-reset").addEventListener("click", () => this.look((pose) => pose.reset()));
    find(".divider").addEventListener("keydown", (event) => this.dividerKey(event));
    find(".doubtful input").addEventListener("change", (event) => { this.state.doubtful = event.target.checked; this.build(); this.refresh(); });
    find(".previous").addEventListener("click", () => this.show(this.state.number - 1));
    find(".next").addEventListener("click", () => this.show(this.state.number + 1));
    find("#result").addEventListener("change", (event) => this.show(Number(event.target.value)));
    this.stage.addEventListener("keydown", (event) => this.stageKey(event));
    document.addEventListener("keydown", (event) => this.key(event));
    this.canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); fall("The browser has taken the graphics away; load the page again to turn the surface."); });
    new ResizeObserver(() => { if (this.grids) this.fitStage(); this.refresh(); }).observe(this.stage);
  }

  look(change) {
    if (!this.pose) return;
    change(this.pose);
    this.refresh();
  }

  dividerKey(event) {
    const step = event.shiftKey ? 0.1 : 0.02;
    const by = { ArrowLeft: -step, ArrowDown: -step, ArrowRight: step, ArrowUp: step, Home: -1, End: 1 }[event.key];
    if (by === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    this.setSplit(this.state.split + by);
  }

  /** Arrow keys while the stage has the focus. */
  stageKey(event) {
    const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!by || event.target !== this.stage) return;
    event.preventDefault();
    if (event.shiftKey) this.actions.move(24 * by[0], 24 * by[1]);
    else this.look((pose) => pose.turnBy(STEP * by[0], STEP * by[1]));
  }

  /** Keys of the whole page, while nobody types. */
  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select, textarea")) return;
    const press = (selector) => () => { const button = find(selector); if (button && !button.hidden && !button.closest("[hidden]")) button.click(); };
    const actions = {
      1: press("[data-side=before]"), 2: press("[data-side=both]"), 3: press("[data-side=after]"), 4: press("[data-side=apart]"),
      g: press("[data-colour=grey]"), p: press("[data-colour=photo]"), d: press("[data-colour=depth]"), n: press("[data-colour=angle]"), f: press("[data-colour=filled]"),
      t: press("[data-drag=turn]"), l: press("[data-drag=light]"), ",": press(".previous"), ".": press(".next"),
      "+": press(".zoom-in"), "=": press(".zoom-in"), "-": press(".zoom-out"), 0: press(".zoom-reset"),
    };
    actions[event.key.toLowerCase()]?.();
  }
}

/** Return a number with two digits that count. */
const short = (value) => String(Number(value.toPrecision(2)));
const percent = (share) => `${share < 0.001 ? "under 0.1" : (100 * share).toFixed(1)} %`;

/** Return the ends of a logarithmic scale and the round numbers between them that are not too near to an end. */
function ticksOf(low, high) {
  const round = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
    for (const digit of [1, 2, 5]) round.push(digit * 10 ** power);
  }
  const apart = (high / low) ** 0.1;
  return [low, ...round.filter((value) => value > low * apart && value < high / apart), high];
}

/** Return a JPEG of base64 text as a picture. */
async function decodePhoto(text) {
  return createImageBitmap(new Blob([decode(text)], { type: "image/jpeg" }));
}

/** Show the pictures in place of the surface, and say why. */
function fall(reason) {
  find("#viewer").hidden = true;
  find("#stills").hidden = false;
  const problem = find(".problem[role=alert]");
  problem.textContent = reason;
  problem.hidden = false;
}

function start() {
  try {
    if (typeof DecompressionStream === "undefined") throw new Error("no DecompressionStream");
    new View(block("content"));
  } catch (error) {
    fall(`The surface cannot be turned in this browser (${error.message}); here it is as pictures. A current Firefox, Chrome, Edge or Safari with WebGL 2 shows it.`);
  }
}

addEventListener("unhandledrejection", (event) => { fall(`The surface could not be read (${event.reason?.message}).`); event.preventDefault(); });
start();
