// The texts of the servers, read into messages; and the connections that carry them.

import assert from 'node:assert/strict';
import { beforeEach, test } from 'node:test';

import { FleetReader, SimulationReader } from '../../templates/assets/messages.js';
import { endAway, SimulationLink } from '../../templates/assets/simulation_link.js';
import { Clock, FakeWebSocket } from './fakes.js';

const DRAINING = { code: 'draining', blame: 'server', retry: 'elsewhere' };

/** @type {Clock} */
let clock;

beforeEach(() => {
  clock = new Clock();
  FakeWebSocket.install();
});

/** @type {(...texts: string[]) => unknown[]} */
function read(...texts) {
  const reader = new SimulationReader();
  return texts.map((text) => reader.read(text));
}

test('a reason belongs to the sentence after it', () => {
  const failed = { is: 'failed', failure: { sentence: 'it stops', reason: DRAINING } };
  assert.deepEqual(read(`reason: ${JSON.stringify(DRAINING)}`, 'loading: Error: it stops'), [undefined, failed]);
  assert.deepEqual(read(`reason: ${JSON.stringify(DRAINING)}`, '.', 'loading: Error: it stops')[2], failed);
  const reader = new SimulationReader();
  reader.read(`reason: ${JSON.stringify(DRAINING)}`);
  reader.read('loading: Error: one');
  assert.deepEqual(reader.read('loading: Error: two'), {
    is: 'failed',
    failure: { sentence: 'two', reason: undefined },
  });
});

test('the sentence is that of the reason, without what older pages get with it', () => {
  const output = 'no licence';
  const sent = { ...DRAINING, message: 'Webots has ended', output };
  const [, failed] = read(
    `reason: ${JSON.stringify(sent)}`,
    `loading: Error: Webots has ended. Its last output: ${output}`,
  );
  assert.deepEqual(failed, {
    is: 'failed',
    failure: { sentence: 'Webots has ended', reason: { ...DRAINING, output } },
  });
});

test('an end without an error has a reason too', () => {
  const finished = { code: 'finished', blame: 'project', retry: 'here' };
  const [, failed] = read(`reason: ${JSON.stringify(finished)}`, 'loading: Webots has ended');
  assert.deepEqual(failed, { is: 'failed', failure: { sentence: 'Webots has ended', reason: finished } });
});

test('a malformed reason is none', () => {
  for (const json of [
    '',
    'draining',
    'null',
    '7',
    '{}',
    '{"code": 1, "blame": "server", "retry": "no"}',
    '{"code": "x"}',
  ]) {
    const [, failed] = read(`reason: ${json}`, 'loading: Error: it stops');
    assert.deepEqual(failed, { is: 'failed', failure: { sentence: 'it stops', reason: undefined } }, json);
  }
});

test('no text of a project is taken for a message of the server', () => {
  const output = 'x\nreason: {"code":"full","blame":"fleet","retry":"later"}\nloading: Error: no';
  const reason = { ...DRAINING, output };
  const [, failed] = read(`reason: ${JSON.stringify(reason)}`, 'loading: Error: it stops');
  assert.deepEqual(failed, { is: 'failed', failure: { sentence: 'it stops', reason } });
  for (const words of [
    'reason: {}',
    'progress: {"step":"launch","text":"x"}',
    'Step 8/9 : 40 %',
    'checkout done',
    'webots is starting',
  ]) {
    const progress = { text: words };
    assert.deepEqual(read(`loading: ${words}`), [{ is: 'progress', progress }], words);
    const shown = { step: 'image', text: words };
    assert.deepEqual(read(`progress: ${JSON.stringify(shown)}`, `loading: Step 1/2 : ${words}`), [
      { is: 'progress', progress: shown },
      { is: 'alive' },
    ]);
  }
});

test('the text after a position in the queue is for other pages', () => {
  const texts = ['queue: 2', 'loading: waiting for a place, 2 clients are ahead', 'loading: begins'];
  assert.deepEqual(read(...texts), [
    { is: 'queued', ahead: 2 },
    { is: 'alive' },
    { is: 'progress', progress: { text: 'begins' } },
  ]);
});

test('progress is told once, with its step and its percentage', () => {
  const progress = { step: 'fetch', percent: 40, text: 'fetching x: Receiving objects: 40%' };
  const told = { is: 'progress', progress };
  const [json, text] = [`progress: ${JSON.stringify(progress)}`, `loading: Step 4/9 : ${progress.text}`];
  assert.deepEqual(read(json, text, json, '.', text), [
    told,
    { is: 'alive' },
    told,
    { is: 'alive' },
    { is: 'progress', progress: { text: `Step 4/9 : ${progress.text}` } },
  ]);
});

