// The viewer page: gives the events of the page, the servers and the viewer to the visit (`visit.js`), carries out its
// effects, and draws what it shows (`page_view.js`).

import { find, setText } from './dom.js';
import { forget, forgetTicket, keep, kept, keptTicket } from './kept.js';
import { wordsOfPage } from './language.js';
import { STEPS, timeLeft, titleOf, view, waitingNotice } from './page_view.js';
import { SessionServer } from './session_server.js';
import { SimulationLink } from './simulation_link.js';
import { Stage } from './stage.js';
import { ring } from './turn.js';
import { BEGIN, next } from './visit.js';

/** @typedef {import('./visit.js').Effect} Effect */
/** @typedef {import('./visit.js').Event} VisitEvent */

const search = new URLSearchParams(location.search);
const words = await wordsOfPage(search.get('lang'));
const form = find('start', HTMLFormElement);
const address = find('url', HTMLInputElement);
const viewers = find('kind', HTMLSelectElement);
const connect = find('connect', HTMLButtonElement);
const disconnect = find('disconnect', HTMLButtonElement);
/** The visitor's name, from the link to this page. */
const visitor = search.get('name')?.trim() || undefined;

const TITLE = document.title;
let shownTitle = TITLE;
let visit = BEGIN;
/** @type {ReturnType<typeof setTimeout> | undefined} */
let timer;
/** @type {SimulationLink | undefined} */
let link;
const stage = new Stage(find('stage', HTMLElement), words, take);
const sessionServer = new SessionServer(take);

/** @param {VisitEvent} event */
function take(event) {
  if (event.type === 'announced') {
    announce(event.text);
  }
  // The session server sends the announcement again, if there still is one.
  if (event.type === 'connected') {
    announce('');
  }
  const before = visit;
  const { visit: after, effects } = next(visit, event, Date.now(), Math.random);
  visit = after;
  for (const effect of effects) {
    carryOut(effect);
  }
  clearTimeout(timer);
  if (visit.wakeAt !== undefined) {
    timer = setTimeout(() => take({ type: 'tick' }), Math.max(0, visit.wakeAt - Date.now()));
  }
  // The turn is over once a simulation starts, and a place that was left is given up.
  if (event.type === 'left' || ['starting', 'running', 'lost', 'ended'].includes(visit.state.is)) {
    forgetTicket();
  }
  draw();
  const waits = waitingNotice(visit.state, words);
  if (waits && !waitingNotice(before.state, words)) {
    say(`${said}. ${waits.text} ${waits.advice}`);
  }
}

/** @param {Effect} effect */
function carryOut(effect) {
  switch (effect.do) {
    case 'ask':
      return sessionServer.ask(effect.id, effect.world);
    case 'connect':
      return open(effect);
    case 'send':
      return link?.send(effect.message);
    case 'store':
      return keep(effect.kept);
    case 'show':
      stage.show(effect, { choice: viewers.value, script: form.dataset.script, say });
      return undefined;
    case 'freeze':
      return stage.freeze();
    case 'leave':
      link?.leave();
      forget();
      return close();
    case 'detach':
      link?.detach();
      return close();
    case 'clear':
      return stage.clear(words.stage.clear);
    case 'clearLeft':
    case 'clearStopped':
      stage.clear(words.stage[effect.do]);
      say(words.stage[effect.do]);
      return undefined;
    case 'probe':
      probe();
      return undefined;
    case 'sayLost':
      return visit.state.is === 'lost' ? say(words.lost.said(timeLeft(visit.state, Date.now()))) : undefined;
    case 'sayFound':
      return say(words.lost.found);
    case 'stopWaiting':
      return sessionServer.stopWaiting();
    case 'sayTurn':
      say(words.line.turn);
      drawTitle(TITLE);
      return ring(words.line.turn);
  }
}

/** @param {Extract<Effect, { do: 'connect' }>} effect */
function open({ server, request }) {
  link?.detach();
  const start =
    'resume' in request
      ? request
      : { start: { url: request.world, pass: request.pass, resumable: true, name: visitor } };
  link = new SimulationLink(server, start, take);
}

function close() {
  link = undefined;
  stage.close();
}

/** Whether the session server answers, and with it the network. */
async function probe() {
  const answer = await fetch('load', { cache: 'no-store', signal: AbortSignal.timeout(3000) }).catch(() => undefined);
  if (answer?.ok) {
    take({ type: 'probed' });
  }
}

/* drawing */

/**
 * Shows a text in an element, or hides the element without one.
 * @param {HTMLElement} element
 * @param {string | undefined} text
 * @param {HTMLElement} place where the text is
 */
function show(element, text, place = element) {
  if (text !== undefined) {
    setText(place, text);
  }
  element.hidden = text === undefined;
}

/**
 * Sets the title of the page, unless that says that it is the visitor's turn.
 * @param {string} title
 */
function drawTitle(title) {
  if (title !== shownTitle) {
    document.title = title;
    shownTitle = title;
  }
}

/**
 * Tells screen readers something.
 * @param {string} text
 */
function say(text) {
  find('spoken', HTMLElement).textContent = text;
}

