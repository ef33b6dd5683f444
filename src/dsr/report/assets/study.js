"use strict";

const STUDY = JSON.parse(document.getElementById("study").textContent);
const SCENES = new Map(STUDY.scenes.map((scene) => [scene.id, scene]));
const STORE = `perceptual-study-${STUDY.study}`;
const FIRST_GUESS_MS = 20000; // per scene, until this person's own pace is known
const LONGEST_ZOOM = 16;
const HOLD_MS = 280;
const at = (id) => document.getElementById(id);

/* Chance: an order for each person, kept with the answers, so that a reload shows the same one. */

function shuffled(items) { // Fisher and Yates
  const result = [...items];
  for (let last = result.length - 1; last > 0; last -= 1) {
    const other = Math.floor(Math.random() * (last + 1));
    [result[last], result[other]] = [result[other], result[last]];
  }
  return result;
}

function plan() {
  const fresh = shuffled(SCENES.keys()).slice(0, STUDY.perPerson);
  const again = shuffled(fresh).slice(0, STUDY.repeat);
  const trial = (scene, repeated) => ({
    scene,
    again: repeated,
    order: shuffled(Object.keys(SCENES.get(scene).images)),
    first: null,
    second: null,
    ms: 0,
    changes: 0,
  });
  return [...fresh.map((id) => trial(id, false)), ...again.map((id) => trial(id, true))];
}

function newPerson() {
  const bytes = crypto.getRandomValues(new Uint8Array(12));
  const participant = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return { study: STUDY.study, page: STUDY.page, participant, started: null, finished: null, index: 0,
    saved: false, viewport: null, touch: false, trials: plan() };
}

/* Progress, kept in the browser. */

let stored = true;

function load() {
  let text = null;
  try {
    text = localStorage.getItem(STORE);
    localStorage.setItem(`${STORE}-probe`, "1");
    localStorage.removeItem(`${STORE}-probe`);
  } catch {
    stored = false;
    return null;
  }
  try {
    const kept = JSON.parse(text);
    const same = kept && kept.study === STUDY.study && kept.page === STUDY.page;
    return same && sound(kept) ? kept : null;
  } catch {
    return null;
  }
}

function sound(kept) {
  const asked = (trial) => String([...trial.order].sort()) === String(Object.keys(SCENES.get(trial.scene).images).sort());
  return kept.trials.length === STUDY.perPerson + STUDY.repeat && kept.trials.every(asked) && kept.index in kept.trials;
}

function keep() {
  if (!stored) return;
  try {
    localStorage.setItem(STORE, JSON.stringify(person));
  } catch {
    stored = false;
    sayNotStored();
  }
}

function sayNotStored() {
  notify("This browser keeps nothing for this page, as in a private window: please finish without closing or reloading it.");
}

/* Screens. */

let person = null;
let since = null;

function show(name) {
  for (const id of ["welcome", "trial", "done"]) at(id).hidden = id !== name;
  window.scrollTo(0, 0);
  document.querySelector(`#${name} h1`).focus({ preventScroll: true });
}

function notify(text, offersAnother = false) {
  at("notice").hidden = !text;
  at("notice").querySelector("span").textContent = text;
  at("another").hidden = !offersAnother;
}

function minutes(ms) {
  const count = Math.max(1, Math.round(ms / 60000));
  return ms < 45000 ? "less than a minute" : `${count} ${count === 1 ? "minute" : "minutes"}`;
}

function welcome() {
  const number = STUDY.perPerson + STUDY.repeat;
  at("how-many").textContent = number === 1 ? "one scene" : `${number} scenes`;
  at("how-long").textContent = minutes(number * FIRST_GUESS_MS);
  show("welcome");
}

function begin() {
  person.started ??= new Date().toISOString();
  keep();
  openTrial(person.index);
}

function startAgain() {
  const unsaved = person.started && !person.saved;
  if (unsaved && !confirm("The answers so far have not been saved and will be gone. Start again?")) return;
  person = newPerson();
  keep();
  notify("");
  welcome();
}

