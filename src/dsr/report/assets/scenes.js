// The viewer of scenes: two pictures with a divider, lights, zoom, thumbnails, scores and error maps.

const VIEWS = [
  ["shade", "Rendering"], ["depth", "Depth"],
  ["error", "Depth error"], ["expectedError", "expected", "Expected error of the depth"],
  ["angle", "Normal error"], ["expectedAngle", "expected", "Expected error of the normal"],
];
const PHOTO = "photo";
const MOST_ZOOM = 32;

class Viewer {
  constructor(data) {
    this.data = data;
    this.lights = Object.keys(data.lights);
    this.root = find("#scenes");
    this.root.hidden = false;
    this.colours = Object.fromEntries(Object.entries(data.colours).map(([name, digits]) => [name, packed(paletteOf(digits))]));
    [this.hole] = packed(paletteOf(data.hole.slice(1)));
    this.state = { entry: data.scenes[0], left: null, right: null, view: "shade", light: null, free: data.free, split: 50, zoom: 1, x: 0, y: 0, about: null };
    this.stage = find(".stage", this.root);
    this.divider = find(".divider", this.root);
    this.canvases = { left: find(".pane-left canvas", this.root), right: find(".pane-right canvas", this.root) };
    this.fingers = new Map();
    this.makeChoices();
    this.listen();
    this.setLight(this.lights[0]);
    this.setSplit(50);
    this.restore();
  }

  // What can be chosen.

  makeChoices() {
    const problems = [...new Set(this.data.scenes.map((entry) => entry.problem))];
    options(find(".problem", this.root), problems.map((k) => [k, problemName(this.data.problems[k])]));
    find(".problem", this.root).addEventListener("change", (event) => {
      const own = this.entriesOf(Number(event.target.value));
      this.show(own.find((entry) => entry.name === this.state.entry.name) ?? own[0]);
    });
    find(".scene", this.root).addEventListener("change", (event) => this.show(this.data.scenes[Number(event.target.value)]));
    find(".previous", this.root).addEventListener("click", () => this.step(-1));
    find(".next", this.root).addEventListener("click", () => this.step(1));
    for (const side of ["left", "right"]) {
      find(`.${side}`, this.root).addEventListener("change", (event) => this.setSide(side, event.target.value));
    }
    find(".swap", this.root).addEventListener("click", () => this.swap());
    this.viewButtons = VIEWS.map(([name, text, title]) => make("button", { type: "button", textContent: text, "data-view": name, onclick: () => this.setView(name), ...(title && { title, "aria-label": title }) }));
    find(".views", this.root).append(...this.viewButtons);
    this.lightButtons = [...this.lights, "free"].map((name, k) => make("button", {
      type: "button", textContent: name, "data-light": name, title: name === "free" ? "A light that follows the pointer (F)" : `Light ${name} (${k + 1})`, onclick: () => this.setLight(name),
    }));
    find(".lights", this.root).append(...this.lightButtons);
  }

  entriesOf(problem) {
    return this.data.scenes.filter((entry) => entry.problem === problem);
  }

  /** Go to the next or the last scene of the problem. */
  step(by) {
    const own = this.entriesOf(this.state.entry.problem);
    this.show(own[(own.indexOf(this.state.entry) + by + own.length) % own.length]);
  }

  /** Show a scene, and a method on the left. */
  open(problem, name, method) {
    const entry = this.entriesOf(problem).find((each) => each.name === name);
    this.root.scrollIntoView();
    return entry && this.show(entry, method);
  }

