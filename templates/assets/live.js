// Keeps a monitor page up to date: receives the server's events and updates what has changed. An event has parts (the
// contents of elements) and tables (their rows), as HTML that the server renders from the same templates as the page.

import { find, setText } from './dom.js';
import { makeSortable, sort } from './table.js';
import { showTimes } from './times.js';

/** Gets the numbers of an event, and whether events may have been missed before. @typedef {(sample: number[], fresh: boolean) => void} Listener */
/** A row of a table, as the server renders it. @typedef {{ key: string, html: string }} Row */
/** An event: parts by the ids of elements, tables by those of their bodies.
 * @typedef {{ version?: string, parts?: Record<string, string>, tables?: Record<string, Row[]>, sample?: number[] }} Update
 */

/** @type {Listener[]} */
const listeners = [];
const lamp = find('live', HTMLElement);
/** The HTML that each part and each row of a table was last filled with. @type {WeakMap<Element, string>} */
const known = new WeakMap();
/** The HTML of the cells of rows. @type {WeakMap<Element, string[]>} */
const cells = new WeakMap();
/** @type {EventSource | undefined} */
let source;
/** Time of the last message from the server; it sends one every 15 seconds. */
let heard = Date.now();
/** Whether events may have been missed before the next one. */
let fresh = false;
/** @type {string | undefined} */
let lastSample;
const SILENCE = 40_000;

/**
 * Calls a function with the numbers of each event that has some.
 * @param {Listener} listener
 */
export function onSample(listener) {
  listeners.push(listener);
}

/**
 * @param {string} text
 * @param {boolean} lost
 */
function say(text, lost) {
  lamp.textContent = text;
  lamp.classList.toggle('lost', lost);
}

/**
 * The cells of a row of HTML.
 * @param {string} html
 */
function parsed(html) {
  const template = document.createElement('template');
  template.innerHTML = `<table><tbody><tr>${html}</tr></tbody></table>`;
  return [...(template.content.querySelector('tr')?.children ?? [])];
}

/**
 * Fills a row. Replaces only the cells that differ, so that a focused link stays focused and an opened list open.
 * @param {HTMLTableRowElement} row
 * @param {string} html
 */
function fill(row, html) {
  if (known.get(row) === html) {
    return;
  }
  known.set(row, html);
  const before = cells.get(row) ?? [];
  const after = parsed(html);
  cells.set(
    row,
    after.map((cell) => cell.outerHTML),
  );
  while (row.children.length > after.length) {
    row.lastElementChild?.remove();
  }
  after.forEach((cell, column) => {
    if (before[column] === cell.outerHTML) {
      return;
    }
    showTimes(cell);
    const old = row.children[column];
    if (old) {
      old.replaceWith(cell);
    } else {
      row.append(cell);
    }
  });
}

/**
 * @param {HTMLTableSectionElement} body
 * @param {Row[]} rows
 */
function fillTable(body, rows) {
  const present = new Map([...body.rows].map((row) => [row.dataset.key, row]));
  rows.forEach(({ key, html }, place) => {
    let row = present.get(key);
    present.delete(key);
    if (!row) {
      row = document.createElement('tr');
      row.setAttribute('role', 'row');
      row.dataset.key = key;
      body.append(row);
    }
    row.dataset.place = String(place);
    fill(row, html);
  });
  present.forEach((row) => row.remove());
  sort(body);
  filter(body);
}

/**
 * @param {Element} part
 * @param {string} html
 */
function fillPart(part, html) {
  if (known.get(part) === html) {
    return;
  }
  known.set(part, html);
  part.innerHTML = html;
  showTimes(part);
}

/**
 * Shows the rows that have all the words of the table's filter, if it has one.
 * @param {HTMLTableSectionElement} body
 */
function filter(body) {
  const field = document.querySelector(`[data-filter="${body.id}"]`);
  if (!(field instanceof HTMLInputElement)) {
    return;
  }
  const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
  const rows = [...body.rows];
  for (const row of rows) {
    const text = words.length > 0 ? (row.textContent ?? '').toLowerCase() : '';
    row.hidden = !words.every((word) => text.includes(word));
  }
  const shown = rows.filter((row) => !row.hidden).length;
  const said = words.length > 0 ? `${shown} of ${rows.length}` : '';
  const place = field.parentElement?.querySelector('[role=status]');
  if (place) {
    setText(place, said);
  }
}

/**
 * Notes what the server has rendered.
 * @param {HTMLTableSectionElement} body
 */
function noteRows(body) {
  [...body.rows].forEach((row, place) => {
    row.dataset.place = String(place);
    cells.set(
      row,
      [...row.children].map((cell) => cell.outerHTML),
    );
  });
}

/** @param {MessageEvent} event */
function take(event) {
  heard = Date.now();
  /** @type {Update} */
  const { version, parts = {}, tables = {}, sample = [] } = JSON.parse(event.data);
  if (version && version !== document.documentElement.dataset.version) {
    location.reload();
    return;
  }
  for (const [id, html] of Object.entries(parts)) {
    fillPart(find(id, HTMLElement), html);
  }
  for (const [id, rows] of Object.entries(tables)) {
    fillTable(find(id, HTMLTableSectionElement), rows);
  }
  if (sample.length && sample.join() !== lastSample) {
    lastSample = sample.join();
    listeners.forEach((listener) => listener(sample, fresh));
    fresh = false;
  }
}

/** A hidden tab does not listen: browsers allow few connections to one server. */
function listen() {
  if (document.hidden || source) {
    return;
  }
  heard = Date.now();
  source = new EventSource('events');
  source.addEventListener('open', () => {
    heard = Date.now();
    fresh = true;
    say('Live', false);
  });
  source.addEventListener('message', take);
  source.addEventListener('error', () => {
    lose();
    if (source?.readyState === EventSource.CLOSED) {
      rest();
      setTimeout(listen, 3000);
    }
  });
}

function lose() {
  const since = new Date(heard).toLocaleTimeString();
  if (!lamp.classList.contains('lost')) {
    say(`No connection since ${since}: what you see is old. Trying again …`, true);
  }
}

/** A server that hangs, or a network that drops everything, does not close the connection. */
setInterval(() => {
  if (source && Date.now() - heard > SILENCE) {
    lose();
    rest();
    listen();
  }
}, 5000);

function rest() {
  source?.close();
  source = undefined;
}

for (const table of document.querySelectorAll('table')) {
  const [body] = table.tBodies;
  if (body && table.querySelector('th[data-sort]')) {
    noteRows(body);
    makeSortable(table, body);
  }
}
for (const field of document.querySelectorAll('[data-filter]')) {
  field.addEventListener('input', () => {
    filter(find(field.getAttribute('data-filter') ?? '', HTMLTableSectionElement));
    // A list that has become shorter could end above the visible part.
    const section = field.closest('section');
    if (section && section.getBoundingClientRect().top < 0) {
      section.scrollIntoView();
    }
  });
}
showTimes(document);
document.addEventListener('visibilitychange', () => (document.hidden ? rest() : listen()));
addEventListener('pagehide', rest);
addEventListener('pageshow', listen);
listen();
