// A camera that circles around a point: by pointer, by touch, and by keyboard.

import { add, cross, lookAt, pose, scale, turned, unit } from './matrix.js';

/** @typedef {import('./matrix.js').Vector} Vector */
/** @typedef {import('./scene.js').Viewpoint} Viewpoint */

const STEEPEST = 1.55;

export class Camera {
  #canvas;
  #changed;
  /** @type {Viewpoint} */
  #start = { position: [-5, 0, 3], orientation: [0, 1, 0, 0.5] };
  /** Where each pointer is. @type {Map<number, [number, number]>} */
  #pointers = new Map();
  /** What it circles around, from how far, and in which direction it looks; in metres and radians. @type {Vector} */
  target = [0, 0, 0];
  distance = 5;
  heading = 0;
  steepness = 0;

  /**
   * A camera of a canvas; `changed` is called after each move.
   * @param {HTMLCanvasElement} canvas
   * @param {() => void} changed
   */
  constructor(canvas, changed) {
    this.#canvas = canvas;
    this.#changed = changed;
    this.home();
    canvas.addEventListener('pointerdown', (event) => this.#down(event));
    canvas.addEventListener('pointermove', (event) => this.#move(event));
    canvas.addEventListener('pointerup', (event) => this.#pointers.delete(event.pointerId));
    canvas.addEventListener('pointercancel', (event) => this.#pointers.delete(event.pointerId));
    canvas.addEventListener('wheel', (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener('keydown', (event) => this.#key(event));
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  }

  /** Goes to a viewpoint, and circles around the point of the ground in the middle of the view. */
  home(viewpoint = this.#start) {
    this.#start = viewpoint;
    const forward = turned(pose([0, 0, 0], viewpoint.orientation), [1, 0, 0]);
    const { position } = viewpoint;
    const toGround = forward[2] < -0.05 ? -position[2] / forward[2] : 0;
    this.distance = toGround > 0.1 && toGround < 200 ? toGround : 5;
    this.target = add(position, scale(forward, this.distance));
    this.heading = Math.atan2(forward[1], forward[0]);
    this.steepness = Math.asin(Math.max(-1, Math.min(1, -forward[2])));
    this.#changed();
  }

  #forward() {
    const flat = Math.cos(this.steepness);
    return [flat * Math.cos(this.heading), flat * Math.sin(this.heading), -Math.sin(this.steepness)];
  }

  get eye() {
    return add(this.target, scale(this.#forward(), -this.distance));
  }

  matrix() {
    return lookAt(this.eye, this.target, [0, 0, 1]);
  }

  /**
   * @param {number} right
   * @param {number} up
   */
  #orbit(right, up) {
    this.heading -= right;
    this.steepness = Math.max(-STEEPEST, Math.min(STEEPEST, this.steepness + up));
    this.#changed();
  }

  /**
   * @param {number} right
   * @param {number} up
   */
  #shift(right, up) {
    const sideways = unit(cross(this.#forward(), [0, 0, 1]));
    const upwards = cross(sideways, this.#forward());
    this.target = add(this.target, add(scale(sideways, right * this.distance), scale(upwards, up * this.distance)));
    this.#changed();
  }

  /** @param {number} factor */
  #zoom(factor) {
    this.distance = Math.max(0.05, Math.min(1000, this.distance * factor));
    this.#changed();
  }

  /** @param {PointerEvent} event */
  #down(event) {
    this.#canvas.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  /** @param {PointerEvent} event */
  #move(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) {
      return;
    }
    /** @type {[number, number]} */
    const now = [event.clientX, event.clientY];
    const [x, y] = [(now[0] - before[0]) / this.#canvas.clientHeight, (now[1] - before[1]) / this.#canvas.clientHeight];
    const spread = () => {
      const [one, other] = [...this.#pointers.values()];
      return Math.hypot(one[0] - other[0], one[1] - other[1]) || 1;
    };
    if (this.#pointers.size === 2) {
      const wide = spread();
      this.#pointers.set(event.pointerId, now);
      this.#zoom(wide / spread());
      this.#shift(-x / 2, y / 2);
    } else if (event.shiftKey || event.buttons & 6) {
      this.#shift(-x, y);
    } else {
      this.#orbit(3 * x, 3 * y);
    }
    this.#pointers.set(event.pointerId, now);
  }

  /** @param {WheelEvent} event */
  #wheel(event) {
    event.preventDefault();
    this.#zoom(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 500))));
  }

  /** @param {KeyboardEvent} event */
  #key(event) {
    /** @type {(x: number, y: number) => void} */
    const move = event.shiftKey ? (x, y) => this.#shift(x, y) : (x, y) => this.#orbit(-2 * x, 2 * y);
    /** @type {Record<string, () => void>} */
    const keys = {
      ArrowLeft: () => move(-0.05, 0),
      ArrowRight: () => move(0.05, 0),
      ArrowUp: () => move(0, 0.05),
      ArrowDown: () => move(0, -0.05),
      '+': () => this.#zoom(0.9),
      '=': () => this.#zoom(0.9),
      '-': () => this.#zoom(1 / 0.9),
      Home: () => this.home(),
    };
    const action = keys[event.key];
    if (action && !event.ctrlKey && !event.altKey && !event.metaKey) {
      event.preventDefault();
      action();
    }
  }
}
