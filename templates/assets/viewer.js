// The viewer page: the availability light, the form, the steps, and the simulation.

import { Simulation, advice } from './start.js';
import { SmallViewer } from './small_viewer.js';
import { isDemonstration } from './stream.js';
import { duration } from './times.js';

const find = (id) => document.getElementById(id);
const form = find('start');
let simulation;
let viewer;
let countdown;
let wanted;
let patience;
/** How often another simulation server was asked for since the form was sent; and the timer for the next time. */
let askedAgain = 0;
let asking;

/** How often another simulation server is asked for at most; and before the first time, in milliseconds, doubled each time. */
const ASK_AGAIN = 3;
const FIRST_PAUSE = 1000;

/* the light */

let door;
/** How many answers nobody waits for any more are still to come. */
let stale = 0;

function openDoor() {
  stale = 0;
  const url = new URL('session', location.href);
  url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
  door = new WebSocket(url);
  door.addEventListener('message', ({ data }) => hear(data));
  door.addEventListener('close', () => {
    light('', 'No connection', 'to the session server. Trying again …');
    if (wanted)
      failed('The session server could not be reached.');
    setTimeout(openDoor, 2000);
  });
}

function light(state, word, text) {
  find('light').classList.remove('on', 'off');
  if (state)
    find('light').classList.add(state);
  find('light-word').textContent = word;
  find('light-text').textContent = text;
}

function hear(text) {
  if (text === '1')
    light('on', 'Available', 'A simulation server can take you.');
  else if (text === '0')
    light('off', 'Not available', 'All simulation servers are busy or do not answer.');
  else if (stale > 0)
    stale -= 1;
  else if (wanted)
    chosen(text);
}

/* the steps */

function step({ step: name, state, text }) {
  const item = document.querySelector(`[data-step="${name}"]`);
  item.classList.remove('doing', 'done', 'failed');
  item.classList.add(state);
  if (state === 'doing')
    item.setAttribute('aria-current', 'step');
  else
    item.removeAttribute('aria-current');
  if (text)
    item.querySelector('small').textContent = text;
  if (state === 'doing')
    find('spoken').textContent = `${item.querySelector('b').textContent}: ${text}`;
}

function clearSteps() {
  for (const item of find('steps').children) {
    item.dataset.text ??= item.querySelector('small').textContent;
    item.querySelector('small').textContent = item.dataset.text;
    item.classList.remove('doing', 'done', 'failed');
    item.removeAttribute('aria-current');
  }
}

function failed(text) {
  const current = document.querySelector('.steps .doing, .steps li:not(.done)') ?? document.querySelector('[data-step="simulation"]');
  step({ step: current.dataset.step, state: 'failed' });
  // A sentence; but what begins with an address is left as it is.
  find('problem-text').textContent = text.replace(/^[a-z]+ /, (word) => word[0].toUpperCase() + word.slice(1));
  find('problem-advice').textContent = advice(text);
  find('problem').hidden = false;
  leave();
}

/* the way */

function start(event) {
  event.preventDefault();
  leave();
  clearSteps();
  clearStage('The simulation appears here.');
  find('problem').hidden = true;
  askedAgain = 0;
  ask(find('url').value.trim());
}

function ask(world) {
  wanted = world;
  busy(true);
  step({ step: 'session', state: 'doing', text: askedAgain ? 'choosing another simulation server' : 'choosing a simulation server' });
  if (door.readyState !== WebSocket.OPEN) {
    wanted = undefined;
    failed('The session server could not be reached.');
    return;
  }
  door.send(JSON.stringify({ url: wanted }));
  patience = setTimeout(() => failed('The session server does not answer.'), 10_000);
}

function chosen(answer) {
  clearTimeout(patience);
  const world = wanted;
  wanted = undefined;
  if (answer.startsWith('Error:')) {
    const why = answer.slice('Error:'.length).trim();
    if (askedAgain)
      askAgain(world, why);
    else
      failed(why);
    return;
  }
  step({ step: 'session', state: 'done', text: 'has chosen a simulation server' });
  const current = new Simulation(answer, world);
  simulation = current;
  const on = (kind, handler) => current.addEventListener(kind, ({ detail }) => {
    if (simulation === current)
      handler(detail);
  });
  on('step', step);
  on('left', countDown);
  on('failed', failed);
  on('elsewhere', (why) => askAgain(world, why));
  on('ready', (address) => show(address, answer, current));
}

/**
 * A simulation server is about to end, or gone, or can't start the simulation: the session server hears of that within
 * seconds, and chooses another.
 */
