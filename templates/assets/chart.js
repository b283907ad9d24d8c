// One line chart as SVG: axes with units, a legend of switches, and the values under the pointer.

import { make } from './dom.js';
import { timeOfDay } from './times.js';

/** A time in seconds since 1970, and then the values of all series. @typedef {number[]} Sample */
/** Series of one unit, each with its name and its column in samples; `most`: the end of the axis, if it is fixed.
 * @typedef {{ title: string, unit: string, series: [name: string, column: number][], most?: number, least?: number, whole?: boolean }} Group
 */
/** Shows the values of a time in all charts; without one, the newest. @typedef {(time?: number) => void} Point */

const SPAN = 600;
const BOX = { left: 46, right: 10, top: 10, bottom: 24, height: 220 };
const TICKS = [600, 480, 360, 240, 120, 0];

/**
 * @param {string} name
 * @param {Record<string, string | number>} attributes
 * @param {string} text
 */
function svg(name, attributes = {}, text = '') {
  const element = document.createElementNS('http://www.w3.org/2000/svg', name);
  for (const [key, value] of Object.entries(attributes)) {
    element.setAttribute(key, String(value));
  }
  element.textContent = text;
  return element;
}

/**
 * The least round number that is not below another: 1, 2 or 5 times a power of ten.
 * @param {number} number
 */
function roundUp(number) {
  const power = 10 ** Math.floor(Math.log10(number));
  return power * ([1, 2, 5].find((factor) => factor * power >= number * 0.9999) ?? 10);
}

