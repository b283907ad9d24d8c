// The three charts of a simulation server: eleven series over ten minutes, with a legend that switches them.

import { Chart } from './chart.js';

/** The columns of a sample that follow its time; each series has a colour of its own in its chart. */
const GROUPS = [
  {
    title: 'Load and memory', unit: '%', most: 100,
    series: [['CPU load', 3], ['CPU memory', 4], ['GPU load compute', 5], ['GPU load memory', 6], ['GPU memory', 7], ['Swap', 8], ['Disk', 9]],
  },
  { title: 'Simulations', unit: '', whole: true, least: 4, series: [['Webots running', 1], ['Webots idle', 2]] },
  { title: 'Network', unit: 'MB/s', least: 0.1, series: [['Network sent', 10], ['Network received', 11]] },
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

  /** Puts the charts into an element. */
  constructor(root) {
    for (const group of GROUPS)
      this.#charts.push(new Chart(root, group, this.#hidden, () => this.#switched(), (time) => this.#point(time)));
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