function askAgain(world, why) {
  if (askedAgain === ASK_AGAIN) {
    failed(why);
    return;
  }
  askedAgain += 1;
  leave();
  clearSteps();
  busy(true);
  step({ step: 'session', state: 'doing', text: `another one is asked for: ${why}` });
  asking = setTimeout(() => ask(world), FIRST_PAUSE * 2 ** (askedAgain - 1));
}

function countDown(seconds) {
  const end = Date.now() + 1000 * seconds;
  const tick = () => { find('left').textContent = `It will be closed in ${duration((end - Date.now()) / 1000)}.`; };
  tick();
  find('left').hidden = false;
  countdown = setInterval(tick, 1000);
}

/** Where Webots' own viewer can be had: from the simulation server, or from the configured address. */
async function webotsViewer(server) {
  const base = server.replace(/^ws/, 'http');
  try {
    const status = await (await fetch(`${base}/status`)).json();
    if (status.viewer)
      return `${base}/${status.viewer}`;
  } catch {
    // Another kind of server, which has none.
  }
  return form.dataset.script;
}

async function show(address, server, current) {
  step({ step: 'simulation', state: 'doing', text: 'connecting to the simulator' });
  const kind = find('kind').value;
  const script = kind === 'small' ? undefined : await webotsViewer(server);
  const small = !script || (kind === 'automatic' && await isDemonstration(address));
  if (simulation !== current)
    return;
  if (small)
    showSmall(address);
  else
    showWebots(address, script);
  if (kind === 'webots' && small)
    find('spoken').textContent = 'Webots’ own viewer is not to be had here; the small viewer shows the simulation.';
}

function showSmall(address) {
  try {
    viewer = new SmallViewer(find('stage'), address);
  } catch (error) {
    failed(`The scene can’t be shown: ${error.message}.`);
    return;
  }
  const shown = viewer;
  let seen = false;
  viewer.addEventListener('loading', ({ detail }) => step({ step: 'simulation', state: 'doing', text: detail }));
  viewer.addEventListener('ready', ({ detail }) => {
    seen = true;
    step({ step: 'simulation', state: 'done', text: detail || 'is shown' });
    // On a phone the scene would lie below the steps.
    find('stage').scrollIntoView({ block: 'nearest' });
  });
  viewer.addEventListener('lost', ({ detail }) => {
    if (viewer !== shown || !simulation)
      return;
    if (detail)
      failed(`The scene can’t be shown: ${detail}.`);
    else if (seen)
      step({ step: 'simulation', state: 'failed', text: 'the simulator has closed its connection' });
    else
      failed(`The simulator could not be reached at ${address}.`);
  });
}

function showWebots(address, script) {
  const frame = document.createElement('iframe');
  frame.title = 'Webots’ viewer';
  frame.allow = 'fullscreen';
  frame.src = `webots-viewer#${new URLSearchParams({ script, stream: address })}`;
  find('stage').replaceChildren(frame);
  viewer = { close: () => frame.remove() };
  step({ step: 'simulation', state: 'done', text: 'is shown by Webots’ own viewer' });
}

/* leaving */

function busy(now) {
  find('connect').disabled = now;
  find('disconnect').disabled = !now;
}

function leave() {
  clearInterval(countdown);
  clearTimeout(patience);
  clearTimeout(asking);
  if (wanted)
    stale += 1;
  find('left').hidden = true;
  wanted = undefined;
  const [oldViewer, oldSimulation] = [viewer, simulation];
  viewer = simulation = undefined;
  oldViewer?.close();
  oldSimulation?.close();
  busy(false);
}

function clearStage(text) {
  find('stage').replaceChildren(Object.assign(document.createElement('p'), { className: 'none empty', textContent: text }));
}

function disconnect() {
  leave();
  clearSteps();
  const text = 'You have left the simulation; it has ended.';
  clearStage(text);
  find('spoken').textContent = text;
  find('connect').focus();
}

/** The page may reach the fleet alone; a server that calls itself otherwise than the fleet does is a stranger. */
function forbidden({ effectiveDirective, blockedURI }) {
  if (simulation && effectiveDirective === 'connect-src')
    failed(`This page may not connect to ${blockedURI}: no simulation server of the fleet is known by that name.`);
}

form.addEventListener('submit', start);
document.addEventListener('securitypolicyviolation', forbidden);
find('disconnect').addEventListener('click', disconnect);
for (const example of form.querySelectorAll('[data-url]')) {
  example.addEventListener('click', () => {
    find('url').value = example.dataset.url;
    find('connect').focus();
  });
}
find('url').value = new URLSearchParams(location.search).get('url') ?? '';
addEventListener('pagehide', leave);
openDoor();