export class Chart {
  #group;
  #hidden;
  #root = svg('svg', {
    tabindex: 0,
    role: 'slider',
    'aria-valuemin': -SPAN,
    'aria-valuemax': 0,
    'aria-valuenow': 0,
    preserveAspectRatio: 'none',
  });
  #axes = svg('g', { class: 'axes' });
  #lines = svg('g', { class: 'lines' });
  #cross = svg('line', { class: 'cross', visibility: 'hidden' });
  /** Where the value of each series is shown. @type {HTMLElement[]} */
  #values = [];
  #moment;
  /** @type {Sample[]} */
  #samples = [];
  /** The time under the pointer; `undefined` for the newest. @type {number | undefined} */
  #pointed;

  /**
   * Puts a chart into an element.
   * @param {HTMLElement} root
   * @param {Group} group
   * @param {Set<string>} hidden the names of series that are switched off
   * @param {() => void} switched a series was switched on or off
   * @param {Point} pointed
   */
  constructor(root, group, hidden, switched, pointed) {
    this.#group = group;
    this.#hidden = hidden;
    const legend = make('ul', { className: 'legend' });
    group.series.forEach(([name], index) => {
      const value = make('b', { textContent: '–' });
      const box = make('input', { type: 'checkbox', checked: !hidden.has(name) });
      const swatch = svg('svg', { class: `swatch s${index}`, viewBox: '0 0 20 8', 'aria-hidden': 'true' });
      swatch.append(svg('line', { x1: 0, x2: 20, y1: 4, y2: 4 }));
      box.addEventListener('change', () => {
        if (box.checked) {
          hidden.delete(name);
        } else {
          hidden.add(name);
        }
        switched();
      });
      legend.append(make('li', {}, make('label', {}, box, swatch, make('span', { textContent: name }), value)));
      this.#values.push(value);
      this.#lines.append(svg('polyline', { class: `s${index}` }));
    });
    this.#moment = make('p', { className: 'moment', textContent: 'now' });
    this.#root.append(this.#axes, this.#lines, this.#cross);
    const unit = group.unit ? ` (${group.unit})` : '';
    const title = make('h3', {}, group.title, make('span', { textContent: unit }));
    this.#root.setAttribute('aria-label', `${group.title}${unit} over the last ten minutes`);
    const head = make('figcaption', {}, title, this.#moment);
    root.append(make('figure', {}, head, make('div', { className: 'plot' }, this.#root), legend));
    this.#root.addEventListener('pointermove', (event) => pointed(this.#timeAt(event)));
    this.#root.addEventListener('pointerleave', () => pointed());
    this.#root.addEventListener('focus', () => this.#tell());
    this.#root.addEventListener('blur', () => pointed());
    this.#root.addEventListener('keydown', (event) => this.#key(event, pointed));
    new ResizeObserver(() => this.draw(this.#samples)).observe(this.#root);
  }

  get #width() {
    return Math.max(160, this.#root.clientWidth);
  }

  get #end() {
    return this.#samples.at(-1)?.[0] ?? Date.now() / 1000;
  }

  /** @param {number} time */
  #x(time) {
    const { left, right } = BOX;
    return left + (this.#width - left - right) * (1 - (this.#end - time) / SPAN);
  }

  /** @param {PointerEvent} event */
  #timeAt(event) {
    const { left, right } = BOX;
    const part = (event.clientX - this.#root.getBoundingClientRect().left - left) / (this.#width - left - right);
    return this.#end - SPAN * (1 - part);
  }

  /**
   * @param {KeyboardEvent} event
   * @param {Point} pointed
   */
  #key(event, pointed) {
    /** @type {Record<string, number>} */
    const steps = {
      ArrowLeft: -5,
      ArrowDown: -5,
      PageDown: -60,
      Home: -SPAN,
      ArrowRight: 5,
      ArrowUp: 5,
      PageUp: 60,
      End: SPAN,
    };
    const step = steps[event.key];
    if (!step && event.key !== 'Escape') {
      return;
    }
    event.preventDefault();
    const first = this.#samples[0]?.[0] ?? 0;
    const time = Math.max(first, (this.#pointed ?? this.#end) + (step ?? 0));
    pointed(step && time < this.#end ? time : undefined);
    this.#tell();
  }

  /** Puts the values into text for screen readers; not every second, which would be too much to listen to. */
  #tell() {
    const values = this.#group.series.map(([name], index) => `${name} ${this.#values[index]?.textContent}`);
    this.#root.setAttribute('aria-valuenow', String(Math.round((this.#pointed ?? this.#end) - this.#end)));
    this.#root.setAttribute('aria-valuetext', `${this.#moment.textContent}: ${values.join(', ')}`);
  }

  #top() {
    const { most, least = 1, whole, series } = this.#group;
    if (most) {
      return most;
    }
    const shown = series.filter(([name]) => !this.#hidden.has(name));
    const highest = Math.max(least, ...this.#samples.flatMap((sample) => shown.map(([, column]) => sample[column])));
    return whole ? 4 * Math.ceil(highest / 4) : roundUp(highest);
  }

  /** @param {Sample[]} samples */
  draw(samples) {
    this.#samples = samples;
    const { height, top, bottom } = BOX;
    const [width, most] = [this.#width, this.#top()];
    /** @param {number} value */
    const y = (value) => top + (height - top - bottom) * (1 - Math.min(value, most) / most);
    this.#root.setAttribute('viewBox', `0 0 ${width} ${height}`);
    this.#drawAxes(width, most, y);
    this.#group.series.forEach(([name, column], index) => {
      const line = this.#lines.children[index];
      const points = this.#hidden.has(name)
        ? []
        : samples.map((sample) => `${this.#x(sample[0]).toFixed(1)},${y(sample[column]).toFixed(1)}`);
      line?.setAttribute('points', points.join(' '));
    });
    this.#cross.setAttribute('y1', String(top));
    this.#cross.setAttribute('y2', String(height - bottom));
    this.point(this.#pointed);
  }

  /** The width and the maximum that the axes were drawn for. @type {string | undefined} */
  #drawn;

  /**
   * Draws the axes if they have changed: the newest sample is always at their end.
   * @param {number} width
   * @param {number} most
   * @param {(value: number) => number} y
   */
  #drawAxes(width, most, y) {
    const drawn = `${width} ${most}`;
    if (this.#drawn === drawn) {
      return;
    }
    this.#drawn = drawn;
    const { left, right, height, bottom } = BOX;
    const parts = [];
    for (let step = 0; step <= 4; ++step) {
      const value = (most * step) / 4;
      parts.push(
        svg('line', { class: step === 0 ? 'base' : 'grid', x1: left, x2: width - right, y1: y(value), y2: y(value) }),
      );
      parts.push(svg('text', { x: left - 6, y: y(value) + 4, 'text-anchor': 'end' }, this.#written(value)));
    }
    const ticks = width < 420 ? TICKS.filter((_, index) => index !== 1 && index !== 3 && index !== 4) : TICKS;
    for (const ago of ticks) {
      const x = this.#x(this.#end - ago);
      const anchor = ago === 0 ? 'end' : ago === SPAN ? 'start' : 'middle';
      parts.push(svg('line', { class: 'tick', x1: x, x2: x, y1: height - bottom, y2: height - bottom + 4 }));
      parts.push(svg('text', { x, y: height - 6, 'text-anchor': anchor }, ago === 0 ? 'now' : `−${ago / 60} min`));
    }
    this.#axes.replaceChildren(...parts);
  }

  /**
   * A number on the axis, with the unit where it fits.
   * @param {number} value
   */
  #written(value) {
    const { unit, most } = this.#group;
    const text = String(Number(value.toPrecision(3)));
    return most && unit === '%' ? `${text} %` : text;
  }

  /**
   * Shows the values of a time, or the newest.
   * @param {number} [time]
   */
  point(time) {
    const found = time === undefined ? undefined : this.#nearest(time);
    const sample = found ?? this.#samples.at(-1);
    this.#pointed = found?.[0];
    const moment = found ? `at ${timeOfDay(found[0])}` : 'now';
    if (this.#moment.textContent !== moment) {
      this.#moment.textContent = moment;
    }
    this.#cross.setAttribute('visibility', found ? 'visible' : 'hidden');
    if (!sample) {
      return;
    }
    const x = this.#x(sample[0]);
    this.#cross.setAttribute('x1', String(x));
    this.#cross.setAttribute('x2', String(x));
    const { unit, whole, series } = this.#group;
    series.forEach(([, column], index) => {
      const value = sample[column];
      const text = whole ? String(value) : unit === '%' ? value.toFixed(1) : value.toFixed(value < 1 ? 3 : 2);
      const shown = this.#values[index];
      if (shown) {
        shown.textContent = `${text} ${unit}`.trim();
      }
    });
  }

  /** @param {number} time */
  #nearest(time) {
    /** @type {Sample | undefined} */
    let best;
    for (const sample of this.#samples) {
      if (!best || Math.abs(sample[0] - time) < Math.abs(best[0] - time)) {
        best = sample;
      }
    }
    return best;
  }
}
