// What the fleet keeps ready for lessons, on the page of the class: a form to ask for it, and the list.

import { find, make } from './dom.js';

/** A world that is kept ready, or will be. `lesson`: what this page, or another program, has asked for.
 * @typedef {{ world: string, mode: string, wanted: number, ready: number,
 *   lesson?: { count: number, from?: string, until?: string, timeZone?: string } }} ReadyWorld
 */

const whole = new Intl.DateTimeFormat(undefined, { dateStyle: 'medium', timeStyle: 'short' });
const form = document.getElementById('ready');
const problem = document.getElementById('ready-problem');

/** @param {{ world: string, count: number, mode?: string, from?: string, until?: string }} entry */
async function request(entry) {
  const order = { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(entry) };
  const answer = await fetch('ready', order).catch(() => undefined);
  if (problem) {
    problem.textContent = answer?.ok ? '' : ((await answer?.text()) ?? 'The server does not answer.');
  }
}

/** A time of an entry, as text. @param {string | undefined} time */
function shown(time) {
  const isExact = time !== undefined && /(Z|[+-]\d\d:\d\d)$/.test(time);
  return isExact ? whole.format(new Date(time)) : time?.replace('T', ' ');
}

/** @param {ReadyWorld} one */
function line({ world, mode, wanted, ready, lesson }) {
  const name = world.split('/').pop() ?? '';
  const item = make('li', {}, make('b', {}, name), ` ${ready} of ${wanted} ready now`);
  if (lesson) {
    const [from, until] = [shown(lesson.from), shown(lesson.until)];
    const span = [from && `from ${from}`, until && `until ${until}`, lesson.timeZone].filter(Boolean).join(' ');
    const end = make('button', { type: 'button' }, 'End', make('span', { className: 'spoken' }, ` ${name}`));
    end.addEventListener('click', () => request({ world, mode, count: 0 }));
    item.append(`; ${lesson.count} ${span} `, end);
  }
  return item;
}

/** @param {ReadyWorld[]} worlds */
export function showReady(worlds) {
  document.getElementById('ready-worlds')?.replaceChildren(...worlds.map(line));
}

/** The time in a field, which is local, for any server. @param {string} id */
function timeIn(id) {
  const { value } = find(id, HTMLInputElement);
  return value ? { [id.replace('ready-', '')]: new Date(value).toISOString() } : {};
}

form?.addEventListener('submit', (event) => {
  event.preventDefault();
  request({
    world: find('ready-world', HTMLInputElement).value.trim(),
    count: Number(find('ready-count', HTMLInputElement).value),
    ...timeIn('ready-from'),
    ...timeIn('ready-until'),
  });
});
