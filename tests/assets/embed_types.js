// Checked by TypeScript, not run: the element has all that its types promise.

import { WebotsSimulation } from '../../templates/assets/embed.js';

/** @typedef {import('../../templates/embed.js').WebotsSimulation} Promised */
/** @typedef {import('../../templates/embed.js').StateDetail} PromisedDetail */

/** @type {Promised} */
export const element = new WebotsSimulation();

/** @type {(detail: import('../../templates/assets/embed.js').StateDetail) => PromisedDetail} */
export const detail = (own) => own;

element.addEventListener('ended', (event) => event.detail.code.length);
element.addEventListener('time', (event) => event.detail.time.toFixed());