/* A trial. */

const view = { zoom: 1, x: 0.5, y: 0.5 };
let held = false;

const trial = () => person.trials[person.index];
const complete = (each) => each.first !== null && each.second !== null;
const source = (png) => `data:image/png;base64,${png}`;

function stopClock() {
  if (since !== null) trial().ms += Math.round(performance.now() - since);
  since = null;
}

function startClock() {
  since = document.hidden || at("trial").hidden ? null : performance.now();
}

function openTrial(index) {
  person.index = index;
  const scene = SCENES.get(trial().scene);
  document.querySelectorAll(".tile").forEach((tile) => tile.remove());
  at("original").querySelector("img").src = source(scene.truth);
  trial().order.forEach((id, number) => at("grid").append(tileOf(scene, id, number + 1)));
  show("trial");
  Object.assign(view, { zoom: 1, x: 0.5, y: 0.5 });
  holdOriginal(false);
  layOut();
  refresh();
  keep();
  startClock();
  at("grid").scrollTop = 0;
  const following = person.trials[index + 1];
  if (following) prefetch(SCENES.get(following.scene));
}

function prefetch(scene) {
  for (const png of [scene.truth, ...Object.values(scene.images)]) new Image().src = source(png);
}

function tileOf(scene, id, number) {
  const tile = document.createElement("button");
  tile.type = "button";
  tile.className = "tile";
  tile.dataset.id = id;
  tile.dataset.number = number;
  const frame = document.createElement("span");
  frame.className = "view";
  const picture = new Image();
  picture.alt = "";
  picture.draggable = false;
  picture.src = source(scene.images[id]);
  frame.append(picture);
  const caption = document.createElement("span");
  caption.className = "caption";
  caption.append(document.createElement("b"), document.createElement("i"));
  tile.append(frame, caption);
  return tile;
}

function refresh() {
  const now = trial();
  const total = person.trials.length;
  const done = person.trials.filter(complete).length;
  at("where").textContent = `Scene ${person.index + 1} of ${total}`;
  at("left").textContent = timeLeft();
  at("progress").setAttribute("aria-valuemax", total);
  at("progress").setAttribute("aria-valuenow", done);
  at("progress").firstElementChild.style.width = `${(100 * done) / total}%`;
  for (const tile of document.querySelectorAll(".tile")) {
    const rank = tile.dataset.id === now.first ? "first" : tile.dataset.id === now.second ? "second" : "";
    const words = { first: "most similar", second: "second", "": "" }[rank];
    tile.classList.toggle("first", rank === "first");
    tile.classList.toggle("second", rank === "second");
    tile.setAttribute("aria-pressed", rank !== "");
    tile.setAttribute("aria-label", `Picture ${tile.dataset.number}${words && `, chosen as ${words}`}`);
    tile.querySelector("i").textContent = { first: "1st", second: "2nd", "": "" }[rank];
    const flipped = held || tile.classList.contains("flip");
    tile.querySelector("b").textContent = flipped ? "Original" : tile.dataset.number;
  }
  const [text, call] = complete(now) ? ["Both are chosen. Go on, or undo.", false]
    : now.first === null ? [`Which of the ${now.order.length} is most similar to the original?`, true]
      : ["And which is second most similar?", true];
  hint(text, call);
  at("next").disabled = !complete(now);
  at("next").textContent = person.index + 1 === total ? "Finish" : "Next";
  at("back").disabled = person.index === 0;
  at("undo").disabled = now.first === null && now.second === null;
}

function hint(text, call) {
  if (at("hint").textContent !== text) at("hint").textContent = text;
  at("hint").classList.toggle("call", call);
}

function timeLeft() {
  const done = person.trials.filter(complete);
  const left = person.trials.length - done.length;
  if (left === 0) return "";
  const times = done.map((each) => each.ms).filter((ms) => ms > 0).sort((a, b) => a - b);
  const pace = times.length < 2 ? FIRST_GUESS_MS : times[Math.floor(times.length / 2)];
  return `${minutes(left * pace)} left`;
}