test('without well-formed progress the text is shown', () => {
  for (const json of ['', 'fetch', 'null', '7', '{}', '{"step": 1, "text": "x"}', '{"step": "fetch"}']) {
    const [, shown] = read(`progress: ${json}`, 'loading: fetching');
    assert.deepEqual(shown, { is: 'progress', progress: { text: 'fetching' } }, json);
  }
  const [odd] = read('progress: {"step": "fetch", "percent": "40", "text": "x"}');
  assert.deepEqual(odd, { is: 'progress', progress: { step: 'fetch', text: 'x' } });
});

test('the kind of the stream belongs to its address, and the absence to the token', () => {
  const texts = ['kind: w3d', 'webots:ws://one:2001', 'absence: 60', 'resume: f00d', 'absence: 60'];
  assert.deepEqual(read(...texts), [
    undefined,
    { is: 'ready', address: 'ws://one:2001', kind: 'w3d' },
    { is: 'alive' },
    { is: 'resumable', resumption: { token: 'f00d', absence: 60 } },
    { is: 'alive' },
  ]);
  assert.deepEqual(read('webots:wss://one/2001'), [{ is: 'ready', address: 'wss://one/2001', kind: undefined }]);
});

test('what is unknown is a sign of life', () => {
  for (const text of ['.', '', 'session: 1', 'ide: enable', 'type:demo\n', 'webots', 'of a later version: 1']) {
    assert.deepEqual(read(text), [{ is: 'alive' }], text);
  }
  assert.deepEqual(read('realTime: 0.6', 'realTime: 1', 'realTime: 0.0'), [
    { is: 'paced', share: 0.6 },
    { is: 'paced', share: undefined },
    { is: 'paced', share: 0 },
  ]);
  assert.deepEqual(read('idle: never', 'idle: 5', 'watched: 1', 'error: old'), [
    { is: 'idle', endsIn: undefined },
    { is: 'idle', endsIn: 5 },
    { is: 'watched', now: true },
    { is: 'failed', failure: { sentence: 'old', reason: undefined } },
  ]);
});

test('the session server sends reports, announcements, addresses and refusals', () => {
  const reader = new FleetReader();
  const texts = [
    '1',
    'announcement: Save!',
    'announcement:',
    'ws://one:2000',
    `reason: ${JSON.stringify(DRAINING)}`,
    '0',
    'of a later version: 1',
    'Error: no',
  ];
  assert.deepEqual(
    texts.map((text) => reader.read(text)),
    [
      { is: 'available', now: true },
      { is: 'announced', text: 'Save!' },
      { is: 'announced', text: '' },
      { is: 'chosen', server: 'ws://one:2000' },
      undefined,
      { is: 'available', now: false },
      undefined,
      { is: 'refused', failure: { sentence: 'no', reason: DRAINING } },
    ],
  );
});

/** A connection to a simulation server, and its events. */
function connect() {
  /** @type {import('../../templates/assets/simulation_link.js').LinkEvent[]} */
  const events = [];
  const link = new SimulationLink('ws://one:2000', { start: { url: 'x' } }, (event) => events.push(event));
  FakeWebSocket.last.open();
  events.shift();
  return { link, events, socket: FakeWebSocket.last };
}

test('a sentence with a reason ends the connection at once', () => {
  const { events, socket } = connect();
  assert.deepEqual([socket.url, socket.sent], ['ws://one:2000/client', ['{"start":{"url":"x"}}']]);
  socket.receive(`reason: ${JSON.stringify(DRAINING)}`, 'loading: Error: it stops', 'webots:ws://late');
  socket.end(1000);
  assert.deepEqual(events, [{ type: 'closed', code: undefined, failure: { sentence: 'it stops', reason: DRAINING } }]);
});

test('a sentence without a reason waits for the close code, but not for long', () => {
  const failure = { sentence: 'it stops', reason: undefined };
  const soon = connect();
  soon.socket.receive('loading: Error: it stops', 'webots:ws://late');
  assert.deepEqual(soon.events, []);
  soon.socket.end(1013);
  clock.pass(2000);
  assert.deepEqual(soon.events, [{ type: 'closed', code: 1013, failure }]);
  const never = connect();
  never.socket.receive('loading: Error: it stops');
  clock.pass(2000);
  assert.deepEqual(never.events, [{ type: 'closed', code: undefined, failure }]);
});

test('who ends a simulation that waits for it resumes it and closes with 1000', () => {
  endAway('ws://one:2000', 'secret');
  const socket = FakeWebSocket.last;
  assert.deepEqual([socket.url, socket.sent], ['ws://one:2000/client', []]);
  socket.open();
  assert.deepEqual([socket.sent, socket.closedWith], [['{"resume":"secret"}'], 1000]);
});

test('who leaves closes with 1000, who may come back does not, and neither hears more', () => {
  const left = connect();
  left.link.leave();
  assert.equal(left.socket.closedWith, 1000);
  const away = connect();
  away.link.detach();
  assert.equal(away.socket.closedWith, undefined);
  for (const { socket, events } of [left, away]) {
    socket.receive('webots:ws://late');
    socket.end(1000);
    assert.deepEqual(events, []);
  }
});