  /** Show a scene; sides that it has, too, stay. */
  async show(entry, method) {
    this.state.entry = entry;
    find(".problem", this.root).value = entry.problem;
    options(find(".scene", this.root), this.entriesOf(entry.problem).map((each) => [this.data.scenes.indexOf(each), each.name]), this.data.scenes.indexOf(entry));
    this.stage.setAttribute("aria-busy", "true");
    const scene = await loadScene(entry);
    if (this.state.entry !== entry) return;
    this.scene = scene;
    this.truth = scene.surfaces.findIndex((surface) => surface.kind === "truth");
    const names = [[PHOTO, "photo"], ...scene.surfaces.map((surface, k) => [String(k), surface.label])];
    for (const side of ["left", "right"]) options(find(`.${side}`, this.root), names);
    const methods = scene.surfaces.flatMap((surface, k) => (surface.kind === "method" ? [k] : []));
    const keep = (label) => names.find(([, name]) => name === label)?.[0];
    const left = keep(method ?? this.state.leftLabel) ?? String(methods[0] ?? 0);
    const other = this.truth >= 0 ? this.truth : methods.find((k) => String(k) !== left) ?? 0;
    const right = (method && this.truth >= 0 ? undefined : keep(this.state.rightLabel)) ?? String(other);
    const has = { shade: true, depth: true, error: this.truth >= 0 && scene.error, angle: this.truth >= 0, expectedError: scene.expected, expectedAngle: scene.expected };
    for (const button of this.viewButtons) button.hidden = !has[button.dataset.view];
    if (this.viewButtons.some((button) => button.hidden && button.dataset.view === this.state.view)) this.state.view = "shade";
    this.state.about = null;
    this.fit();
    this.makeStrip();
    this.setSide("left", left, false);
    this.setSide("right", right, false);
    this.setView(this.state.view);
    this.setZoom(1, 0, 0);
    const holes = scene.surfaces.some((surface) => surface.mask || surface.error?.mask || surface.expected?.mask) ? ["pink: holes"] : [];
    const wrong = pixelsAreTrue() ? [] : ["this browser changes pixels that a page reads (to hide from trackers): renderings and values are wrong"];
    find(".scene-notes", this.root).textContent = [...holes, ...scene.notes, ...wrong].join(" \u00b7 ");
    this.stage.removeAttribute("aria-busy");
    if (this.started) this.store();
    this.started = true;
    this.stage.dataset.shown = entry.data;
  }

  /** Give the stage the scene's shape, not higher than the window. */
  fit() {
    const { width, height } = this.scene;
    this.stage.style.aspectRatio = `${width} / ${height}`;
    this.stage.style.width = `min(100%, ${((66 * width) / height).toFixed(2)}vh)`;
  }

  labelOf(side) {
    return this.state[side] === PHOTO ? "photo" : this.scene.surfaces[Number(this.state[side])].label;
  }

  surfaceOf(side) {
    return this.state[side] === PHOTO ? null : this.scene.surfaces[Number(this.state[side])];
  }

  setSide(side, value, draw = true) {
    this.state[side] = value;
    find(`.${side}`, this.root).value = value;
    this.state[`${side}Label`] = this.labelOf(side);
    find(`.name-${side}`, this.root).textContent = this.labelOf(side);
    if (!draw) return;
    this.state.about = null;
    this.refresh();
    this.showPair();
    this.store();
  }

  swap() {
    const { left, right } = this.state;
    this.setSide("left", right, false);
    this.setSide("right", left);
  }

  setView(view) {
    this.state.view = view;
    for (const button of this.viewButtons) button.setAttribute("aria-pressed", String(button.dataset.view === view));
    find(".lighting", this.root).hidden = view !== "shade";
    this.stage.classList.toggle("freed", view === "shade" && this.state.light === "free");
    this.refresh();
    this.showPair();
    this.showScale();
  }

  // Light.

  get light() {
    return this.state.light === "free" ? this.state.free : this.data.lights[this.state.light];
  }

  setLight(name, direction) {
    this.state.light = name;
    if (direction) this.state.free = direction;
    const light = this.light;
    this.state.weights = weightsOf(light, this.data.basis);
    for (const button of this.lightButtons) button.setAttribute("aria-pressed", String(button.dataset.light === name));
    this.stage.classList.toggle("freed", name === "free" && this.state.view === "shade");
    showLight(find(".ball", this.root), light, name === "free" ? "Free light" : `Light ${name}`);
    this.refresh();
  }

  // Drawing.