function choose(id) {
  const now = trial();
  if (now.first === id) now.first = null;
  else if (now.second === id) now.second = null;
  else if (now.first === null) now.first = id;
  else if (now.second === null) now.second = id;
  else {
    hint("Two are chosen already. Undo one of them first.", true);
    return;
  }
  changed();
}

function undo() {
  const now = trial();
  if (now.second !== null) now.second = null;
  else if (now.first !== null) now.first = null;
  else return;
  changed();
}

function changed() {
  trial().changes += 1;
  Object.assign(person, { finished: null, saved: false });
  stopClock();
  startClock();
  refresh();
  keep();
}

function goOn() {
  if (!complete(trial())) return;
  stopClock();
  if (person.index + 1 < person.trials.length) openTrial(person.index + 1);
  else finish();
}

function goBack() {
  if (person.index === 0) return;
  stopClock();
  openTrial(person.index - 1);
}

/* As large as the window allows: of all numbers of columns, the one with the largest pictures. */

function layOut() {
  const grid = at("grid");
  const scene = SCENES.get(trial().scene);
  const count = trial().order.length;
  const aspect = scene.width / scene.height;
  const [gap, caption] = [10, 30];
  const [wide, high] = [grid.clientWidth - 24, grid.clientHeight - 8];
  const across = (columns) => Math.floor((wide - gap * (columns - 1)) / columns);
  const sizeFor = (columns, rows) =>
    Math.min(across(columns), Math.floor(((high - gap * (rows - 1)) / rows - caption) * aspect));
  const options = [];
  for (let columns = 1; columns <= count + 1; columns += 1) {
    const rows = Math.ceil((count + 1) / columns);
    options.push({ columns, rows, tile: sizeFor(columns, rows), worth: 1 });
    const beside = Math.ceil(count / columns); // the original in a column of its own, the others a full rectangle
    if (count % columns === 0) {
      options.push({ columns: columns + 1, rows: beside, tile: sizeFor(columns + 1, beside), beside: true, worth: 1.12 });
    }
  }
  let best = options.reduce((a, b) => (b.tile * b.worth > a.tile * a.worth ? b : a));
  const phone = grid.clientWidth < 600 && aspect < 3;
  const least = Math.min(220, wide);
  if (phone) best = { columns: 2, tile: Math.floor((grid.clientWidth - 20 - gap) / 2) };
  else if (best.tile < least) { // too many for the window: they scroll past the original
    const columns = Math.max(2, Math.floor((wide + gap) / (least + gap)));
    const tile = Math.min(across(columns), Math.max(least, Math.floor((high - caption) * aspect)));
    best = { columns, rows: Math.ceil(count / (columns - 1)), tile, beside: true, scrolls: true };
  }
  grid.classList.toggle("phone", phone);
  grid.classList.toggle("beside", Boolean(best.beside));
  grid.classList.toggle("scrolls", Boolean(best.scrolls));
  const style = grid.style;
  style.setProperty("--columns", best.columns);
  style.setProperty("--rows", best.rows ?? 1);
  style.setProperty("--tile", `${best.tile}px`);
  style.setProperty("--tall", `${Math.round(best.tile / aspect)}px`);
  applyView();
}

/* Zoom and movement, the same for all pictures; x and y are what lies in the middle, as shares of the picture. */

function applyView() {
  const half = 0.5 / view.zoom;
  view.x = Math.min(Math.max(view.x, half), 1 - half);
  view.y = Math.min(Math.max(view.y, half), 1 - half);
  const grid = at("grid");
  const frame = at("original").querySelector(".view");
  const [width, height] = [frame.clientWidth, frame.clientHeight];
  grid.style.setProperty("--zoom", view.zoom);
  grid.style.setProperty("--dx", `${width * (0.5 - view.x * view.zoom)}px`);
  grid.style.setProperty("--dy", `${height * (0.5 - view.y * view.zoom)}px`);
  grid.classList.toggle("zoomed", view.zoom > 1);
  const pixels = (width * view.zoom * devicePixelRatio) / SCENES.get(trial().scene).width;
  grid.classList.toggle("large", pixels >= 2);
  at("fit").textContent = `${view.zoom < 10 ? Math.round(view.zoom * 10) / 10 : Math.round(view.zoom)}×`;
}

