// The three charts of a simulation server: its readings over ten minutes, with a legend that switches them.

import { Chart } from './chart.js';

/** The charts: each has the columns whose names begin with `begin`, the first one all others. */
const GROUPS = [
  { title: 'Load and memory', unit: '%', most: 100 },
  { title: 'Simulations', begin: 'Webots ', unit: '', whole: true, least: 4 },
  { title: 'Network', begin: 'Network ', unit: 'MB/s', least: 0.1 },
];
const KEPT = 600;
const STORE = 'hidden-series';

function hiddenSeries() {
  try {
    return new Set(JSON.parse(localStorage.getItem(STORE) ?? '[]'));
  } catch {
    return new Set();
  }
}

export class Charts {
  #samples = [];
  #charts = [];
  #hidden = hiddenSeries();

  /** Puts the charts into an element that names the columns of a sample. */
  constructor(root) {
    const all = root.dataset.columns.split(', ').map((name, index) => [name, index]);
    const groupOf = (name) => GROUPS.find(({ begin }) => begin && name.startsWith(begin)) ?? GROUPS[0];
    for (const group of GROUPS) {
      // The first column is the time.
      const series = all.slice(1).filter(([name]) => groupOf(name) === group);
      this.#charts.push(new Chart(root, { ...group, series }, this.#hidden, () => this.#switched(), (time) => this.#point(time)));
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

  /** All charts show the same moment. */
  #point(time) {
    this.#charts.forEach((chart) => chart.point(time));
  }

  #draw() {
    this.#charts.forEach((chart) => chart.draw(this.#samples));
  }

  /** Takes all samples, the oldest first. */
  begin(samples) {
    this.#samples = samples.slice(-KEPT);
    this.#draw();
  }

  /** Takes one more sample. */
  add(sample) {
    if (this.#samples.length > 0 && sample[0] <= this.#samples.at(-1)[0])
      return;
    this.#samples = [...this.#samples, sample].slice(-KEPT);
    this.#draw();
  }
}
