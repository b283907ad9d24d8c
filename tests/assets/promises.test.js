// What pages use of the element is the same in its source, in its types, and in the guide.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

/** @param {string} path */
const read = (path) => readFileSync(new URL(`../../${path}`, import.meta.url), 'utf8');
const SOURCE = read('templates/assets/embed.js');
const TYPES = read('templates/embed.d.ts');
const GUIDE = read('docs/embedding.md');
// What the browser calls.
const OF_THE_BROWSER = ['constructor', 'connectedCallback', 'disconnectedCallback', 'attributeChangedCallback'];

/**
 * All that a pattern finds, each once, in order.
 * @param {string} text
 * @param {RegExp} pattern with one group
 */
function all(text, pattern) {
  const found = [...new Set([...text.matchAll(pattern)].map(([, name = '']) => name))].sort();
  assert.ok(found.length > 1, `${pattern} finds ${found}`);
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

test('attributes', () => {
  const own = all(SOURCE, /(?:get|has)Attribute\('([\w-]+)'\)/g);
  assert.deepEqual(own, column('attribute'));
  assert.deepEqual(own, all(between(TYPES, 'interface SimulationAttributes {', '\n}'), /^ {2}'?([\w-]+)'?\?:/gm));
});

test('events', () => {
  const own = all(SOURCE, /#dispatch\('(\w+)'/g);
  assert.deepEqual(own, column('event'));
  assert.deepEqual(own, all(between(TYPES, 'interface SimulationEvents {', '\n}'), /^ {2}(\w+):/gm));
});

test('methods and properties', () => {
  const members = all(SOURCE, /^ {2}(?:get |set |async )?([a-z]\w*)\(.*\{$/gm);
  const own = members.filter((name) => !OF_THE_BROWSER.includes(name));
  assert.deepEqual(own, column('method, property'));
  const promised = between(TYPES, 'class WebotsSimulation extends HTMLElement {', 'addEventListener');
  assert.deepEqual(own, all(promised, /^ {2}(?:readonly )?(\w+)[(:]/gm));
});

test('states', () => {
  const states = (/** @type {string} */ list) => all(list, /'(\w+)'/g);
  const own = states(between(SOURCE, '/** What a page is told about the visit.', '} PublicState'));
  assert.deepEqual(own, states(between(TYPES, 'type SimulationState =', ';')));
  assert.deepEqual(own, all(`\`idle${between(GUIDE, '\n| `state` | `idle', '\n')}`, /`(\w+)`/g));
});

test('CSS parts', () => {
  const own = all(read('templates/assets/panel.js'), /\bpart\(\s*'([\w-]+)'/g);
  assert.deepEqual(own, all(between(TYPES, ' * CSS parts:', '.\n'), /`([\w-]+)`/g));
  assert.deepEqual(own, all(between(GUIDE, '\nThe parts are', '. '), /`([\w-]+)`/g));
});

test("the element's own codes of ends", () => {
  const problems = between(read('templates/assets/visit.js'), 'What a problem that the page', 'OwnProblem');
  const direct = all(SOURCE, /(?:code: |\?\? )'([a-z-]+)'/g);
  const own = [...new Set([...all(problems, /'([a-z-]+)'/g), ...direct])].filter((code) => code !== 'automatic').sort();
  assert.deepEqual(own, column('code'));
  const listed = between(TYPES, 'or of the element itself:', 'Later versions may add');
  assert.deepEqual(own, all(listed, /`([\w-]+)`/g));
});
