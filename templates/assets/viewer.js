// The viewer page: the availability light, the form, the steps, and the simulation.

import { forget, keep, kept } from './kept.js';
import { Lifeline } from './lifeline.js';
import { Simulation, advice } from './start.js';
import { SmallViewer } from './small_viewer.js';
import { isDemonstration } from './stream.js';
import { duration } from './times.js';

const find = (id) => document.getElementById(id);
const form = find('start');
let simulation;
let viewer;
/** Monitors the connection to a simulation that can be resumed. */
let lifeline;
let countdown;
/** The timer that shows how long a paused simulation has left. */
let idling;
/** The visitor's name, from the link to this page. */
const visitor = new URLSearchParams(location.search).get('name')?.trim() || undefined;
let wanted;
let patience;
/** Number of requests for another simulation server since the form was sent, and the timer of the next one. */
let askedAgain = 0;
let asking;

/** Maximum of these requests, and the pause before the first one in milliseconds; it doubles each time. */
const ASK_AGAIN = 3;
const FIRST_PAUSE = 1000;

const ANNOUNCEMENT = 'announcement:';

/** Refusals after which waiting helps: a slot becomes free when another client leaves. */
const BUSY = /no simulation server available|places .* are taken|Clients of your address have|You have \d+ places/i;
/** Pause before the next request although a server is free, in milliseconds; it doubles up to the longest. */
const FIRST_WAIT = 2000;
const LONGEST_WAIT = 30_000;
/** Longest random pause after a server has become free, so that not all waiting pages ask at once, in milliseconds. */
const JITTER = 3000;
/** The world that waits for a server, and the timer of its next try. */
let waiting;
let wait = FIRST_WAIT;

/* the light */

let door;
/** Number of answers still to come to requests that were given up. */
let stale = 0;
/** The last report whether a server is free: `1` or `0`. */
let word;

function openDoor() {
  stale = 0;
  word = undefined;
  const url = new URL('session?announcements=1', location.href);
  url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
  door = new WebSocket(url);
  door.addEventListener('open', () => announce(''));
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

/** Shows the administrator's announcement; without a text, hides it. */
function announce(text) {
  find('announcement').textContent = text;
  find('announcement').hidden = !text;
}

function hear(text) {
  if (text.startsWith(ANNOUNCEMENT)) {
    announce(text.slice(ANNOUNCEMENT.length).trim());
    return;
  }
  if (text === '1' || text === '0') {
    word = text;
    showWord();
    // The session server is reachable again.
    if (/session server/.test(find('problem-text').textContent))
      find('problem').hidden = true;
    if (waiting && text === '1')
      tryAgain(JITTER * Math.random());
  } else if (stale > 0)
    stale -= 1;
  else if (wanted)
    chosen(text);
}

function showWord() {
  if (word === '1')
    light('on', 'Available', 'A simulation server can take you.');
  else if (word === '0')
    light('off', 'Not available', 'All simulation servers are busy or do not answer.');
}

/** Shows a notice; without a text, hides it. */
function notice(text, more) {
  find('notice-text').textContent = text ?? '';
  find('notice-advice').textContent = more ?? '';
  find('notice').hidden = !text;
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
  // A sentence begins with a capital, but an address stays as it is.
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
  wait = FIRST_WAIT;
  const world = find('url').value.trim();
  // A link that starts the same world.
  history.replaceState(null, '', `?${new URLSearchParams({ url: world, ...(visitor && { name: visitor }) })}`);
  ask(world);
}

/** All servers are busy: the page tries again as soon as one is free. */
function waitForServer(world) {
  leave();
  clearSteps();
  waiting = { world };
  busy(true, 'Stop waiting');
  step({ step: 'session', state: 'doing', text: 'all are busy' });
  notice('All servers are busy.', 'It starts by itself when one is free.');
  find('spoken').textContent = 'All servers are busy. It starts by itself when one is free.';
  if (word === '1')
    tryAgain(wait * (0.5 + Math.random()));
  wait = Math.min(LONGEST_WAIT, 2 * wait);
}

function tryAgain(pause) {
  clearTimeout(waiting.timer);
  waiting.timer = setTimeout(() => {
    const { world } = waiting;
    waiting = undefined;
    askedAgain = 0;
    ask(world);
  }, pause);
}

function ask(world) {
  wanted = world;
  busy(true, find('notice').hidden ? 'Disconnect' : 'Stop waiting');
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
      refused(world, why);
    return;
  }
  notice();
  busy(true);
  step({ step: 'session', state: 'done', text: 'has chosen a simulation server' });
  follow(new Simulation(answer, { world, name: visitor }), answer, world);
}

