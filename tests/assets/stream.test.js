// The stream of a simulator, against a WebSocket that behaves as that of Webots: it knows one kind of stream, answers an
// unknown one with an error on its console, and sends updates and errors to everybody, asked or not.

import assert from 'node:assert/strict';
import { beforeEach, test } from 'node:test';

import { Stream } from '../../templates/assets/stream.js';
import { Clock, FakeWebSocket } from './fakes.js';

const SCENE = 'model:<X3D><head></head><Scene></Scene></X3D>';
const UPDATE = 'application/json:{"time":32,"updates":[]}';

/** @type {Clock} */
let clock;

beforeEach(() => {
  clock = new Clock();
  FakeWebSocket.install();
});

/**
 * Makes a WebSocket behave as Webots' does.
 * @param {FakeWebSocket} socket
 * @param {string} kind the one that this version knows
 * @param {string[]} scene
 */
function webots(socket, kind, scene = ['loading:Parsing nodes:50', 'world:a.wbt:a.wbt', SCENE]) {
  socket.server = (text) => {
    socket.receive(
      ...(text.split(';')[0] === kind ? scene : [`stderr:ERROR: Streaming server: Unsupported message: ${text}.`]),
    );
  };
  socket.open();
}

/**
 * A stream and its events.
 * @param {{ kind?: string, isOnlooker?: boolean }} options
 */
function open(options) {
  /** @type {import('../../templates/assets/stream.js').StreamEvent[]} */
  const events = [];
  const stream = new Stream('ws://host:1', options, (event) => events.push(event));
  const names = () => events.map(({ is }) => is);
  return { stream, events, names, socket: FakeWebSocket.last };
}

test('the kind that the server has told is the only one that is asked for', () => {
  for (const kind of ['w3d', 'x3d']) {
    const { socket, names } = open({ kind });
    webots(socket, kind);
    clock.pass(60_000);
    assert.deepEqual(socket.sent, [kind]);
    assert.ok(names().includes('model'));
  }
});

test('without a kind, both are tried, and updates, errors and warnings are no answer', () => {
  const { socket, names } = open({});
  webots(socket, 'w3d');
  // The simulation runs for others, or a page was loaded again.
  for (let update = 0; update < 20; ++update) {
    clock.pass(100);
    socket.receive(UPDATE, 'stdout:INFO: hello', 'stderr:WARNING: something', 'real-time');
  }
  assert.deepEqual(socket.sent, ['x3d', 'w3d']);
  assert.ok(names().includes('model'));
});

test('a world that takes long to be read is an answer', () => {
  const { socket } = open({ isOnlooker: true });
  webots(socket, 'x3d', ['loading:Reading world file:10']);
  clock.pass(60_000);
  assert.deepEqual(socket.sent, ['x3d;broadcast']);
});

test('the progress of Webots comes with its percentage', () => {
  const { socket, events } = open({ kind: 'w3d' });
  webots(socket, 'w3d', ['loading:Parsing nodes:50']);
  assert.deepEqual(events, [{ is: 'loading', status: 'Parsing nodes', percent: 50 }]);
});

test('texts of other versions are understood', () => {
  const { socket, events } = open({ kind: 'x3d' });
  webots(socket, 'x3d', []);
  socket.receive('pause: 64', 'paused by client', 'run', 'fast', 'reset finished', 'stdout:one\nstderr:two', 'unknown');
  socket.receive('application/json:{"time":1,"poses":[{"id":3}]}');
  socket.end(1001);
  assert.deepEqual(events, [
    { is: 'mode', mode: 'pause' },
    { is: 'time', time: 64 },
    { is: 'mode', mode: 'pause' },
    { is: 'mode', mode: 'fast' },
    { is: 'mode', mode: 'fast' },
    { is: 'reset' },
    { is: 'console', text: 'one\ntwo' },
    { is: 'update', update: { time: 1, poses: [{ id: 3 }], updates: [{ id: 3 }] } },
    { is: 'closed' },
  ]);
});
