// Keeps a monitor page up to date: receives the server's events and updates what has changed. An event has parts (the
// contents of elements) and tables (their rows), as HTML that the server renders from the same templates as the page.

import { find, setText } from './dom.js';
import { follow } from './server_events.js';
import { makeSortable, sort } from './table.js';
import { showTimes } from './times.js';

/** Gets the numbers of an event, and whether events may have been missed before. @typedef {(sample: number[], fresh: boolean) => void} Listener */
/** A row of a table, as the server renders it. @typedef {{ key: string, html: string }} Row */
/** An event: parts by the ids of elements, tables by those of their bodies.
 * @typedef {{ parts?: Record<string, string>, tables?: Record<string, Row[]>, sample?: number[] }} Update
 */

/** @type {Listener[]} */
const listeners = [];
/** The HTML that each part and each row of a table was last filled with. @type {WeakMap<Element, string>} */
const known = new WeakMap();
/** The HTML of the cells of rows. @type {WeakMap<Element, string[]>} */
const cells = new WeakMap();
/** Whether events may have been missed before the next one. */
let fresh = false;
/** @type {string | undefined} */
let lastSample;

/**
 * Calls a function with the numbers of each event that has some.
 * @param {Listener} listener
 */
export function onSample(listener) {
  listeners.push(listener);
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

/** @param {Update} update */
function take({ parts = {}, tables = {}, sample = [] }) {
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
follow('events', take, {
  opened: () => {
    fresh = true;
  },
});
