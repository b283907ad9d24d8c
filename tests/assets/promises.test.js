// What pages use of the element is the same in its source, in its types, and in the guide; and what was promised once is
// still there.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

import { LANGUAGES } from '../../templates/assets/language.js';

/** @param {string} path */
const read = (path) => readFileSync(new URL(`../../${path}`, import.meta.url), 'utf8');
const SOURCE = read('templates/assets/embed.js');
const TYPES = read('templates/embed.d.ts');
const GUIDE = read('docs/embedding.md');

const namesIn = (/** @type {string} */ text) => text.trim().split(/\s+/);

/** What pages may use already. New names are added when a version has them; none is ever removed or changed. */
const PROMISED = {
  attributes: ['autoplay', 'autostart', 'lang', 'name', 'viewer', 'viewer-script', 'world'],
  viewers: ['small', 'webots'],
  languages: ['de', 'en', 'es', 'fr', 'ja', 'zh'],
  events: ['ended', 'ready', 'state', 'time', 'turn'],
  details: {
    StateDetail: ['ahead', 'state', 'world'],
    EndedDetail: ['blame', 'code', 'message', 'output', 'retry'],
    TimeDetail: ['time'],
  },
  members: ['pause', 'play', 'reset', 'start', 'state', 'stop', 'world'],
  states: ['ended', 'idle', 'lost', 'running', 'starting', 'waiting'],
  parts: ['announcement', 'availability', 'full-screen', 'leave', 'notice', 'problem', 'stage', 'start', 'steps'],
  codes: namesIn(`
    absent broken broken-before left no-scene origin-refused server-lost server-unreachable session-silent
    session-unreachable simulator-unreachable unknown`),
  reasons: namesIn(`
    invalid-request too-many-requests invalid-world repository-not-allowed repository-blocked no-idle-time
    no-server-available queue-full share-used invalid-pass used-pass expired-pass draining not-ready nothing-to-reset
    no-answer invalid-answer starts-fail repository-not-found repository-moved commit-not-found world-not-found
    project-too-large checkout-timeout remote-failed remote-unreachable invalid-project build-failed build-timeout
    image-not-found builders-busy image-too-large load-failed load-timeout launch-failed disk-full docker-unavailable
    server-fault left away no-viewer taken-over finished time-limit idle stopped-by-administrator server-stopped
    crashed hung memory-limit out-of-memory disk-limit lost ended`),
  blames: ['fleet', 'project', 'server', 'user'],
  retries: ['elsewhere', 'here', 'later', 'no'],
  types: namesIn(`
    EndedDetail SimulationAttributes SimulationEventMap SimulationEvents SimulationState StateDetail TimeDetail
    WebotsSimulation`),
  frame: ['embed', 'lang', 'name', 'play', 'start', 'url'],
};

// What the browser calls.
const OF_THE_BROWSER = ['constructor', 'connectedCallback', 'disconnectedCallback', 'attributeChangedCallback'];

/**
 * All that a pattern finds, each once, in order.
 * @param {string} text
 * @param {RegExp} pattern with one group
 */
function all(text, pattern) {
  const found = [...new Set([...text.matchAll(pattern)].map(([, name = '']) => name))].sort();
  assert.ok(found.length > 0, `${pattern} finds ${found}`);
  return found;
}

/**
 * The text between two others.
 * @param {string} text
 * @param {string} begin
 * @param {string} end
 */
function between(text, begin, end) {
  const [, rest, ...more] = text.split(begin);
  assert.ok(rest !== undefined && more.length === 0, `"${begin}" is there once`);
  const [part = '', after] = rest.split(end);
  assert.ok(after !== undefined, `"${end}" follows "${begin}"`);
  return part;
}

/**
 * The names in the first column of the guide's table with this heading.
 * @param {string} heading
 */
