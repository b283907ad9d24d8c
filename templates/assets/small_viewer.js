// The small viewer: a scene in three dimensions, its clock, and the buttons of a simulation.

import { Camera } from './camera.js';
import { Drawing } from './draw.js';
import { Scene } from './scene.js';
import { Stream } from './stream.js';

/** Number of lines of the simulation's console that are kept. */
const LINES = 200;

function make(name, properties, ...children) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

export class SmallViewer extends EventTarget {
  #stream;
  #scene;
  #camera;
  #drawing;
  #mode = 'pause';
  /** The mode to go back to after a reset. */
  #running;
  #time = 0;
  #drawn = false;
  #isFrozen = false;
  #lines = [];
  #parts;
  #watch = new ResizeObserver(() => this.#redraw());

  /** Whether its user only watches. */
  #watches;

  /**
   * Shows the simulation at an address in an element. Its time goes on for a client that returns (`true`) or only
   * watches (`'watches'`). Events: `ready`, `loading` (text), `heard`, `lost`.
   */
  constructor(stage, url, isBack = false) {
    super();
    this.#watches = isBack === 'watches';
    this.#parts = this.#build();
    stage.replaceChildren(...this.#parts.all);
    this.#drawing = new Drawing(this.#parts.canvas);
    this.#camera = new Camera(this.#parts.canvas, () => this.#redraw());
    this.#watch.observe(this.#parts.canvas);
    this.#stream = new Stream(url, Boolean(isBack));
    const hear = (kind, handler) => this.#stream.addEventListener(kind, ({ detail }) => handler(detail));
    hear('loading', (text) => this.#tell('loading', text));
    hear('model', (xml) => this.#show(xml));
    hear('update', (update) => {
      this.#update(update);
      this.#tell('heard');
    });
    hear('mode', (mode) => this.#enter(mode));
    hear('time', (time) => this.#setTime(time));
    hear('reset', () => this.#afterReset());
    hear('console', (text) => this.#print(text));
    hear('closed', () => this.#isFrozen || this.#tell('lost'));
  }

  #build() {
    const button = (text, action, title) => {
      const made = make('button', { type: 'button', textContent: text, title, disabled: true });
      made.addEventListener('click', action);
      return made;
    };
    const play = button('Play', () => this.#toggle(), 'Run in real time, or pause');
    const step = button('Step', () => this.#stream.send('step'), 'One step of time');
    const reset = button('Reset', () => this.#reset(), 'Back to the beginning');
    const view = button('Home view', () => this.#camera.home(), 'Look from where the world says');
    const clock = make('span', { className: 'clock', id: 'clock', textContent: '0:00.000' });
    clock.setAttribute('role', 'timer');
    clock.setAttribute('aria-label', 'Simulation time');
    const mode = make('span', { className: 'mode', id: 'mode', textContent: 'loading' });
    const tools = make('div', { className: 'tools' }, play, step, reset, view, mode, clock);
    for (const one of [play, step, reset])
      one.hidden = this.#watches;
    tools.setAttribute('role', 'toolbar');
    tools.setAttribute('aria-label', 'Simulation');
    const title = make('p', { className: 'title' });
    const canvas = make('canvas', { tabIndex: 0, id: 'view' });
    canvas.setAttribute('role', 'application');
    canvas.setAttribute('aria-label', 'View of the scene');
    const help = make('p', { className: 'help', id: 'view-help' }, make('small', {
      textContent: 'Drag or use the arrow keys to look around; with Shift to move; wheel, pinch, + and − to come closer; Home to go back.',
    }));
    canvas.setAttribute('aria-describedby', help.id);
    const lines = make('pre', { tabIndex: 0 });
    const output = make('details', { hidden: true }, make('summary', { textContent: 'Console' }), lines);
    return { play, step, reset, view, clock, mode, title, canvas, lines, output, all: [tools, canvas, help, output] };
  }

  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }

  #show(xml) {
    try {
      this.#scene = new Scene(xml);
    } catch (error) {
      this.#tell('lost', error.message);
      return;
    }
    this.#camera.home(this.#scene.viewpoint);
    this.#setTime(0);
    for (const button of [this.#parts.play, this.#parts.step, this.#parts.reset, this.#parts.view])
      button.disabled = false;
    this.#parts.canvas.setAttribute('aria-label', `View of the scene ${this.#scene.title}`.trim());
    this.#enter('pause');
    this.#tell('ready', this.#scene.title);
  }

  #update(update) {
    this.#setTime(update.time);
    this.#scene?.update(update);
    this.#redraw();
  }

  #setTime(time) {
    this.#time = time;
    const seconds = Math.floor(time / 1000);
    const pad = (number, digits) => String(number).padStart(digits, '0');
    this.#parts.clock.textContent =
      `${Math.floor(seconds / 60)}:${pad(seconds % 60, 2)}.${pad(Math.round(time) % 1000, 3)}`;
  }

  #enter(mode) {
    this.#mode = mode;
    this.#parts.play.textContent = mode === 'pause' ? 'Play' : 'Pause';
    this.#parts.mode.textContent = mode === 'pause' ? 'paused' : mode.replace('-', ' ');
  }

  /** Whether the time of the simulation goes on, also if another client has started it. */
  get runs() {
    return !this.#isFrozen && this.#mode !== 'pause';
  }

  /** Marks what is shown as out of date. */
  stale() {
    this.#parts.mode.textContent = 'no connection';
  }

  /** Keeps what is shown, and closes the connection. */
  freeze() {
    this.#isFrozen = true;
    this.stale();
    this.close();
  }

  #toggle() {
    this.#stream.send(this.#mode === 'pause' ? 'real-time:-1' : 'pause');
  }

  #reset() {
    this.#running = this.#mode === 'pause' ? undefined : this.#mode;
    this.#stream.send('pause');
    this.#stream.send('reset');
  }

  #afterReset() {
    if (this.#running)
      this.#stream.send(`${this.#running}:-1`);
    this.#running = undefined;
  }

  #print(text) {
    this.#lines = [...this.#lines, ...text.split('\n')].slice(-LINES);
    this.#parts.lines.textContent = this.#lines.join('\n');
    this.#parts.output.hidden = false;
  }

  /** Draws in the next animation frame. */
  #redraw() {
    if (this.#drawn || !this.#scene)
      return;
    this.#drawn = true;
    requestAnimationFrame(() => {
      this.#drawn = false;
      this.#drawing.draw(this.#scene, this.#camera);
    });
  }

  close() {
    for (const button of [this.#parts.play, this.#parts.step, this.#parts.reset])
      button.disabled = true;
    this.#watch.disconnect();
    this.#stream.close();
  }
}
