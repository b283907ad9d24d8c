// The small viewer: a scene in three dimensions, its clock, and the buttons of a simulation.

import { Camera } from './camera.js';
import { make } from './dom.js';
import { Drawing } from './draw.js';
import { Scene, SceneError } from './scene.js';
import { Stream } from './stream.js';

export { SceneError } from './scene.js';

/** @typedef {import('./stream.js').Mode} Mode */

/** Number of lines of the simulation's console that are kept. */
const LINES = 200;

/**
 * What happens in the viewer. `heard`: the simulator has sent an update, for this time in
 * milliseconds.
 * @typedef {{ is: 'loading', status: string, percent: number }
 *   | { is: 'shown', title: string }
 *   | { is: 'mode', mode: Mode }
 *   | { is: 'heard', time: number }
 *   | { is: 'failed', why: import('./scene.js').SceneProblem }
 *   | { is: 'closed' }} ViewerEvent
 */

/**
 * `words`: what the viewer says; `kind`: the kind of stream, if it is known; `isOnlooker`: the simulation's time goes on; `isReadOnly`: without buttons
 * that change the simulation.
 * @typedef {{ words: import('./language.js').Words, kind?: string | undefined, isOnlooker?: boolean, isReadOnly?: boolean }} ViewerOptions
 */

export class SmallViewer {
  #stream;
  #tell;
  #words;
  /** @type {Scene | undefined} */
  #scene;
  #camera;
  #drawing;
  /** @type {Mode} */
  #mode = 'pause';
  /** The mode to go back to after a reset. @type {Mode | undefined} */
  #running;
  #isDrawn = false;
  #isFrozen = false;
  /** @type {string[]} */
  #lines = [];
  #parts;
  #resizes = new ResizeObserver(() => this.#redraw());

  /**
   * Shows the simulation at an address in an element. Throws if this browser can't draw.
   * @param {HTMLElement} stage
   * @param {string} url
   * @param {ViewerOptions} options
   * @param {(event: ViewerEvent) => void} tell
   */
  constructor(stage, url, { words, kind, isOnlooker = false, isReadOnly = false }, tell) {
    this.#tell = tell;
    this.#words = words;
    this.#parts = this.#build(isReadOnly);
    stage.replaceChildren(...this.#parts.all);
    this.#drawing = new Drawing(this.#parts.canvas);
    this.#camera = new Camera(this.#parts.canvas, () => this.#redraw());
    this.#resizes.observe(this.#parts.canvas);
    this.#stream = new Stream(url, { kind, isOnlooker }, (event) => this.#hear(event));
  }

  /** @param {import('./stream.js').StreamEvent} event */
  #hear(event) {
    switch (event.is) {
      case 'loading':
        return this.#tell(event);
      case 'model':
        return this.#show(event.xml);
      case 'update':
        this.#update(event.update);
        return this.#tell({ is: 'heard', time: event.update.time });
      case 'mode':
        return this.#enter(event.mode);
      case 'time':
        return this.#setTime(event.time);
      case 'reset':
        return this.#afterReset();
      case 'console':
        return this.#print(event.text);
      case 'closed':
        return this.#isFrozen ? undefined : this.#tell(event);
    }
  }

