// The page of `dsr app`: files and settings go to the server, and what it makes of them is shown by the viewer.

const settings = block("settings");
history.replaceState(null, "", location.pathname); // the token is not for the history
try {
  sessionStorage.setItem("token", settings.token); // for loading the page again
} catch { /* the browser keeps nothing: it has to be opened again by its address */ }
const DEPTH_WORDS = /depth|disp|range|tiefe/i;
const POLL = 400; // milliseconds
const MOST = 4; // files that are dropped at once: photo, depth map, camera, mask
const STATES = { waiting: "Waiting", running: "Working", done: "Done", failed: "Failed", cancelled: "Cancelled" };

/** Ask the server; throws an error with its reason where it refuses. */
async function ask(method, path, body, json = false) {
  let response;
  try {
    response = await fetch(path, { method, keepalive: method === "DELETE", body: json ? JSON.stringify(body) : body, headers: { [settings.header]: settings.token } });
  } catch {
    throw new Error("The server does not answer; is `dsr app` still running?");
  }
  const answer = await response.json().catch(() => ({}));
  if (!response.ok) throw Object.assign(new Error(answer.problem ?? `The server answers ${response.status}.`), { status: response.status });
  return answer;
}

const suffixOf = (name) => (/\.[a-z0-9]+$/i.exec(name)?.[0] ?? "").toLowerCase();
const takes = (role, file) => settings.suffixes[role].includes(suffixOf(file.name));
const seconds = (value) => (value < 100 ? `${Math.round(value)} s` : `${Math.floor(value / 60)} min ${Math.round(value % 60)} s`);
const megabytes = (size) => `${Math.round(size / 1e6)} MB`;

class Files {
  /** Hold the chosen files by role; `changed()` is called after each change, `refuse(problem)` where there is none. */
  constructor(changed, refuse) {
    Object.assign(this, { changed, refuse });
    this.by = {};
    for (const slot of findAll(".slot")) {
      const input = find("input", slot);
      input.addEventListener("change", () => { if (input.files.length) this.put({ [slot.dataset.role]: input.files[0] }); else this.put({ [slot.dataset.role]: null }); });
    }
    const zone = find(".drop");
    const over = (event) => { if (event.dataTransfer.types.includes("Files")) { event.preventDefault(); zone.classList.add("over"); } };
    for (const name of ["dragenter", "dragover"]) document.addEventListener(name, over);
    document.addEventListener("dragleave", (event) => { if (!event.relatedTarget) zone.classList.remove("over"); });
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      zone.classList.remove("over");
      const dropped = [...event.dataTransfer.files];
      const folder = [...event.dataTransfer.items].some((item) => item.webkitGetAsEntry?.()?.isDirectory);
      if (folder || dropped.length > MOST) this.refuse("Drop a photo and a depth map; of a folder, drop a .zip of it.");
      else if (dropped.length) this.put(this.sorted(dropped));
    });
    find(".swap").addEventListener("click", () => this.put({ photo: this.by.depth, depth: this.by.photo }));
  }

  get isComplete() {
    return Boolean(this.by.capture || (this.by.photo && this.by.depth));
  }

  /** Return dropped files by role, by their names and sizes. */
  sorted(files) {
    const found = {};
    const camera = files.find((file) => takes("camera", file));
    if (camera) found.camera = camera;
    const pictures = files.filter((file) => file !== camera);
    if (pictures.length === 1 && takes("capture", pictures[0])) return { ...found, capture: pictures[0] };
    const named = pictures.find((file) => DEPTH_WORDS.test(file.name) && takes("depth", file));
    const only = pictures.find((file) => takes("depth", file) && !takes("photo", file));
    const beside = pictures.length === 2 && pictures.find((file) => takes("depth", file) && !takes("depth", pictures.find((other) => other !== file)));
    if (pictures.length === 1 && !named && !only) {
      const role = this.by.photo && !this.by.depth && takes("depth", pictures[0]) ? "depth" : takes("photo", pictures[0]) ? "photo" : "depth";
      return { ...found, [role]: pictures[0] };
    }
    const depth = named ?? only ?? (beside || (pictures.length === 2 ? [...pictures].sort((a, b) => a.size - b.size)[0] : undefined));
    const photo = pictures.find((file) => file !== depth && takes("photo", file) && !/mask/i.test(file.name));
    const mask = pictures.find((file) => /mask/i.test(file.name) && takes("mask", file));
    return { ...found, ...(photo && { photo }), ...(depth && { depth }), ...(mask && { mask }) };
  }

  /** Take files by role, null for none; a capture and a pair exclude each other. */
  put(files) {
    const wrong = Object.entries(files).find(([role, file]) => file && !takes(role, file));
    if (wrong) {
      this.show();
      this.refuse(`${wrong[1].name}: expected a ${wrong[0] === "depth" ? "depth map" : wrong[0]} as ${settings.suffixes[wrong[0]].join(", ")}`);
      return;
    }
    if (files.capture) for (const role of ["photo", "depth", "mask"]) this.by[role] = null;
    if (files.photo || files.depth) this.by.capture = null;
    Object.assign(this.by, files);
    this.show();
    const size = Object.values(this.by).reduce((sum, file) => sum + (file?.size ?? 0), 0);
    this.changed(size > settings.most ? `The files have ${megabytes(size)}; at most ${megabytes(settings.most)} are taken (--max-upload).` : "");
  }

  /** Show the files in their inputs. */
  show() {
    for (const slot of findAll(".slot")) {
      const file = this.by[slot.dataset.role];
      const given = new DataTransfer();
      if (file) given.items.add(file);
      find("input", slot).files = given.files;
      slot.classList.toggle("filled", Boolean(file));
      if (file) slot.closest("details")?.setAttribute("open", "");
    }
    find(".swap").hidden = !(this.by.photo && this.by.depth && takes("photo", this.by.depth) && takes("depth", this.by.photo));
  }
}

