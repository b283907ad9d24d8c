// The page of the class: all simulations of the fleet and all who wait, live. The server sends what has changed as data;
// what users name becomes text here, never markup.

import './announce.js';
import { find, make, setText } from './dom.js';
import { showReady } from './lessons.js';
import { follow } from './server_events.js';
import { makeSortable, sort as sortTable } from './table.js';
import { timeOfDay } from './times.js';

/** Somebody of the class, as the server knows them.
 * @typedef {{ id: string, server?: string, world: string, user?: string, label?: string, state: string, since: number,
 *   awayUntil?: number, cpu?: number, realTime?: number }} Entry
 */
/** A simulation server. @typedef {{ address: string, page: string, state: string, note: string, simulations?: number }} Server */
/** An event. @typedef {{ all?: boolean, changed?: Entry[], gone?: [string | null, string][],
 *   servers?: Server[], ready?: import('./lessons.js').ReadyWorld[], announcement?: string }} Update
 */

/** A row of the table. @typedef {{ entry: Entry, row: HTMLTableRowElement, text: string[] }} Row */

const body = find('class', HTMLTableSectionElement);
const field = find('filter', HTMLInputElement);
const all = find('stop-all', HTMLButtonElement);
const dialog = find('stop', HTMLDialogElement);
const problem = find('stop-problem', HTMLElement);
const reason = find('stop-reason', HTMLInputElement);
/** By server and id. @type {Map<string, Row>} */
const rows = new Map();
/** How many have each name. @type {Map<string, number>} */
const names = new Map();
/** The simulations that the dialog is about. @type {Entry[]} */
let chosen = [];
/** Most ids in one order. */
const BATCH = 200;

/** The states as text, where the name is not the text. @type {Record<string, string>} */
const WORDS = { waiting: 'waits in line', queued: 'waits', checkingout: 'checking out' };

/** @param {Entry} entry */
const nameOf = (entry) => entry.user ?? entry.label ?? '';
/** @param {Entry} entry */
const worldOf = (entry) => entry.world.split('/').pop() ?? '';
/** The number of a simulation on its server, or of a ticket. @param {Entry} entry */
const numberOf = (entry) => entry.id.split('-').pop() ?? '';
/** @param {string} text */
const wordsOf = (text) =>
  text
    .toLowerCase()
    .split(/[^\p{L}\p{N}]+/u)
    .filter(Boolean);
/** @param {string | null | undefined} server @param {string} id */
const keyOf = (server, id) => `${server ?? ''} ${id}`;

/**
 * @param {string} label
 * @param {string | number} value
 * @param {(Node | string)[]} children
 */
function cell(label, value, ...children) {
  const one = make('td', {}, ...children);
  one.setAttribute('role', 'cell');
  one.dataset.label = label;
  one.dataset.value = String(value);
  return one;
}

const none = () => make('span', { className: 'none' }, '–');

/** Who it is. Those with one name are told apart by the number of their simulation at its server. @param {Entry} entry */
function who(entry) {
  const head = make('th', {});
  head.setAttribute('role', 'rowheader');
  head.scope = 'row';
  head.dataset.value = nameOf(entry);
  if (entry.user) {
    head.append(make('b', {}, entry.user));
  }
  if (entry.label) {
    head.append(make('span', {}, entry.label, ' ', make('small', {}, 'unverified')));
  }
  if (!nameOf(entry)) {
    head.append(none());
  } else if ((names.get(nameOf(entry)) ?? 0) > 1) {
    const where = entry.server ? ` at ${entry.server}` : '';
    head.append(make('small', { className: 'twin' }, `no. ${numberOf(entry)}${where}`));
  }
  return head;
}

/** @param {Entry} entry */
function worldCell(entry) {
  const isUrl = /^https?:/.test(entry.world);
  const link = isUrl ? make('a', { href: entry.world, rel: 'noreferrer' }, worldOf(entry)) : worldOf(entry);
  return cell('World', entry.world, link);
}

/** @param {Entry} entry */
function serverCell(entry) {
  if (!entry.server) {
    return cell('Server', '', none());
  }
  const href = `visit?server=${encodeURIComponent(entry.server)}`;
  return cell('Server', entry.server, make('a', { href }, entry.server));
}

/** @param {Entry} entry */
function stateCell(entry) {
  const words = WORDS[entry.state] ?? entry.state;
  const one = cell('State', words, make('span', { className: `state ${entry.state}` }, words));
  if (entry.awayUntil) {
    one.append(make('small', {}, `client away until ${timeOfDay(entry.awayUntil)}`));
  }
  return one;
}