  /** @param {boolean} isReadOnly */
  #build(isReadOnly) {
    /**
     * @param {string} text
     * @param {() => void} action
     * @param {string} title
     */
    const button = (text, action, title) => {
      const made = make('button', { type: 'button', textContent: text, title, disabled: true });
      made.addEventListener('click', action);
      return made;
    };
    const { viewer } = this.#words;
    const play = button(viewer.play, () => this.#toggle(), viewer.playTitle);
    const step = button(viewer.step, () => this.#stream.send('step'), viewer.stepTitle);
    const reset = button(viewer.reset, () => this.reset(), viewer.resetTitle);
    const home = button(viewer.home, () => this.#camera.home(), viewer.homeTitle);
    const clock = make('span', { className: 'clock', id: 'clock', textContent: viewer.time(0) });
    clock.setAttribute('role', 'timer');
    clock.setAttribute('aria-label', viewer.clock);
    const mode = make('span', { className: 'mode', id: 'mode', textContent: viewer.modes.loading });
    const tools = make('div', { className: 'tools' }, play, step, reset, home, mode, clock);
    for (const one of [play, step, reset]) {
      one.hidden = isReadOnly;
    }
    tools.setAttribute('role', 'toolbar');
    tools.setAttribute('aria-label', viewer.tools);
    const canvas = make('canvas', { tabIndex: 0, id: 'view' });
    canvas.setAttribute('role', 'application');
    canvas.setAttribute('aria-label', viewer.view(''));
    const help = make('p', { className: 'help', id: 'view-help' }, make('small', { textContent: viewer.help }));
    canvas.setAttribute('aria-describedby', help.id);
    const lines = make('pre', { tabIndex: 0 });
    const output = make('details', { hidden: true }, make('summary', { textContent: viewer.console }), lines);
    return { play, step, reset, home, clock, mode, canvas, lines, output, all: [tools, canvas, help, output] };
  }

  /** @param {string} xml */
  #show(xml) {
    let scene;
    try {
      scene = new Scene(xml);
    } catch (error) {
      if (!(error instanceof SceneError)) {
        throw error;
      }
      this.#tell({ is: 'failed', why: error.code });
      return;
    }
    this.#scene = scene;
    this.#camera.home(scene.viewpoint);
    this.#setTime(0);
    for (const button of [this.#parts.play, this.#parts.step, this.#parts.reset, this.#parts.home]) {
      button.disabled = false;
    }
    this.#parts.canvas.setAttribute('aria-label', this.#words.viewer.view(scene.title));
    this.#tell({ is: 'shown', title: scene.title });
    this.#enter('pause');
  }

  /** @param {import('./stream.js').Update} update */
  #update(update) {
    this.#setTime(update.time);
    this.#scene?.update(update);
    this.#redraw();
  }

  /** @param {number} time in milliseconds */
  #setTime(time) {
    this.#parts.clock.textContent = this.#words.viewer.time(time);
  }

  /** @param {Mode} mode */
  #enter(mode) {
    this.#mode = mode;
    this.#parts.play.textContent = mode === 'pause' ? this.#words.viewer.play : this.#words.viewer.pause;
    this.#parts.mode.textContent = this.#words.viewer.modes[mode];
    if (!this.#isFrozen) {
      this.#tell({ is: 'mode', mode });
    }
  }

  /** Marks what is shown as out of date. */
  markStale() {
    this.#parts.mode.textContent = this.#words.viewer.modes.lost;
  }

  /** Keeps what is shown, and closes the connection. */
  freeze() {
    this.#isFrozen = true;
    this.markStale();
    this.close();
  }

  #toggle() {
    if (this.#mode === 'pause') {
      this.play();
    } else {
      this.pause();
    }
  }

  play() {
    this.#stream.send('real-time:-1');
  }

  pause() {
    this.#stream.send('pause');
  }

  /** Sets the simulation back to its beginning, from where it goes on if it runs. */
  reset() {
    this.#running = this.#mode === 'pause' ? undefined : this.#mode;
    this.#stream.send('pause');
    this.#stream.send('reset');
  }

  #afterReset() {
    if (this.#running) {
      this.#stream.send(`${this.#running}:-1`);
    }
    this.#running = undefined;
  }

  /** @param {string} text */
  #print(text) {
    this.#lines = [...this.#lines, ...text.split('\n')].slice(-LINES);
    this.#parts.lines.textContent = this.#lines.join('\n');
    this.#parts.output.hidden = false;
  }

  /** Draws in the next animation frame. */
  #redraw() {
    if (this.#isDrawn || !this.#scene) {
      return;
    }
    this.#isDrawn = true;
    requestAnimationFrame(() => {
      this.#isDrawn = false;
      if (this.#scene) {
        this.#drawing.draw(this.#scene, this.#camera);
      }
    });
  }

  close() {
    for (const button of [this.#parts.play, this.#parts.step, this.#parts.reset]) {
      button.disabled = true;
    }
    this.#resizes.disconnect();
    this.#stream.close();
  }
}
