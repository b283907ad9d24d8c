// The connection to the session server, against a WebSocket whose server is the test.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { Store } from '../../templates/assets/kept.js';
import { SessionServer } from '../../templates/assets/session_server.js';
import { Clock, FakeWebSocket } from './fakes.js';

test('a connection that is given up counts as broken at once, and only once', async () => {
  const clock = new Clock();
  FakeWebSocket.install();
  /** @type {string[]} */
  const told = [];
  const server = new SessionServer('http://localhost:1999/', new Store('test'), ({ type }) => told.push(type));
  const dead = FakeWebSocket.last;
  dead.open();
  server.ask(1, 'world', undefined);
  dead.receive('0', 'ticket: t', 'queue: 3');
  server.reconnect();
  assert.equal(dead.readyState, 3);
  await Promise.resolve();
  assert.deepEqual(told, ['connected', 'available', 'ticketed', 'queued', 'disconnected']);
  clock.pass(2000);
  assert.equal(FakeWebSocket.all.length, 2);
  // The browser notices it, too.
  dead.end(1006);
  clock.pass(10_000);
  assert.equal(FakeWebSocket.all.length, 2);
  assert.equal(told.length, 5);
  FakeWebSocket.last.open();
  server.ask(2, 'world', undefined);
  assert.equal(JSON.parse(FakeWebSocket.last.sent.at(-1) ?? '').ticket, 't', 'the place is kept');
});
