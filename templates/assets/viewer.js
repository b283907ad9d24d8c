// The page on which visitors try worlds: a form around the element that runs them (`embed.js`).

import { WebotsSimulation } from '../embed.js';
import { find } from './dom.js';
import { wordsOfPage } from './language.js';

/** @typedef {import('../embed.js').StateDetail} StateDetail */

const search = new URLSearchParams(location.search);
/** Where the browser keeps the visitor's name. */
const NAME = 'webots-fleet name';
/** Only visitors whom nobody else names have it. */
const nameField = document.getElementById('name');
if (nameField instanceof HTMLInputElement) {
  nameField.value = search.get('name') ?? keptName();
}
const words = await wordsOfPage(search.get('lang'));
const place = find('place', HTMLElement);
const simulation = new WebotsSimulation();
simulation.id = 'simulation';
simulation.lang = words.language;
simulation.world = search.get('url') ?? '';
for (const [name, value] of [
  ['name', nameField instanceof HTMLInputElement ? nameField.value : search.get('name')],
  ['viewer-script', place.dataset.script],
  ['autostart', search.get('start') === '1' && !lacksName() ? '' : null],
  ['autoplay', search.get('play') === '1' ? '' : null],
]) {
  if (name && value !== null && value !== undefined) {
    simulation.setAttribute(name, value);
  }
}

/* the title of the page: the place in the line, and the call when it is the visitor's turn */

const TITLE = document.title;
let isCalled = false;

/** @param {StateDetail} detail */
function drawTitle({ ahead }) {
  if (!isCalled) {
    document.title = ahead === undefined ? TITLE : `(${ahead + 1}) ${TITLE}`;
  }
}

simulation.addEventListener('turn', () => {
  isCalled = document.hidden;
  document.title = isCalled ? `${words.line.turn} ${TITLE}` : TITLE;
});
document.addEventListener('visibilitychange', () => {
  if (!document.hidden && isCalled) {
    isCalled = false;
    document.title = TITLE;
  }
});
simulation.addEventListener('state', (event) => drawTitle(/** @type {CustomEvent<StateDetail>} */ (event).detail));

/* the form, which a page in a frame of another site does not have */

const form = document.getElementById('start');
if (form instanceof HTMLFormElement) {
  const address = find('url', HTMLInputElement);
  const viewers = find('kind', HTMLSelectElement);
  const connect = find('connect', HTMLButtonElement);
  const choice = find('choice', HTMLDetailsElement);
  address.value = simulation.world;
  form.addEventListener('submit', (event) => {
    event.preventDefault();
    const world = address.value.trim();
    if (nameField instanceof HTMLInputElement) {
      keepName(nameField.value.trim());
      simulation.setAttribute('name', nameField.value.trim());
    }
    // A link that starts the same world.
    search.set('url', world);
    history.replaceState(null, '', `?${search}`);
    simulation.world = world;
    simulation.setAttribute('viewer', viewers.value);
    simulation.start();
  });
  for (const example of form.querySelectorAll('[data-url]')) {
    example.addEventListener('click', () => {
      address.value = example.getAttribute('data-url') ?? '';
      connect.focus();
    });
  }
  simulation.addEventListener('state', (event) => {
    const { state, world } = /** @type {CustomEvent<StateDetail>} */ (event).detail;
    const isOver = state === 'idle' || state === 'ended';
    connect.disabled = !isOver;
    address.value = world ?? address.value;
    // The scene comes first while there is one.
    if (state === 'running') {
      choice.open = false;
    } else if (isOver) {
      choice.open = true;
    }
    if (state === 'idle') {
      connect.focus();
    }
    drawLinks(!isOver);
  });
  simulation.addEventListener('ready', () => simulation.scrollIntoView({ block: 'nearest' }));
}

/* the field for the name, which stands above the element in such a frame */

if (!form && nameField instanceof HTMLInputElement) {
  nameField.addEventListener('change', () => {
    keepName(nameField.value.trim());
    simulation.setAttribute('name', nameField.value.trim());
  });
  // Before the button of the element does it.
  place.addEventListener('click', startsWithName, { capture: true });
}

/** @param {Event} event */
function startsWithName(event) {
  const isStart = event.composedPath().some((part) => part instanceof Element && part.part.contains('start'));
  if (isStart && nameField instanceof HTMLInputElement && lacksName()) {
    nameField.value = '';
    nameField.reportValidity();
    event.stopPropagation();
  }
}

/**
 * While a simulation runs, links open in a new tab, because leaving the page could end it.
 * @param {boolean} opensTabs
 */
function drawLinks(opensTabs) {
  for (const anchor of document.querySelectorAll('header a')) {
    if (anchor instanceof HTMLAnchorElement) {
      anchor.target = opensTabs ? '_blank' : '';
      anchor.rel = opensTabs ? 'noopener' : '';
    }
  }
}

/** The name that this browser was given last; a browser may refuse to keep anything. */
function keptName() {
  try {
    return localStorage.getItem(NAME) ?? '';
  } catch {
    return '';
  }
}

/** @param {string} name */
function keepName(name) {
  try {
    localStorage.setItem(NAME, name);
  } catch {
    // It is asked for again.
  }
}

/** Whether a name is necessary, and not given. */
function lacksName() {
  return nameField instanceof HTMLInputElement && nameField.required && nameField.value.trim() === '';
}

place.replaceChildren(simulation);