function column(heading) {
  const rows = between(GUIDE, `\n| ${heading} |`, '\n\n').split('\n').slice(2);
  return all(rows.map((row) => row.split('|')[1]).join(), /`([\w-]+)/g);
}

/**
 * All that was promised is there, maybe more.
 * @param {string[]} found
 * @param {string[]} promised
 */
function keeps(found, promised) {
  const missing = promised.filter((name) => !found.includes(name));
  assert.deepEqual(missing, []);
}

test('attributes', () => {
  const own = all(SOURCE, /(?:get|has)Attribute\('([\w-]+)'\)/g);
  keeps(own, PROMISED.attributes);
  assert.deepEqual(own, column('attribute'));
  const typed = between(TYPES, 'interface SimulationAttributes {', '\n}');
  assert.deepEqual(own, all(typed, /^ {2}'?([\w-]+)'?\?:/gm));
  keeps(all(between(typed, '  viewer?:', ';'), /'(\w+)'/g), PROMISED.viewers);
  keeps(all(between(GUIDE, '\n| `viewer` |', ':'), /`(\w+)`/g), PROMISED.viewers);
  keeps(Object.keys(LANGUAGES), PROMISED.languages);
  keeps(all(between(GUIDE, '\n| `lang` |', '. '), /`(\w+)`/g), PROMISED.languages);
});

test('events', () => {
  const own = all(SOURCE, /#dispatch\('(\w+)'/g);
  keeps(own, PROMISED.events);
  assert.deepEqual(own, column('event'));
  assert.deepEqual(own, all(between(TYPES, 'interface SimulationEvents {', '\n}'), /^ {2}(\w+):/gm));
});

// That the element sends what its types say, TypeScript checks.
test('details of events', () => {
  for (const [name, promised] of Object.entries(PROMISED.details)) {
    const typed = all(between(TYPES, `interface ${name} {`, '\n}'), /^ {2}(\w+)\??:/gm);
    keeps(typed, promised);
    const event = name.replace('Detail', '').toLowerCase();
    assert.deepEqual(typed, all(between(GUIDE, `\n| \`${event}\` | \`{`, '}'), /(\w+)/g), name);
  }
});

test('methods and properties', () => {
  const members = all(SOURCE, /^ {2}(?:get |set |async )?([a-z]\w*)\(.*\{$/gm);
  const own = members.filter((name) => !OF_THE_BROWSER.includes(name));
  keeps(own, PROMISED.members);
  assert.deepEqual(own, column('method, property'));
  const promised = between(TYPES, 'class WebotsSimulation extends HTMLElement {', 'addEventListener<');
  assert.deepEqual(own, all(promised, /^ {2}(?:readonly )?(\w+)[(:]/gm));
});

test('states', () => {
  const typed = all(between(TYPES, 'type SimulationState =', ';'), /'(\w+)'/g);
  keeps(typed, PROMISED.states);
  assert.deepEqual(typed, all(`\`idle${between(GUIDE, '\n| `state` | `idle', '\n')}`, /`(\w+)`/g));
  keeps(all(SOURCE, /'(\w+)'/g), PROMISED.states);
});

test('CSS parts', () => {
  const own = all(read('templates/assets/panel.js'), /\bpart\(\s*'([\w-]+)'/g);
  keeps(own, PROMISED.parts);
  assert.deepEqual(own, all(between(TYPES, ' * CSS parts:', '.\n'), /`([\w-]+)`/g));
  assert.deepEqual(own, all(between(GUIDE, '\nThe parts are', '. '), /`([\w-]+)`/g));
});

test("the element's own codes of ends", () => {
  const problems = between(read('templates/assets/visit.js'), 'What a problem that the page', 'OwnProblem');
  const direct = all(SOURCE, /(?:code: |\?\? )'([a-z-]+)'/g);
  const own = [...new Set([...all(problems, /'([a-z-]+)'/g), ...direct])].filter((code) => code !== 'automatic').sort();
  keeps(own, PROMISED.codes);
  assert.deepEqual(own, column('code'));
  const listed = between(TYPES, 'or of the element itself:', 'Later versions may add');
  assert.deepEqual(own, all(listed, /`([\w-]+)`/g));
});

test('reasons of the servers, whom they blame, and whether another start helps', () => {
  const rows = [...read('src/shared/domain/reason.rs').matchAll(/^ +\w+ = "([a-z-]+)", (\w+), (\w+);$/gm)];
  const columnOf = (/** @type {number} */ index) => rows.map((row) => (row[index] ?? '').toLowerCase());
  keeps(columnOf(1), PROMISED.reasons);
  keeps(all(read('docs/protocol.md'), /^\| `([a-z-]+)` \| \w+ \| \w+ \|/gm), PROMISED.reasons);
  keeps(columnOf(2), PROMISED.blames);
  keeps(all(between(GUIDE, 'with `blame` (', ')'), /`(\w+)`/g), PROMISED.blames);
  keeps(columnOf(3), PROMISED.retries);
  keeps(column('`retry`'), PROMISED.retries);
});

test('types that a project imports', () => {
  keeps(all(TYPES, /^export (?:declare class|interface|type) (\w+)/gm), PROMISED.types);
});

test('the address of a frame', () => {
  const own = [...all(read('templates/assets/viewer.js'), /search\.get\('(\w+)'\)/g), 'embed'];
  assert.match(read('src/session/web/page_routes.rs'), /"embed=1"/);
  keeps(own, PROMISED.frame);
  const chapter = between(GUIDE, '\n## A frame\n', '\n## ');
  keeps(all(chapter, /[?;](\w+)=/g), PROMISED.frame);
});
