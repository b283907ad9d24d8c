// The three charts of a simulation server: eleven series over ten minutes, with a legend that switches them.

import { Chart } from './chart.js';

/** The series of each chart, by the headings of their columns; each has a colour of its own in its chart. */
const GROUPS = [
  {
    title: 'Load and memory', unit: '%', most: 100,
    series: ['CPU load', 'CPU memory', 'GPU load compute', 'GPU load memory', 'GPU memory', 'Swap', 'Disk'],
  },
  { title: 'Simulations', unit: '', whole: true, least: 4, series: ['Webots running', 'Webots idle'] },
  { title: 'Network', unit: 'MB/s', least: 0.1, series: ['Network sent', 'Network received'] },
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
    const columns = root.dataset.columns.split(', ');
    for (const { series, ...group } of GROUPS) {
      group.series = series.map((name) => [name, columns.indexOf(name)]);
      this.#charts.push(new Chart(root, group, this.#hidden, () => this.#switched(), (time) => this.#point(time)));
    }
  }

  #switched() {
    try {
      localStorage.setItem(STORE, JSON.stringify([...this.#hidden]));
    } catch {
      // A browser that keeps nothing forgets the choice.
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