function refused(world, why) {
  if (BUSY.test(why))
    waitForServer(world);
  else
    failed(why);
}

/** Shows the progress of a simulation; `isBack` if its client returns to it. */
function follow(current, server, world, isBack = false) {
  simulation = current;
  const on = (kind, handler) => current.addEventListener(kind, ({ detail }) => {
    if (simulation === current)
      handler(detail);
  });
  on('step', step);
  on('left', countDown);
  on('idle', (seconds) => tellIdle(seconds, current));
  on('watched', (now) => { find('watched').hidden = !now; });
  // The server sends it again if it still applies.
  find('watched').hidden = true;
  on('failed', (why) => {
    if (isBack)
      failed(ended(why));
    else
      refused(world, why);
  });
  on('elsewhere', (why) => (isBack ? failed(why) : askAgain(world, why)));
  on('ready', (address) => show(address, server, current, isBack));
  on('heard', () => lifeline?.alive());
  on('token', (token) => {
    keep({ server, world, token, absence: current.absence });
    lifeline ??= watch(current.absence);
    headerLinks(true);
  });
  on('broken', () => lifeline?.broken());
}

/** Why a simulation has ended, for a client that returns; if it returns too late, also how long it was away. */
function ended(why) {
  const silence = lifeline?.silence ?? 0;
  return silence > lifeline?.absence && /has ended$/.test(why) ? `${why}: there was no connection for ${duration(silence)}` : why;
}

/* coming back */

/** Shows that there is no connection as long as there is none, and tries to return. */
function watch(absence) {
  const watched = new Lifeline(absence);
  const on = (kind, handler) => watched.addEventListener(kind, ({ detail }) => handler(detail));
  let isTold = false;
  on('lost', ({ since, left }) => {
    const waits = left > 0 ? `Your simulation waits another ${duration(left)}.` : 'Your simulation may have ended.';
    notice(`No connection since ${duration(since)}.`, waits);
    light('', 'No connection', 'It is tried again and again.');
    viewer?.stale?.();
    if (!isTold)
      find('spoken').textContent = `No connection. ${waits}`;
    isTold = true;
  });
  on('found', () => {
    notice();
    showWord();
    if (isTold)
      find('spoken').textContent = 'The connection is there again.';
    isTold = false;
  });
  on('try', comeBack);
  on('refused', async () => {
    const answer = await fetch('load', { cache: 'no-store', signal: AbortSignal.timeout(3000) }).catch(() => undefined);
    if (answer?.ok && lifeline === watched)
      watched.refused();
  });
  on('over', (since) => failed(`There was no connection for ${duration(since)}: the simulation has ended.`));
  return watched;
}

function comeBack() {
  const left = kept();
  if (!left)
    return;
  simulation?.detach();
  // The server sends it again if it still applies.
  tellIdle();
  // Messages of the old stream are not a sign of life of the simulation's server.
  viewer?.freeze?.();
  follow(new Simulation(left.server, { token: left.token }), left.server, left.world, true);
}

/** Resumes the simulation of this tab after a reload, or a return to the page. */
function goOn() {
  const left = kept();
  const named = new URLSearchParams(location.search).get('url');
  if (!left || (named !== null && named !== left.world)) {
    forget();
    return;
  }
  find('url').value = left.world;
  clearSteps();
  busy(true);
  step({ step: 'session', state: 'done', text: 'is not asked again' });
  lifeline = watch(left.absence);
  headerLinks(true);
  lifeline.broken();
}

/** The page is left, perhaps only for a moment: the simulation waits if it can be resumed. */
function pause() {
  if (!kept()) {
    leave();
    return;
  }
  lifeline?.close();
  lifeline = undefined;
  const [oldViewer, oldSimulation] = [viewer, simulation];
  viewer = simulation = undefined;
  oldViewer?.close();
  oldSimulation?.detach();
}

/** While a simulation runs, links open in a new tab, because leaving the page could end it. */
function headerLinks(stay) {
  for (const link of document.querySelectorAll('header a')) {
    link.target = stay ? '_blank' : '';
    link.rel = stay ? 'noopener' : '';
  }
}

/**
 * A simulation server is stopping, unreachable, or can't start the simulation: the session server notices that within
 * seconds, and chooses another.
 */
