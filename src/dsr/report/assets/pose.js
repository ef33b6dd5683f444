// Where one looks from, by mouse, touch and keys.

const STEP = Math.PI / 36;
const STEEPEST = (85 * Math.PI) / 180;
const NEAREST = 0.08;
const FARTHEST = 8;

/** The position of the surface in front of the viewer. At first it is the photo's view. */
class Pose {
  constructor(pivot) {
    this.pivot = pivot;
    this.reset();
  }

  reset() {
    this.yaw = 0;
    this.pitch = 0;
    this.zoom = 1;
    this.shift = [0, 0];
  }

  /** Turn by angles to the right and down. */
  turnBy(right, down) {
    this.yaw -= right;
    this.pitch = clamp(this.pitch + down, -STEEPEST, STEEPEST);
  }

  zoomBy(factor) {
    this.zoom = clamp(this.zoom * factor, 1 / FARTHEST, 1 / NEAREST);
  }

  /** Move by parts of the photo's width as the viewer sees it. */
  moveBy(right, down, lens, width) {
    const each = width * this.pivot[2];
    this.shift[0] += (right * each) / lens[0];
    this.shift[1] += (down * each) / lens[1];
  }

  /** What the shader takes: row by row, the matrix of the turn. */
  get uniforms() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    const turn = [cy, 0, sy, sp * sy, cp, -sp * cy, -cp * sy, sp, cp * cy];
    const [x, y, z] = this.pivot;
    const offset = [x + this.shift[0], y + this.shift[1], z].map((value) => value / this.zoom);
    return { turn, pivot: this.pivot, offset };
  }

  get text() {
    const degrees = (angle) => Math.round((angle * 180) / Math.PI);
    const [right, down] = [degrees(-this.yaw), degrees(this.pitch)];
    const parts = [...(right ? [`turned ${Math.abs(right)}\u00b0 to the ${right > 0 ? "right" : "left"}`] : []), ...(down ? [`tilted ${Math.abs(down)}\u00b0 ${down > 0 ? "down" : "up"}`] : [])];
    return parts.length ? parts.join(", ") : "from where the photo was taken";
  }
}

/**
 * Hear what pointers do on the stage: `turn` and `move` take pixels, `light` the event, `zoom` a factor, `split` a place
 * of the divider, and `mode` says what dragging does.
 */
class Pointers {
  constructor(stage, actions) {
    this.stage = stage;
    this.actions = actions;
    this.fingers = new Map();
    stage.addEventListener("pointerdown", (event) => this.press(event));
    stage.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, (event) => this.release(event));
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      actions.zoom(wheelFactor(event));
    }, { passive: false });
  }

  press(event) {
    if (event.target.closest("button")) return;
    this.stage.setPointerCapture(event.pointerId);
    const what = event.target.closest(".divider") ? "split" : event.button > 0 || event.ctrlKey ? "move" : event.shiftKey ? "light" : this.actions.mode();
    this.fingers.set(event.pointerId, { x: event.clientX, y: event.clientY, what });
    this.stage.classList.toggle("dragging", what === "turn" || what === "move");
    if (what === "light") this.actions.light(event);
  }

  drag(event) {
    const finger = this.fingers.get(event.pointerId);
    if (!finger) return;
    const before = { ...finger };
    Object.assign(finger, { x: event.clientX, y: event.clientY });
    const [right, down] = [finger.x - before.x, finger.y - before.y];
    if (this.fingers.size === 2 && finger.what !== "split") {
      const { factor, shift } = pinchOf(this.fingers, event.pointerId, before);
      this.actions.zoom(factor);
      this.actions.move(...shift);
    } else if (finger.what === "light") this.actions.light(event);
    else if (finger.what === "split") this.actions.split(this.placeOf(event).x);
    else this.actions[finger.what](right, down);
  }

  release(event) {
    this.fingers.delete(event.pointerId);
    if (!this.fingers.size) this.stage.classList.remove("dragging");
  }

  /** Return where an event is on the stage, 0 to 1 both ways. */
  placeOf(event) {
    const box = this.stage.getBoundingClientRect();
    return { x: (event.clientX - box.left) / box.width, y: (event.clientY - box.top) / box.height };
  }
}
