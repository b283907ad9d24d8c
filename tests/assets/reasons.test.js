// The page's advice has an entry for each reason of the servers, and no others.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

import { words } from '../../templates/assets/english.js';
import { ADVICE, adviceFor, helpsToWait } from '../../templates/assets/reasons.js';

const SOURCE = new URL('../../src/shared/domain/reason.rs', import.meta.url);

/** The reasons of the servers, as their source lists them. */
function reasons() {
  const rows = readFileSync(SOURCE, 'utf8').matchAll(/^ +\w+ = "([a-z-]+)", (\w+), (\w+);$/gm);
  return [...rows].map(([, code = '', blame = '', retry = '']) => ({
    code,
    blame: blame.toLowerCase(),
    retry: retry.toLowerCase(),
  }));
}

test('each reason has its advice', () => {
  const codes = reasons().map(({ code }) => code);
  assert.ok(codes.length > 30, `${codes.length}`);
  assert.deepEqual(Object.keys(ADVICE).sort(), codes.sort());
  for (const code of codes) {
    assert.ok(words.advice[adviceFor(code)].endsWith('.'), code);
  }
});

test('a code that this page does not know, or none, gets the general advice', () => {
  assert.equal(adviceFor('toString'), 'general');
  assert.equal(adviceFor('of-a-later-version'), 'general');
  assert.equal(adviceFor(undefined), 'general');
});

test('waiting helps where others have to leave first', () => {
  const waits = reasons().filter(helpsToWait);
  assert.deepEqual(
    waits.map(({ code }) => code),
    ['no-idle-time', 'no-server-available', 'queue-full', 'share-used', 'builders-busy'],
  );
});