/**
 * Shows the administrator's announcement; without a text, hides it.
 * @param {string} text
 */
function announce(text) {
  show(find('announcement', HTMLElement), text || undefined);
}

function draw() {
  const shown = view(visit, Date.now(), words);
  drawTitle(titleOf(visit.state, TITLE));
  drawAvailability(shown.lamp, shown.availability);
  drawProgress(shown.progress);
  drawNotice('notice', shown.notice);
  drawNotice('problem', shown.problem);
  show(find('problem-sentence', HTMLElement), shown.problem?.sentence);
  show(find('problem-output', HTMLElement), shown.problem?.output, find('problem-output-text', HTMLElement));
  drawIdle(shown.idle);
  show(find('left', HTMLElement), shown.closes);
  find('watched', HTMLElement).hidden = !shown.isWatched;
  connect.disabled = shown.leave !== undefined;
  disconnect.disabled = shown.leave === undefined;
  setText(disconnect, shown.leave ?? words.buttons.leave);
  // While a simulation runs, links open in a new tab, because leaving the page could end it.
  for (const anchor of document.querySelectorAll('header a')) {
    if (!(anchor instanceof HTMLAnchorElement)) {
      continue;
    }
    anchor.target = shown.opensTabs ? '_blank' : '';
    anchor.rel = shown.opensTabs ? 'noopener' : '';
  }
}

/**
 * @param {'on' | 'off' | undefined} lamp
 * @param {string[]} texts
 */
function drawAvailability(lamp, [word = '', text = '']) {
  const { classList } = find('availability', HTMLElement);
  for (const name of ['on', 'off']) {
    classList.toggle(name, name === lamp);
  }
  setText(find('availability-word', HTMLElement), word);
  setText(find('availability-text', HTMLElement), text);
}

/**
 * @param {'notice' | 'problem'} id
 * @param {import('./page_view.js').Notice | undefined} notice
 */
function drawNotice(id, notice) {
  setText(find(`${id}-text`, HTMLElement), notice?.text ?? '');
  setText(find(`${id}-advice`, HTMLElement), notice?.advice ?? '');
  find(id, HTMLElement).hidden = !notice;
}

/** @param {string | undefined} text */
function drawIdle(text) {
  const element = find('idle', HTMLElement);
  const isNew = element.hidden && text !== undefined;
  show(element, text, find('idle-text', HTMLElement));
  if (isNew) {
    say(text);
  }
}

/** What was last said of the steps. */
let said = '';

/** @param {import('./page_view.js').Progress | undefined} progress */
function drawProgress(progress) {
  const at = progress ? STEPS.indexOf(progress.at) : -1;
  STEPS.forEach((name, index) => {
    const item = find(`step-${name}`, HTMLElement);
    const state = index < at ? 'done' : index === at ? progress?.is : undefined;
    for (const one of ['doing', 'done', 'failed']) {
      item.classList.toggle(one, one === state);
    }
    if (state === 'doing') {
      item.setAttribute('aria-current', 'step');
    } else {
      item.removeAttribute('aria-current');
    }
    const note = item.querySelector('small');
    if (!note) {
      return;
    }
    // What the step is, as long as there is nothing to say of it.
    item.dataset.text ??= note.textContent ?? '';
    setText(note, progress?.notes[name] || item.dataset.text);
    if (state === 'doing') {
      sayStep(`${item.querySelector('b')?.textContent}: ${note.textContent}`);
    }
  });
  if (!progress) {
    said = '';
  }
}

/** @param {string} text */
function sayStep(text) {
  if (text === said) {
    return;
  }
  said = text;
  say(text);
}

/* the page */

/** Resumes the simulation of this tab after a reload, or a return to the page. */
function restore() {
  const simulation = kept();
  const named = search.get('url');
  const waits = keptTicket();
  if (!simulation && waits && (named === null || named === waits.world)) {
    address.value = waits.world;
    take({ type: 'awaited', world: waits.world });
    return;
  }
  if (!simulation || (named !== null && named !== simulation.world)) {
    forget();
    return;
  }
  address.value = simulation.world;
  take({ type: 'restored', kept: simulation });
}

form.addEventListener('submit', (event) => {
  event.preventDefault();
  const world = address.value.trim();
  // A link that starts the same world.
  search.set('url', world);
  history.replaceState(null, '', `?${search}`);
  take({ type: 'submitted', world });
});
disconnect.addEventListener('click', () => {
  take({ type: 'left' });
  connect.focus();
});
find('keep', HTMLButtonElement).addEventListener('click', () => take({ type: 'keep' }));
for (const example of form.querySelectorAll('[data-url]')) {
  example.addEventListener('click', () => {
    address.value = example.getAttribute('data-url') ?? '';
    connect.focus();
  });
}
address.value = search.get('url') ?? '';
if (visitor) {
  show(find('visitor', HTMLElement), words.visitor(visitor));
}
addEventListener('online', () => take({ type: 'online' }));
// The page is left, perhaps only for a moment: a simulation that can be resumed waits.
addEventListener('pagehide', () => take({ type: 'hidden' }));
// The browser shows the page from its back/forward cache.
addEventListener('pageshow', ({ persisted }) => persisted && restore());
restore();
