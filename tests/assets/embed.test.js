// The element `<webots-simulation>`, without a browser: what it tells its page of each start.

import assert from 'node:assert/strict';
import { register } from 'node:module';
import { test } from 'node:test';

import { Clock, FakeWebSocket } from './fakes.js';

// The server makes a module of the style sheets, the panel needs a document, and the words can't be loaded at first.
const panel = `
  const nothing = () => {};
  const stage = { clear: nothing, close: nothing, freeze: nothing, show: async () => {} };
  export class Panel {
    stage = stage;
    constructor(words) { this.words = words; }
    nameVisitor() {}
    announce() {}
    say() {}
    draw() {}
  }`;
const hooks = `
  const instead = { './styles.js': "export const styles = ''", './panel.js': ${JSON.stringify(panel)} };
  let refusals = 1;
  export function resolve(name, context, next) {
    if (name in instead) {
      return { url: 'data:text/javascript,' + encodeURIComponent(instead[name]), shortCircuit: true };
    }
    if (name === './english.js' && refusals > 0) {
      refusals -= 1;
      throw new Error('not there');
    }
    return next(name, context);
  }`;
register(`data:text/javascript,${encodeURIComponent(hooks)}`);

/** What the element needs of HTMLElement. */
class FakeElement extends EventTarget {
  isConnected = false;
  id = '';
  /** @type {object | null} */
  shadowRoot = null;
  getAttribute() {
    return null;
  }
  hasAttribute() {
    return false;
  }
  attachShadow() {
    this.shadowRoot = { replaceChildren: () => {}, append: () => {} };
    return this.shadowRoot;
  }
}
Object.assign(globalThis, {
  HTMLElement: FakeElement,
  CSSStyleSheet: class {
    replaceSync() {}
  },
  customElements: { get: () => true },
  location: { pathname: '/' },
  navigator: { languages: ['en'] },
  addEventListener: () => {},
});
const settled = () => new Promise((resolve) => setImmediate(resolve));
const clock = new Clock();
FakeWebSocket.install();
const { WebotsSimulation } = await import('../../templates/assets/embed.js');

/** An element in a page, and what it has told. */
function element() {
  const simulation = new WebotsSimulation();
  /** @type {string[]} */
  const told = [];
  const tell = (/** @type {Event} */ event) => {
    const { detail } = /** @type {CustomEvent} */ (event);
    told.push(`${event.type} ${detail.code ?? `${detail.state} ${detail.world}`}`);
  };
  simulation.addEventListener('state', tell);
  simulation.addEventListener('ended', tell);
  Object.assign(simulation, { isConnected: true });
  simulation.connectedCallback();
  return { simulation, told };
}

test('an element whose words could not be loaded ends what was started, and opens later', async () => {
  const { simulation, told } = element();
  simulation.start('a');
  simulation.start('b');
  while (told.length < 2) {
    await settled();
  }
  assert.deepEqual(told.splice(0), ['ended session-unreachable', 'ended session-unreachable']);
  assert.equal(FakeWebSocket.all.length, 0);
  clock.pass(5000);
  while (FakeWebSocket.all.length === 0) {
    await settled();
  }
  assert.deepEqual(told, [], 'it starts nothing by itself');
  simulation.start('c');
  assert.deepEqual(told, ['state starting c']);
});

test('each start ends once: one that is replaced, and one that fails as the one before', async () => {
  const before = FakeWebSocket.all.length;
  const { simulation, told } = element();
  while (FakeWebSocket.all.length === before) {
    await settled();
  }
  const socket = FakeWebSocket.last;
  socket.open();
  socket.receive('1');
  simulation.start('a');
  socket.receive('queue: 2');
  assert.deepEqual(told.splice(0), ['state starting a', 'state waiting a']);
  simulation.start('b');
  assert.deepEqual(told.splice(0), ['ended left', 'state starting b']);
  socket.end(1006);
  assert.deepEqual(told.splice(0), ['state ended b', 'ended session-unreachable']);
  simulation.start('b');
  assert.deepEqual(told.splice(0), ['state ended b', 'ended session-unreachable']);
  simulation.stop();
  assert.deepEqual(told, ['state idle undefined']);
});

test('an end has what the server has said of its reason', async () => {
  const before = FakeWebSocket.all.length;
  const { simulation } = element();
  while (FakeWebSocket.all.length === before) {
    await settled();
  }
  /** @type {object[]} */
  const ends = [];
  simulation.addEventListener('ended', (event) => ends.push(/** @type {CustomEvent} */ (event).detail));
  FakeWebSocket.last.open();
  FakeWebSocket.last.receive('1');
  simulation.start('a');
  const reason = { code: 'repository-blocked', blame: 'user', retry: 'no' };
  FakeWebSocket.last.receive(`reason: ${JSON.stringify({ ...reason, message: 'It is blocked.', output: 'printed' })}`);
  FakeWebSocket.last.receive('Error: It is blocked.');
  assert.deepEqual(ends, [{ ...reason, message: 'It is blocked.', output: 'printed' }]);
});