function askAgain(world, why) {
  if (askedAgain === ASK_AGAIN) {
    refused(world, why);
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
  clearInterval(countdown);
  const end = Date.now() + 1000 * seconds;
  const tick = () => { find('left').textContent = `It will be closed in ${duration((end - Date.now()) / 1000)}.`; };
  tick();
  find('left').hidden = false;
  countdown = setInterval(tick, 1000);
}

/** Shows when a paused simulation ends, unless it is kept. */
function tellIdle(seconds = null, current = undefined) {
  clearInterval(idling);
  find('idle').hidden = seconds === null;
  if (seconds === null)
    return;
  const end = Date.now() + 1000 * seconds;
  const tick = () => {
    const left = duration((end - Date.now()) / 1000);
    find('idle-text').textContent = `The simulation is paused, and ends in ${left}.`;
    // If a controller has started the simulation, only its server still takes it for paused.
    if (viewer?.runs)
      current.keep();
  };
  tick();
  find('keep').onclick = () => current.keep();
  find('spoken').textContent = find('idle-text').textContent;
  idling = setInterval(tick, 1000);
}

/** The URL of Webots' own viewer: on the simulation server, or the configured one. */
async function webotsViewer(server) {
  const base = server.replace(/^ws/, 'http');
  try {
    const status = await (await fetch(`${base}/status`)).json();
    if (status.viewer)
      return `${base}/${status.viewer}`;
  } catch {
    // Another kind of server, without a viewer.
  }
  return form.dataset.script;
}

async function show(address, server, current, isBack) {
  step({ step: 'simulation', state: 'doing', text: 'connecting to the simulator' });
  const kind = find('kind').value;
  const script = kind === 'small' ? undefined : await webotsViewer(server);
  const small = !script || (kind === 'automatic' && await isDemonstration(address));
  if (simulation !== current)
    return;
  viewer?.close();
  if (small)
    showSmall(address, isBack);
  else
    showWebots(address, script);
  if (kind === 'webots' && small)
    find('spoken').textContent = 'Webots’ own viewer is not to be had here; the small viewer shows the simulation.';
}

function showSmall(address, isBack) {
  try {
    viewer = new SmallViewer(find('stage'), address, isBack);
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
    // On a phone the scene would be out of sight, below the steps.
    find('stage').scrollIntoView({ block: 'nearest' });
  });
  viewer.addEventListener('heard', () => lifeline?.alive());
  viewer.addEventListener('lost', ({ detail }) => {
    if (viewer !== shown || !simulation)
      return;
    if (detail)
      failed(`The scene can’t be shown: ${detail}.`);
    else if (seen)
      rejoin(shown);
    else
      failed(`The simulator could not be reached at ${address}.`);
  });
}

/** Either the simulator has ended, which the simulation server reports in a moment, or only the stream is lost. */
function rejoin(lost) {
  step({ step: 'simulation', state: 'failed', text: 'the simulator has closed its connection' });
  setTimeout(() => {
    if (viewer === lost && simulation)
      lifeline?.broken();
  }, 2000);
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

function busy(now, leaving = 'Disconnect') {
  find('connect').disabled = now;
  find('disconnect').disabled = !now;
  find('disconnect').textContent = leaving;
}

function leave() {
  clearInterval(countdown);
  tellIdle();
  clearTimeout(patience);
  clearTimeout(asking);
  clearTimeout(waiting?.timer);
  waiting = undefined;
  lifeline?.close();
  lifeline = undefined;
  forget();
  notice();
  showWord();
  headerLinks(false);
  if (wanted)
    stale += 1;
  find('left').hidden = true;
  find('watched').hidden = true;
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
  const text = simulation ? 'You have left the simulation; it has ended.' : 'You wait no longer.';
  leave();
  clearSteps();
  clearStage(text);
  find('spoken').textContent = text;
  find('connect').focus();
}

form.addEventListener('submit', start);
find('disconnect').addEventListener('click', disconnect);
for (const example of form.querySelectorAll('[data-url]')) {
  example.addEventListener('click', () => {
    find('url').value = example.dataset.url;
    find('connect').focus();
  });
}
find('url').value = new URLSearchParams(location.search).get('url') ?? '';
if (visitor) {
  find('visitor').textContent = `The administrator sees you as ${visitor}.`;
  find('visitor').hidden = false;
}
addEventListener('pagehide', pause);
// The browser shows the page from its back/forward cache.
addEventListener('pageshow', ({ persisted }) => persisted && goOn());
openDoor();
goOn();
