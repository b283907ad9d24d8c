// What the viewer page does with the texts of simulation servers: `node replay.js FILE`. The file is a JSON array of
// transcripts, each the texts on one connection in their order. Prints an array with, for each, the state and the
// effects after each text, and what is shown at the end without the texts that are quoted from servers and projects.

import { readFileSync } from 'node:fs';

import { reasonOf } from '../../templates/assets/visit.js';
import { Visit } from './visitor.js';

const WORLD = 'https://github.com/lab/arm/blob/main/worlds/arm.wbt';

/** @param {string[]} texts */
function replay(texts) {
  const visit = new Visit().take({ type: 'connected' }, { type: 'available', now: true });
  visit.take({ type: 'submitted', world: WORLD }).answer('ws://one:2000').take({ type: 'opened' });
  const states = texts.map((text) => [visit.receive(text).state.is, ...visit.did()]);
  // Whatever the page does by itself later: it may ask again.
  visit.pass(3600);
  const { state } = visit;
  const { code, blame, retry } = ('problem' in state && reasonOf(state.problem)) || {};
  const { problem, progress, ...shown } = visit.view;
  const { at, is } = progress ?? {};
  return { states, later: [state.is, ...visit.did()], code, blame, retry, advice: problem?.advice, at, is, ...shown };
}

/** @type {string[][]} */
const transcripts = JSON.parse(readFileSync(process.argv[2] ?? '', 'utf8'));
process.stdout.write(JSON.stringify(transcripts.map(replay)));