class App {
  constructor() {
    this.upload = null; // { id, partial }, of the files as they are; partial until all are sent
    this.looked = false; // whether the frames of the capture are known
    this.count = 1;
    this.names = [];
    this.turn = 0; // of what is asked for; what comes for an earlier one is dropped
    this.files = new Files((problem) => this.filesChanged(problem), (problem) => this.refuse(problem));
    find(".asked").addEventListener("submit", (event) => { event.preventDefault(); this.compute(); });
    find(".cancel").addEventListener("click", () => this.cancel());
    find(".prepare").addEventListener("click", () => this.prepare());
    find("#frame").addEventListener("input", () => this.showFrame());
    find("#method").addEventListener("change", () => this.showChoices());
    find("#range").addEventListener("change", () => this.showChoices());
    find("#smooth").addEventListener("input", () => this.showChoices());
    find(".asked").addEventListener("input", () => this.outdate());
    addEventListener("pagehide", () => this.forget());
    addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
    this.showChoices();
  }

  // What is chosen.

  showChoices() {
    find("output[for=smooth]").textContent = find("#smooth").value;
    find("#smooth").disabled = find("#method").value !== "facets";
    find(".baseline").hidden = find("#range").value !== "disparity";
  }

  /** Return the settings that are not left as they are. */
  choices() {
    const found = {};
    for (const field of findAll("[data-choice]")) {
      if (field.value === "" || field.disabled || field.closest("[hidden]")) continue;
      if (field.id === "smooth" && Number(field.value) === 1) continue;
      found[field.dataset.choice] = field.value;
    }
    if (find("#register").checked) found.register = true;
    return found;
  }

  /** Show that the result is of other settings. */
  outdate() {
    if (this.shown && this.upload) this.say("The settings have changed; Compute applies them.");
  }

  async filesChanged(problem) {
    this.turn += 1;
    const turn = this.turn;
    this.forget();
    this.looked = false;
    this.refuse(problem);
    find(".compute").disabled = Boolean(problem) || !this.files.isComplete;
    this.offerFrames(1, [], []);
    if (problem || !this.files.isComplete) {
      this.say(this.files.by.photo ? "Now the depth map." : this.files.by.depth ? "Now the photo." : "");
      return;
    }
    this.say("Ready to compute.");
    if (!this.files.by.capture) return;
    await this.doing(async () => {
      find(".compute").disabled = true;
      if (await this.look(turn)) this.say(this.count > 1 ? `${this.count} frames; choose one, then Compute.` : "Ready to compute.");
    }, turn);
    if (turn === this.turn) find(".compute").disabled = false;
  }

