// The three charts of a simulation server: its readings over ten minutes, with a legend that switches them.

import { Chart } from './chart.js';

/** @typedef {import('./chart.js').Sample} Sample */

/** The charts: each has the columns whose names begin with `begin`, the first one all others. */
/** @type {(Omit<import('./chart.js').Group, 'series'> & { begin?: string })[]} */
const GROUPS = [
  { title: 'Load and memory', unit: '%', most: 100 },
  { title: 'Simulations', begin: 'Webots ', unit: '', whole: true, least: 4 },
  { title: 'Network', begin: 'Network ', unit: 'MB/s', least: 0.1 },
];
const KEPT = 600;
const STORE = 'hidden-series';

/** @returns {Set<string>} */
function hiddenSeries() {
  try {
    return new Set(JSON.parse(localStorage.getItem(STORE) ?? '[]'));
  } catch {
    return new Set();
  }
}

export class Charts {
  /** @type {Sample[]} */
  #samples = [];
  /** @type {Chart[]} */
  #charts = [];
  #hidden = hiddenSeries();

  /**
   * Puts the charts into an element that names the columns of a sample.
   * @param {HTMLElement} root
   */
  constructor(root) {
    const columns = root.dataset.columns ?? '';
    /** @type {[string, number][]} */
    const all = columns.split(', ').map((name, index) => [name, index]);
    /** @param {string} name */
    const groupOf = (name) => GROUPS.find(({ begin }) => begin && name.startsWith(begin)) ?? GROUPS[0];
    for (const group of GROUPS) {
      // The first column is the time.
      const series = all.slice(1).filter(([name]) => groupOf(name) === group);
      this.#charts.push(
        new Chart(
          root,
          { ...group, series },
          this.#hidden,
          () => this.#switched(),
          (time) => this.#point(time),
        ),
      );
    }
  }

  #switched() {
    try {
      localStorage.setItem(STORE, JSON.stringify([...this.#hidden]));
    } catch {
      // Without the browser's store, the choice is forgotten.
    }
    this.#draw();
  }

  /**
   * All charts show the same moment.
   * @param {number} [time]
   */
  #point(time) {
    this.#charts.forEach((chart) => chart.point(time));
  }

  #draw() {
    this.#charts.forEach((chart) => chart.draw(this.#samples));
  }

  /**
   * Takes all samples, the oldest first.
   * @param {Sample[]} samples
   */
  begin(samples) {
    this.#samples = samples.slice(-KEPT);
    this.#draw();
  }

  /**
   * Takes one more sample.
   * @param {Sample} sample
   */
  add(sample) {
    const newest = this.#samples.at(-1);
    if (newest && sample[0] <= newest[0]) {
      return;
    }
    this.#samples = [...this.#samples, sample].slice(-KEPT);
    this.#draw();
  }
}
