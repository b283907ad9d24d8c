// Checked by TypeScript, not run: the element has all that its types promise.

import { WebotsSimulation } from '../../templates/assets/embed.js';

/** @typedef {import('../../templates/embed.js').WebotsSimulation} Promised */

/** @type {Promised} */
export const element = new WebotsSimulation();

element.addEventListener('ended', (event) => event.detail.code.length);
element.addEventListener('time', (event) => event.detail.time.toFixed());