  /** Find the frames of the capture; return whether they are known. */
  async look(turn) {
    const job = await this.run("look", {}, turn);
    if (job?.state !== "done") return false;
    this.looked = true;
    this.offerFrames(job.count, job.names, job.thumbs);
    return true;
  }

  offerFrames(count, names, thumbs) {
    Object.assign(this, { count, names });
    find(".frames").hidden = count < 2;
    Object.assign(find("#frame"), { max: String(count), value: "1" });
    find(".frame-of").textContent = `of ${count}`;
    find(".frame-strip").replaceChildren(...thumbs.map(({ thumb, frame }) => make("button", { type: "button", "data-frame": String(frame), title: names[frame - 1] ?? "", onclick: () => { find("#frame").value = String(frame); this.showFrame(); this.outdate(); } },
      ...(thumb ? [make("img", { src: thumb, alt: "" })] : []), make("span", { textContent: `Frame ${frame}` }))));
    this.showFrame();
  }

  get frame() {
    return clamp(Math.round(Number(find("#frame").value) || 1), 1, this.count);
  }

  showFrame() {
    find(".frame-name").textContent = this.names[this.frame - 1] ?? "";
    for (const button of findAll("[data-frame]")) button.setAttribute("aria-pressed", String(Number(button.dataset.frame) === this.frame));
  }

  // What is asked of the server.

  /** Delete what the server has of other files. */
  forget() {
    if (this.upload) ask("DELETE", `uploads/${this.upload.id}`).catch(() => {});
    this.upload = null;
    find(".downloads").hidden = true;
  }

  /** Send the files, unless the server has them. */
  async send(turn) {
    if (this.upload && !this.upload.partial) return;
    this.say("Sending the files \u2026");
    const { id } = await ask("POST", `uploads?replaces=${this.upload?.id ?? ""}`);
    if (turn !== this.turn) { await ask("DELETE", `uploads/${id}`); return; }
    const upload = this.upload = { id, partial: true };
    for (const [role, file] of Object.entries(this.files.by)) {
      if (file) await ask("PUT", `uploads/${id}/${role}?suffix=${encodeURIComponent(suffixOf(file.name))}`, file);
      if (turn !== this.turn) return;
    }
    upload.partial = false;
  }

  /** Begin a job; what the server has deleted meanwhile is sent again, once. */
  async begin(what, more, turn) {
    for (let again = what !== "files"; ; again = false) {
      await this.send(turn);
      if (turn !== this.turn) return null;
      try {
        return await ask("POST", `uploads/${this.upload.id}/job`, { what, ...more }, true);
      } catch (error) {
        if (!again || error.status !== 404 || turn !== this.turn) throw error;
        this.upload = null;
      }
    }
  }

  /** Have the server do something, and return its job at the end; nothing if something else was asked for since. */
  async run(what, more, turn) {
    let job = await this.begin(what, more, turn);
    if (turn !== this.turn) return null;
    const path = `uploads/${this.upload.id}`;
    while (turn === this.turn && (job.state === "waiting" || job.state === "running")) {
      this.showJob(job);
      await new Promise((done) => setTimeout(done, POLL));
      if (turn !== this.turn) return null;
      job = await ask("GET", path);
    }
    if (turn !== this.turn) return null;
    if (job.state === "failed") this.refuse(job.problem);
    this.say(job.state === "done" ? "" : `${STATES[job.state]}.`);
    return job;
  }

  /** Do something that may fail, with the display of work under way. */
  async doing(work, turn) {
    this.refuse("");
    find(".cancel").hidden = false;
    find(".under-way").hidden = false;
    if (document.activeElement === document.body || document.activeElement.disabled) find(".cancel").focus();
    try {
      await work();
    } catch (error) {
      if (turn === this.turn) {
        if (error.status === 404) this.forget(); // it is sent again by Compute
        this.refuse(error.status === 404 ? "The server has deleted the files meanwhile; Compute sends them again." : error.message);
        this.say("");
      }
    }
    if (turn !== this.turn) return;
    find(".under-way").hidden = true;
    find(".compute").disabled = !this.files.isComplete;
    find(".prepare").disabled = false;
    if (document.activeElement === find(".cancel")) find(".compute").focus();
    find(".cancel").hidden = true;
  }