  /** Draw anew before the next frame, however often it is asked for. */
  refresh() {
    if (!this.scene || this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  draw() {
    const view = viewOf(this.state.view, this.scene, this.state);
    for (const side of ["left", "right"]) {
      paint(this.canvases[side], this.surfaceOf(side), this.scene, view, this.colours, this.hole);
      find(`.pane-${side} .silent`, this.root).textContent = silence(view, this.surfaceOf(side));
    }
    clearTimeout(this.later);
    if (this.state.light === "free") this.later = setTimeout(() => this.drawStrip(view), 150);
    else this.drawStrip(view);
    this.describe();
  }

  /** Make a button for each picture. */
  makeStrip() {
    const strip = find(".strip", this.root);
    const sides = [PHOTO, ...this.scene.surfaces.keys()].map(String);
    this.thumbs = sides.map((value) => {
      const surface = value === PHOTO ? null : this.scene.surfaces[Number(value)];
      const canvas = make("canvas", { "aria-hidden": "true" });
      canvas.style.aspectRatio = `${this.scene.width} / ${this.scene.height}`;
      const button = make("button", { type: "button", "data-value": value, title: surface?.text ?? "" },
        make("span", { className: "picture" }, canvas, make("span", { className: "silent" })),
        make("span", { className: "text", textContent: surface?.label ?? "photo" }),
        make("span", { className: "which text" }));
      button.addEventListener("click", (event) => this.setSide(event.shiftKey ? "left" : "right", value));
      if (surface && this.truth >= 0 && surface.kind !== "truth") {
        const about = () => { this.state.about = Number(value); this.showErrors(); };
        button.addEventListener("pointerenter", about);
        button.addEventListener("focus", about);
      }
      return { value, surface, canvas, button };
    });
    strip.replaceChildren(...this.thumbs.map((thumb) => thumb.button));
    this.scratch = make("canvas");
  }

  drawStrip(view) {
    for (const { value, surface, canvas, button } of this.thumbs) {
      const key = `${this.state.view} ${surface ? this.state.weights : ""}`;
      if (canvas.dataset.drawn !== key) {
        this.drawThumb(canvas, surface, view);
        find(".silent", button).textContent = silence(view, surface);
        canvas.dataset.drawn = key;
      }
      const sides = ["left", "right"].filter((side) => this.state[side] === value);
      find(".which", button).textContent = sides.join(", ") || "\u00a0";
      button.setAttribute("aria-pressed", String(this.state.right === value));
    }
  }

  /** Draw a thumbnail from every few pixels. */
  drawThumb(canvas, surface, view) {
    const share = Math.min(1, 224 / Math.max(this.scene.width, this.scene.height));
    const [width, height] = [Math.max(1, Math.round(this.scene.width * share)), Math.max(1, Math.round(this.scene.height * share))];
    if (surface === null) {
      paint(this.scratch, null, this.scene, view, this.colours, this.hole);
      Object.assign(canvas, { width, height });
      canvas.getContext("2d").drawImage(this.scratch, 0, 0, width, height);
      return;
    }
    const small = { ...this.scene, width, height };
    const of = (s, i, u, v) => {
      const [x, y] = [Math.floor(((u + 0.5) * this.scene.width) / width), Math.floor(((v + 0.5) * this.scene.height) / height)];
      return view.of(s, pixelAt(s, this.scene, x, y), x, y);
    };
    paint(canvas, surface, small, { ...view, of, weights: null }, this.colours, this.hole);
  }

  /** Write the colour bar of the view below the stage. */
  showScale() {
    if (!this.scene) return;
    const view = viewOf(this.state.view, this.scene, this.state);
    const scale = find(".stage-scale", this.root);
    scale.hidden = view.colours === null;
    if (view.colours !== null) this.writeScale(scale, this.state.view, view);
  }

  writeScale(element, name, view) {
    const { text } = this.unitOf(name);
    if (name === "expectedError") {
      colourBar(element, this.colours[view.colours], ["0", "expected error of the depth", `\u2265 ${text(view.high)}`], 128);
      return;
    }
    const ends = name === "depth" ? [`\u2264 ${text(view.low)}`, "depth", `\u2265 ${text(view.high)}`]
      : view.colours === "angle" ? ["0\u00b0", name === "angle" ? "30\u00b0" : "expected error of the normal", "\u2265 60\u00b0"]
        : [`\u2264 ${text(view.low)}`, "0", `\u2265 ${text(view.high)}`];
    colourBar(element, this.colours[view.colours], ends);
  }

  /** Return how values of a kind are written. */
  unitOf(name) {
    if (name === "depth") return { text: (value) => (isMissing(value) ? "hole" : `${number(value, 3)} m`) };
    if (name === "angle" || name === "expectedAngle") return { text: (value) => (isMissing(value) ? DASH : `${number(value, 1)}\u00b0`) };
    const [factor, unit] = this.scene.error && this.scene.error.limit < 0.02 ? [1000, "mm"] : [100, "cm"];
    const written = name === "expectedError" ? number : signed;
    return { text: (value) => (isMissing(value) ? DASH : `${written(factor * value, 1)} ${unit}`) };
  }

  // Scores and errors beside the pictures.

  showPair() {
    if (!this.scene) return;
    const problem = this.data.problems[this.state.entry.problem];
    const rowOf = (side) => problem.rows.find((row) => row.scene === this.scene.scene && row.method === this.labelOf(side) && this.surfaceOf(side)?.kind === "method");
    const sides = ["left", "right"].map((side) => ({ label: this.labelOf(side), row: rowOf(side) })).filter(({ row }) => row);
    const unique = sides.filter(({ label }, k) => sides.findIndex((other) => other.label === label) === k);
    const home = find(".pair-scores", this.root);
    home.hidden = !unique.length;
    const rows = this.data.metrics.map((metric) => {
      const places = unique.length > 1 ? ranked(unique.map(({ row }) => row), metric) : [];
      return make("tr", {}, make("td", { className: "word" }, `${metric.name} `, make("small", { textContent: metric.unit })),
        ...unique.map(({ row }) => make("td", {}, scoreCell(row, metric, places.slice(0, 1), 0, false))));
    });
    home.replaceChildren(make("div", { className: "box" }, make("table", {},
      make("thead", {}, make("tr", {}, make("th", { className: "word", scope: "col", textContent: "Scores" }), ...unique.map(({ label }) => make("th", { scope: "col", textContent: label })))),
      make("tbody", {}, ...rows))));
    this.showErrors();
  }

  /** Draw the error maps of the method that is pointed at, else of one that is shown. */
  showErrors() {
    const shown = ["right", "left"].map((side) => this.surfaceOf(side)).find((surface) => surface?.kind === "method");
    const surface = this.state.about === null ? shown : this.scene.surfaces[this.state.about];
    const home = find(".errors", this.root);
    home.hidden = this.truth < 0 || !surface;
    this.about = home.hidden ? null : surface;
    if (home.hidden) return;
    find(".errors-heading", this.root).textContent = `Errors of ${surface.label}`;
    for (const [name, selector] of [["error", ".depth-error"], ["angle", ".normal-error"]]) {
      const figure = find(selector, home);
      figure.hidden = name === "error" && !surface.errors;
      if (figure.hidden) continue;
      const view = viewOf(name, this.scene, this.state);
      paint(find("canvas", figure), surface, this.scene, view, this.colours, this.hole);
      this.writeScale(find(".scale", figure), name, view);
    }
    find(".error-readout", this.root).textContent = "";
  }

  // What is under the pointer.

  /** Return the values of a surface at a pixel of the scene, as words. */
  valuesAt(surface, u, v) {
    const i = pixelAt(surface, this.scene, u, v);
    const words = [];
    if (this.state.view === "shade") {
      const shade = probe.shade(surface, i, this.state.weights);
      words.push(`brightness ${isMissing(shade) ? DASH : number(shade, 2)}`);
    }
    words.push(`depth ${this.depthText(surface, i)}`);
    if (surface.errors) words.push(`error ${this.unitOf("error").text(probe.error(surface, i, this.scene.error.largest))}`);
    if (this.truth >= 0 && surface.kind !== "truth") {
      const truth = this.scene.surfaces[this.truth];
      words.push(`normal off by ${this.unitOf("angle").text(probe.angle(surface, i, truth, pixelAt(truth, this.scene, u, v)))}`);
    }
    if (surface.expected) {
      const [error, angle] = Object.entries(EXPECTED).map(([name, what]) => this.unitOf(name).text(probe.expected(surface, i, what, this.scene.expected)));
      words.push(`expected errors: depth ${error}, normal ${angle}`);
    } else if (this.state.view in EXPECTED && surface.kind !== "truth") words.push(viewOf(this.state.view, this.scene, this.state).silent);
    return words.join(", ");
  }

  /** Return a depth as text; what lies beyond the stored limits is said to. */
  depthText(surface, i) {
    const value = probe.depth(surface, i, this.scene.depth);
    const beyond = isMissing(value) ? "" : surface.depths[i] === 0 ? "\u2264 " : surface.depths[i] === 255 ? "\u2265 " : "";
    return beyond + this.unitOf("depth").text(value);
  }

  describe() {
    if (!this.pointed || !this.scene) return;
    const { u, v } = this.pointed;
    const lines = ["left", "right"].map((side) => [this.labelOf(side), this.surfaceOf(side)])
      .filter(([, surface], k, all) => surface && !(k === 1 && all[0][1] === surface))
      .map(([label, surface]) => make("span", {}, make("b", { textContent: label }), ` ${this.valuesAt(surface, u, v)}`, make("br")));
    const full = this.scene.size[0] / this.scene.width;
    find(".main-column .readout", this.root).replaceChildren(`column ${Math.floor((u + 0.5) * full)}, row ${Math.floor((v + 0.5) * full)} `, make("br"), ...lines);
  }

  /** Return the pixel of the scene under the pointer in a canvas, null outside. */
  pixelUnder(event, canvas) {
    const box = canvas.getBoundingClientRect();
    const u = Math.floor(((event.clientX - box.left) * this.scene.width) / box.width);
    const v = Math.floor(((event.clientY - box.top) * this.scene.height) / box.height);
    return u >= 0 && v >= 0 && u < this.scene.width && v < this.scene.height ? { u, v } : null;
  }

  // Divider and zoom.

  setSplit(percent) {
    this.state.split = clamp(percent, 0, 100);
    const rounded = Math.round(this.state.split);
    this.divider.style.left = `${this.state.split}%`;
    find(".pane-right", this.root).style.clipPath = `inset(0 0 0 ${this.state.split}%)`;
    this.divider.setAttribute("aria-valuenow", String(rounded));
    this.divider.setAttribute("aria-valuetext", `${rounded} % left`);
  }

  setZoom(zoom, x, y) {
    const { width, height } = this.stage.getBoundingClientRect();
    const state = this.state;
    state.zoom = clamp(zoom, 1, MOST_ZOOM);
    state.x = clamp(x, width * (1 - state.zoom), 0);
    state.y = clamp(y, height * (1 - state.zoom), 0);
    for (const canvas of Object.values(this.canvases)) canvas.style.transform = `translate(${state.x}px, ${state.y}px) scale(${state.zoom})`;
    this.stage.classList.toggle("zoomed", state.zoom > 1);
    const each = this.scene ? (width * state.zoom) / this.scene.width : 1;
    this.stage.classList.toggle("crisp", each >= 1.5);
    find(".zoom-reset", this.root).textContent = `${number(state.zoom, state.zoom < 9.95 && state.zoom % 1 ? 1 : 0)}\u00d7`;
  }

  /** Zoom by a factor about a point of the window; by default the middle of the stage. */
  zoomBy(factor, clientX, clientY) {
    const box = this.stage.getBoundingClientRect();
    const [px, py] = [(clientX ?? box.left + box.width / 2) - box.left, (clientY ?? box.top + box.height / 2) - box.top];
    const zoom = clamp(this.state.zoom * factor, 1, MOST_ZOOM);
    const real = zoom / this.state.zoom;
    this.setZoom(zoom, px - (px - this.state.x) * real, py - (py - this.state.y) * real);
  }

  splitTo(event) {
    const box = this.stage.getBoundingClientRect();
    this.setSplit((100 * (event.clientX - box.left)) / box.width);
  }

  // Events.

  listen() {
    const stage = this.stage;
    stage.addEventListener("pointerdown", (event) => this.press(event));
    stage.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => this.fingers.delete(event.pointerId));
    stage.addEventListener("dblclick", (event) => { if (!event.target.closest("button")) this.setZoom(1, 0, 0); });
    stage.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey && !stage.contains(document.activeElement)) return;
      event.preventDefault();
      this.zoomBy(wheelFactor(event), event.clientX, event.clientY);
    }, { passive: false });
    find(".zoom-in", stage).addEventListener("click", () => this.zoomBy(1.5));
    find(".zoom-out", stage).addEventListener("click", () => this.zoomBy(1 / 1.5));
    find(".zoom-reset", stage).addEventListener("click", () => this.setZoom(1, 0, 0));
    this.divider.addEventListener("keydown", (event) => this.dividerKey(event));
    stage.addEventListener("keydown", (event) => this.stageKey(event));
    document.addEventListener("keydown", (event) => this.key(event));
    new ResizeObserver(() => { if (this.scene) this.setZoom(this.state.zoom, this.state.x, this.state.y); }).observe(stage);
    listenToBall(find(".ball", this.root), () => this.light, (light) => this.setLight("free", light));
    for (const canvas of this.root.querySelectorAll(".errors canvas")) {
      canvas.addEventListener("pointermove", (event) => this.readError(event, canvas));
      canvas.addEventListener("pointerdown", (event) => this.readError(event, canvas));
    }
    addEventListener("hashchange", () => this.restore());
  }

  press(event) {
    if (event.target.closest("button") || event.button > 0 || !this.scene) return;
    this.pointed = this.pixelUnder(event, this.canvases.left) ?? this.pointed;
    this.describe();
    this.stage.setPointerCapture(event.pointerId);
    const onDivider = event.target.closest(".divider") !== null;
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY, onDivider });
    if (this.fingers.size === 1 && !onDivider && this.state.zoom === 1 && event.pointerType === "mouse") this.splitTo(event);
  }

  move(event) {
    if (!this.scene) return;
    this.pointed = this.pixelUnder(event, this.canvases.left) ?? this.pointed;
    const finger = this.fingers.get(event.pointerId);
    if (!finger) {
      if (this.state.light === "free" && this.state.view === "shade" && event.pointerType === "mouse") this.setLight("free", lightAt(event, this.stage));
      this.describe();
      return;
    }
    const before = { ...finger };
    Object.assign(finger, { x: event.clientX, y: event.clientY });
    if (this.fingers.size === 2) {
      const { factor, centre, shift } = pinchOf(this.fingers, event.pointerId, before);
      this.zoomBy(factor, ...centre);
      this.setZoom(this.state.zoom, this.state.x + shift[0], this.state.y + shift[1]);
    } else if (finger.onDivider || this.state.zoom === 1) this.splitTo(event);
    else this.setZoom(this.state.zoom, this.state.x + finger.x - before.x, this.state.y + finger.y - before.y);
    this.describe();
  }

  readError(event, canvas) {
    const pixel = this.scene && this.about && this.pixelUnder(event, canvas);
    if (!pixel) return;
    find(".error-readout", this.root).textContent = this.valuesAt(this.about, pixel.u, pixel.v);
  }

  dividerKey(event) {
    const step = event.shiftKey ? 10 : 1;
    const to = { ArrowLeft: -step, ArrowDown: -step, ArrowRight: step, ArrowUp: step, PageDown: -10, PageUp: 10, Home: -100, End: 100 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    this.setSplit(Math.round(this.state.split) + to);
  }

  /** Keys while the stage has the focus: arrows move the divider, or a zoomed picture. */
  stageKey(event) {
    const by = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!by || event.target !== this.stage) return;
    if (this.state.zoom > 1) {
      event.preventDefault();
      this.setZoom(this.state.zoom, this.state.x + 40 * by[0], this.state.y + 40 * by[1]);
    } else if (by[0]) this.dividerKey(event);
  }

  /** Keys of the whole page, while nobody types. */
  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || !this.scene || event.target.closest("input, select, textarea")) return;
    const actions = {
      f: () => this.setLight("free"), x: () => this.swap(), n: () => this.step(1), p: () => this.step(-1),
      "+": () => this.zoomBy(1.5), "=": () => this.zoomBy(1.5), "-": () => this.zoomBy(1 / 1.5), 0: () => this.setZoom(1, 0, 0),
    };
    this.lights.forEach((name, k) => { actions[k + 1] = () => this.setLight(name); });
    actions[event.key.toLowerCase()]?.();
  }

  // The address keeps what is shown, so that it can be passed on.

  store() {
    const { entry, leftLabel, rightLabel } = this.state;
    const problem = problemName(this.data.problems[entry.problem]);
    const parts = [problem, entry.name, leftLabel, rightLabel].map((part) => encodeURIComponent(part ?? ""));
    history.replaceState(null, "", `#view/${parts.join("/")}`);
  }

  restore() {
    const [kind, ...parts] = location.hash.slice(1).split("/");
    const [problem, name, left, right] = kind === "view" ? parts.map(safelyDecoded) : [];
    const entry = this.data.scenes.find((each) => each.name === name && problemName(this.data.problems[each.problem]) === problem);
    if (entry) Object.assign(this.state, { leftLabel: left, rightLabel: right });
    if (entry || !this.scene) this.show(entry ?? this.data.scenes[0]);
  }
}

/** Return what stands in place of the picture of a surface that a view does not have, "" where it has it. */
const silence = (view, surface) => (surface !== null && view.has && !view.has(surface) ? view.silent : "");

function safelyDecoded(text) {
  try {
    return decodeURIComponent(text);
  } catch {
    return "";
  }
}