function zoomBy(factor, x = 0.5, y = 0.5) { // (x, y): the place of the frame that stays where it is
  const zoom = Math.min(Math.max(view.zoom * factor, 1), LONGEST_ZOOM);
  view.x += (x - 0.5) * (1 / view.zoom - 1 / zoom);
  view.y += (y - 0.5) * (1 / view.zoom - 1 / zoom);
  view.zoom = zoom < 1.02 ? 1 : zoom;
  applyView();
}

function placeIn(frame, event) {
  const box = frame.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

function holdOriginal(on, tile = null) {
  const scene = SCENES.get(trial().scene);
  held = on && tile === null;
  for (const each of document.querySelectorAll(".tile")) {
    const flip = on && (tile === null || tile === each);
    each.classList.toggle("flip", flip);
    each.querySelector("img").src = source(flip ? scene.truth : scene.images[each.dataset.id]);
  }
  refresh();
}

/* Mouse, pen and fingers on the pictures: a short press chooses, a long one shows the original, a movement moves. */

const fingers = new Map();
let press = null;
let swallow = false;

function pressed(event) {
  const frame = event.target.closest(".view");
  if (!frame || event.button > 0) return;
  swallow = false;
  fingers.set(event.pointerId, event);
  const tile = frame.closest(".tile");
  endPress();
  if (fingers.size > 1) {
    swallow = true;
    return;
  }
  press = { tile, frame, x: event.clientX, y: event.clientY, moved: false, flipped: false, timer: null };
  if (!tile) return;
  const mine = press;
  press.timer = setTimeout(() => {
    mine.flipped = true;
    swallow = true;
    holdOriginal(true, tile);
  }, HOLD_MS);
}

function moved(event) {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  if (fingers.size === 2) pinch(before, event);
  else if (press && !press.flipped) drag(before, event);
  fingers.set(event.pointerId, event);
}

function drag(before, event) {
  if (Math.hypot(event.clientX - press.x, event.clientY - press.y) > 8) {
    press.moved = true;
    swallow = true;
    clearTimeout(press.timer);
  }
  if (!press.moved || view.zoom === 1) return;
  view.x -= (event.clientX - before.clientX) / (press.frame.clientWidth * view.zoom);
  view.y -= (event.clientY - before.clientY) / (press.frame.clientHeight * view.zoom);
  applyView();
}

function pinch(before, event) {
  const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
  const gap = (a) => Math.max(Math.hypot(a.clientX - other.clientX, a.clientY - other.clientY), 1);
  const frame = at("original").querySelector(".view");
  view.x -= (event.clientX - before.clientX) / 2 / (frame.clientWidth * view.zoom);
  view.y -= (event.clientY - before.clientY) / 2 / (frame.clientHeight * view.zoom);
  zoomBy(gap(event) / gap(before));
}

function released(event) {
  fingers.delete(event.pointerId);
  endPress();
}

function endPress() {
  if (!press) return;
  clearTimeout(press.timer);
  if (press.flipped) holdOriginal(false);
  press = null;
}

function clicked(event) {
  const tile = event.target.closest(".tile");
  if (!tile) return;
  if (swallow && event.detail > 0) {
    swallow = false;
    return;
  }
  const taken = [trial().first, trial().second].includes(tile.dataset.id);
  if (event.detail === 0 && (complete(trial()) || taken)) goOn(); // the Enter key on a picture
  else choose(tile.dataset.id);
}

function wheeled(event) {
  const frame = event.target.closest(".view");
  const grid = at("grid");
  if (!frame || (!event.ctrlKey && grid.scrollHeight > grid.clientHeight + 1)) return;
  event.preventDefault();
  const lines = event.deltaMode === 1 ? 16 : 1;
  zoomBy(Math.exp(-Math.max(-240, Math.min(240, event.deltaY * lines)) / 400), ...placeIn(frame, event));
}

/* Keys. */

const KEYS = {
  Backspace: undo,
  Enter: goOn,
  ArrowRight: goOn,
  ArrowLeft: goBack,
  "+": () => zoomBy(1.5),
  "=": () => zoomBy(1.5),
  "-": () => zoomBy(1 / 1.5),
  0: () => zoomBy(0),
};

function keyDown(event) {
  if (at("trial").hidden || event.ctrlKey || event.metaKey || event.altKey) return;
  const button = event.target.closest("button");
  const onTile = button?.classList.contains("tile");
  if (event.key === " " && (!button || onTile)) {
    event.preventDefault();
    if (!event.repeat) holdOriginal(true);
    return;
  }
  if (event.key === "Enter" && button) return; // the button's own
  const tile = /^[1-9]$/.test(event.key) && document.querySelector(`.tile[data-number="${event.key}"]`);
  if ((!tile && !KEYS[event.key]) || event.repeat) return;
  event.preventDefault();
  if (tile) choose(tile.dataset.id);
  else KEYS[event.key]();
}

function keyUp(event) {
  if (event.key === " " && held) {
    event.preventDefault();
    holdOriginal(false);
  }
}

/* The end. */

function answersText() {
  const { study, page, participant, started, finished, viewport, touch, trials } = person;
  return JSON.stringify({ study, page, participant, started, finished, viewport, touch, trials }, null, 1);
}

function finish() {
  person.finished ??= new Date().toISOString();
  person.viewport = { width: innerWidth, height: innerHeight, ratio: devicePixelRatio };
  person.touch = matchMedia("(pointer: coarse)").matches;
  keep();
  at("answers").value = answersText();
  at("copied").textContent = "";
  notify("");
  show("done");
}

function save() {
  person.saved = true;
  keep();
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([answersText()], { type: "application/json" }));
  link.download = `answers-${STUDY.study.slice(0, 6)}-${person.participant.slice(0, 8)}.json`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

async function copy() {
  try {
    await navigator.clipboard.writeText(answersText());
  } catch {
    at("answers").closest("details").open = true;
    at("answers").select();
    if (!document.execCommand("copy")) {
      at("copied").textContent = "Please copy the marked text.";
      return;
    }
  }
  at("copied").textContent = "Copied.";
  person.saved = true;
  keep();
}

/* Wiring. */

function wire() {
  const clicks = { begin, back: goBack, next: goOn, undo, save, copy, again: startAgain, another: startAgain,
    revise: () => openTrial(person.trials.length - 1), dismiss: () => notify(""),
    in: () => zoomBy(1.5), out: () => zoomBy(1 / 1.5), fit: () => zoomBy(0) };
  for (const [id, action] of Object.entries(clicks)) at(id).addEventListener("click", () => action());
  const grid = at("grid");
  grid.addEventListener("pointerdown", pressed);
  grid.addEventListener("click", clicked);
  grid.addEventListener("wheel", wheeled, { passive: false });
  grid.addEventListener("contextmenu", (event) => event.preventDefault());
  addEventListener("pointermove", moved);
  addEventListener("pointerup", released);
  addEventListener("pointercancel", released);
  addEventListener("keydown", keyDown);
  addEventListener("keyup", keyUp);
  addEventListener("blur", () => held && holdOriginal(false));
  new ResizeObserver(() => at("trial").hidden || layOut()).observe(grid);
  document.addEventListener("visibilitychange", () => {
    if (at("trial").hidden) return;
    stopClock();
    startClock();
    keep();
  });
}

wire();
const kept = load();
person = kept ?? newPerson();
if (!stored) sayNotStored();
if (kept?.finished) finish();
else if (kept?.started) {
  openTrial(person.index);
  notify("Welcome back, go on here.", true);
} else welcome();