  async compute() {
    if (find(".compute").disabled) return;
    this.turn += 1;
    const turn = this.turn;
    find(".compute").disabled = true;
    find(".downloads").hidden = true;
    await this.doing(async () => {
      if (this.files.by.capture && !this.looked) {
        if (!await this.look(turn)) return;
        if (this.count > 1) { this.say(`${this.count} frames; choose one, then Compute.`); return; }
      }
      const job = await this.run("result", { choices: this.choices(), frame: this.frame, count: this.count }, turn);
      if (job) this.showNotes(job.notes);
      if (job?.state !== "done") return;
      this.say("Drawing the surfaces \u2026");
      const { content, data } = await ask("GET", `uploads/${this.upload.id}/shown`);
      if (turn !== this.turn) return;
      find(".empty").hidden = true;
      await this.showResult(content, data);
      this.shown = true;
      find(".links").replaceChildren();
      find(".prepare-line").hidden = false;
      find(".downloads").hidden = false;
      this.say(`Done in ${seconds(job.elapsed)}.`);
    }, turn);
    if (turn === this.turn && this.shown && find(".refused").hidden) find("#result-part").focus({ preventScroll: innerWidth >= 1000 });
  }

  async showResult(content, data) {
    try {
      if (this.view) await this.view.take(content, (name) => data[name]);
      else this.view = new View(content, (name) => data[name], { side: "apart", drag: "light" });
    } catch (error) {
      find(".problem").textContent = `The surface cannot be shown in this browser (${error.message}). A current Firefox, Chrome, Edge or Safari with WebGL 2 shows it; the files can be downloaded.`;
      find(".problem").hidden = false;
    }
  }

  async prepare() {
    this.turn += 1;
    const turn = this.turn;
    find(".prepare").disabled = true;
    await this.doing(async () => {
      const job = await this.run("files", {}, turn);
      if (job?.state !== "done") return;
      const texts = { zip: "All files (.zip)", glb: "Mesh (.glb)", ply: "Mesh (.ply)" };
      find(".links").replaceChildren(...job.files.map((name, number) => make("li", {}, make("a", { href: `uploads/${this.upload.id}/files/${number}`, download: "", textContent: `${texts[name.split(".").pop()] ?? name}, ${megabytes(job.sizes[number])}` }))));
      find(".prepare-line").hidden = true;
      this.say("The files are ready.");
      find(".links a").focus();
    }, turn);
  }

  async cancel() {
    this.turn += 1;
    const turn = this.turn;
    await this.doing(async () => { if (this.upload) await ask("DELETE", `uploads/${this.upload.id}/job`); this.say("Cancelled."); }, turn);
  }

  // What is said.

  say(text) {
    if (find(".status").textContent !== text) find(".status").textContent = text;
  }

  refuse(problem) {
    find(".refused").textContent = problem;
    find(".refused").hidden = !problem;
  }

  /** Show how far a job is. */
  showJob(job) {
    const [bar, times] = [find("progress"), find(".times")];
    const waiting = job.state === "waiting";
    this.say(waiting ? `Waiting; ${job.before} before this` : { look: "Looking into the capture \u2026", result: "Computing \u2026", files: "Writing the files \u2026" }[job.what]);
    if (job.total) Object.assign(bar, { max: job.total, value: job.done });
    else bar.removeAttribute("value");
    times.textContent = [
      ...(job.stage && !job.total ? [job.stage] : []),
      ...(job.total ? [`step ${job.done} of ${job.total}`] : []),
      ...(waiting ? [] : [`elapsed ${seconds(job.elapsed)}`]),
      ...(job.remaining === null || waiting ? [] : [`about ${seconds(job.remaining)} left`]),
      ...(waiting || job.elapsed < 30 ? [] : [`ended at ${settings.seconds} s`]),
    ].join(", ");
    if (job.what === "result" && job.notes.length) this.showNotes(job.notes);
  }

  showNotes(notes) {
    find(".read").hidden = !notes.length;
    const ordered = [...notes.filter(({ warning }) => warning), ...notes.filter(({ warning }) => !warning)];
    find(".job-notes").replaceChildren(...ordered.map(({ note, warning }) => make("li", { className: warning ? "warning" : "", textContent: `${warning ? "Warning: " : ""}${note}` })));
  }
}

addEventListener("unhandledrejection", (event) => {
  find(".problem").textContent = `Something went wrong on this page (${event.reason?.message}); load it again.`;
  find(".problem").hidden = false;
  event.preventDefault();
});
const app = new App();