/**
 * @param {string} label
 * @param {number | undefined} percent
 */
function percentCell(label, percent) {
  const one = cell(label, percent ?? -1, percent === undefined ? none() : `${percent} %`);
  one.className = 'number';
  return one;
}

/** @param {Entry} entry */
function actions(entry) {
  const whose = make('span', { className: 'spoken' }, ` ${nameOf(entry)} ${worldOf(entry)}`);
  const watch = cell('Watch', '');
  if (entry.state === 'idle' || entry.state === 'running') {
    const href = `visit?${new URLSearchParams({ id: entry.id, server: entry.server ?? '' })}`;
    watch.append(make('a', { href, target: '_blank', rel: 'noopener' }, 'Watch', whose.cloneNode(true)));
  } else {
    watch.append(none());
  }
  const stop = cell('Action', '');
  if (entry.server) {
    const button = make('button', { type: 'button' }, 'Stop', whose);
    button.addEventListener('click', () => ask([entry]));
    stop.append(button);
  } else {
    stop.append(none());
  }
  return [watch, stop];
}

/** Replaces only the cells that differ, so that a focused button stays focused. @param {Row} one */
function fill({ entry, row }) {
  const since = make('time', { dateTime: new Date(1000 * entry.since).toISOString() }, timeOfDay(entry.since));
  const after = [
    who(entry),
    worldCell(entry),
    serverCell(entry),
    stateCell(entry),
    cell('Since', entry.since, since),
    percentCell('Real time', entry.realTime),
    percentCell('CPU', entry.cpu),
    ...actions(entry),
  ];
  after.forEach((one, column) => {
    const old = row.children[column];
    if (!old) {
      row.append(one);
    } else if (old.outerHTML !== one.outerHTML) {
      old.replaceWith(one);
    }
  });
}

/** @param {Entry} entry @param {number} change */
function count(entry, change) {
  const name = nameOf(entry);
  const before = names.get(name) ?? 0;
  names.set(name, before + change);
  // The others of this name are told apart from now on, or no longer.
  if (name && Math.max(before, before + change) === 2) {
    for (const one of rows.values()) {
      if (nameOf(one.entry) === name) {
        fill(one);
      }
    }
  }
}

/** @param {Entry} entry */
function put(entry) {
  const key = keyOf(entry.server, entry.id);
  let one = rows.get(key);
  if (one) {
    const before = one.entry;
    one.entry = entry;
    if (nameOf(before) !== nameOf(entry)) {
      count(before, -1);
      count(entry, 1);
    }
  } else {
    const row = make('tr', {});
    row.setAttribute('role', 'row');
    row.dataset.key = key;
    row.dataset.place = String(entry.since);
    one = { entry, row, text: [] };
    rows.set(key, one);
    body.append(row);
    count(entry, 1);
  }
  one.text = [entry.user, entry.label, entry.world, entry.server].flatMap((text) => wordsOf(text ?? ''));
  fill(one);
}

/** @param {string} key */
function drop(key) {
  const one = rows.get(key);
  if (one) {
    rows.delete(key);
    one.row.remove();
    count(one.entry, -1);
  }
}

/** Each word of the filter begins a word of the name, the world or the server. */
function filter() {
  const words = wordsOf(field.value);
  let shown = 0;
  let simulations = 0;
  for (const { entry, row, text } of rows.values()) {
    row.hidden = !words.every((word) => text.some((one) => one.startsWith(word)));
    shown += Number(!row.hidden);
    simulations += Number(!row.hidden && entry.server !== undefined);
  }
  setText(find('filtered', HTMLElement), words.length > 0 ? `${shown} of ${rows.size}` : `${rows.size} in all`);
  setText(all, `Stop all ${simulations}`);
  all.disabled = simulations === 0;
}

/** @param {Server[]} servers */
function showServers(servers) {
  const items = servers.map(({ address, page, state, note, simulations }) => {
    const words = [simulations === undefined ? '' : `${simulations} simulations`, note].filter(Boolean).join('. ');
    const link = make('a', { href: page }, address);
    return make('li', {}, link, make('span', { className: `state ${state}` }, state), make('span', {}, words));
  });
  find('servers', HTMLElement).replaceChildren(...items);
}

/** @param {Update} update */
function take({ all: isAll, changed, gone, servers, ready, announcement }) {
  if (isAll) {
    const there = new Set((changed ?? []).map((entry) => keyOf(entry.server, entry.id)));
    [...rows.keys()].filter((key) => !there.has(key)).forEach(drop);
  }
  (gone ?? []).forEach(([server, id]) => drop(keyOf(server, id)));
  (changed ?? []).forEach(put);
  if (changed || gone) {
    sortTable(body);
    filter();
  }
  if (servers) {
    showServers(servers);
  }
  if (ready) {
    showReady(ready);
  }
  if (announcement !== undefined) {
    const place = find('announcement', HTMLElement);
    place.hidden = announcement === '';
    setText(place, announcement);
  }
}

/** @param {Entry[]} entries the simulations to stop */
function ask(entries) {
  chosen = entries;
  const [first] = entries;
  const isOne = entries.length === 1 && first;
  find('stop-title', HTMLElement).textContent = isOne
    ? 'Stop this simulation?'
    : `Stop these ${entries.length} simulations?`;
  find('stop-what', HTMLElement).textContent = isOne
    ? `${worldOf(first)} of ${nameOf(first) || 'an unknown user'} (${first.id})`
    : 'All that the filter shows.';
  find('stop-now', HTMLButtonElement).textContent = isOne ? 'Stop it' : `Stop ${entries.length}`;
  problem.textContent = '';
  reason.value = '';
  dialog.showModal();
  reason.focus();
}

/** Ids are unique on their server only. @param {string} server @param {string[]} ids */
async function stop(server, ids) {
  const order = {
    method: 'POST',
    headers: { 'Content-Type': 'application/json' },
    body: JSON.stringify({ server, ids, reason: reason.value }),
  };
  const answer = await fetch('simulations/stop', order);
  if (!answer.ok) {
    throw new Error(await answer.text());
  }
  return (await answer.json()).failed.length;
}

/** @param {Event} event */
async function stopNow(event) {
  event.preventDefault();
  let failed = 0;
  try {
    for (const server of new Set(chosen.map((entry) => entry.server ?? ''))) {
      const ids = chosen.filter((entry) => entry.server === server).map((entry) => entry.id);
      for (let begin = 0; begin < ids.length; begin += BATCH) {
        failed += await stop(server, ids.slice(begin, begin + BATCH));
      }
    }
  } catch (error) {
    problem.textContent = error instanceof Error ? error.message : 'The server does not answer.';
    return;
  }
  if (failed > 0) {
    problem.textContent = `${failed} were not stopped: they have ended, or their server does not answer.`;
  } else {
    dialog.close();
  }
}

/** Leads to the form if the sign-in has ended. */
async function signInAgain() {
  const answer = await fetch('simulations', { method: 'HEAD', headers: { 'X-Requested-With': 'page' } }).catch(
    () => undefined,
  );
  if (answer?.status === 401) {
    location.assign('sign-in?to=class');
  }
}

/* The records of a lesson: by default, of the last two hours. */

const [from, to] = [find('from', HTMLInputElement), find('to', HTMLInputElement)];

/** The local time as the field has it. @param {Date} time */
const inField = (time) => new Date(time.getTime() - 60_000 * time.getTimezoneOffset()).toISOString().slice(0, 16);

function drawRecords() {
  const span = new URLSearchParams();
  for (const [name, { value }] of /** @type {[string, HTMLInputElement][]} */ ([
    ['from', from],
    ['to', to],
  ])) {
    const time = new Date(value).getTime();
    if (!Number.isNaN(time)) {
      span.set(name, String(Math.round(time / 1000)));
    }
  }
  find('records', HTMLAnchorElement).href = `simulations.csv?${span}`;
}

from.value = inField(new Date(Date.now() - 2 * 3_600_000));
from.addEventListener('input', drawRecords);
to.addEventListener('input', drawRecords);
drawRecords();

const table = body.closest('table');
if (table) {
  makeSortable(table, body);
}
field.addEventListener('input', filter);
all.addEventListener('click', () => {
  const shown = [...rows.values()].filter(({ entry, row }) => !row.hidden && entry.server);
  ask(shown.map(({ entry }) => entry));
});
find('stop-form', HTMLFormElement).addEventListener('submit', stopNow);
find('stop-cancel', HTMLButtonElement).addEventListener('click', () => dialog.close());
follow('class/events', take, { closed: signInAgain });
