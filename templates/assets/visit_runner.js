// Runs one visit: gives the events of the servers and the viewer to its states (`visit.js`), and carries out their
// effects on the connections, the store and the panel.

import { SessionServer } from './session_server.js';
import { endAway, SimulationLink } from './simulation_link.js';
import { ring } from './turn.js';
import { BEGIN, next } from './visit.js';

/** @typedef {import('./visit.js').Effect} Effect */
/** @typedef {import('./visit.js').Event} VisitEvent */
/** @typedef {import('./visit.js').State} State */

/** What the visit's owner decides, asked when it is needed. `named`: the world that its page names.
 * @typedef {{ named: string, name: string | undefined, viewer: string, script: string | undefined }} Choices
 */

export class VisitRunner {
  #base;
  #store;
  #panel;
  #choices;
  #changed;
  #visit = BEGIN;
  #isClosed = false;
  #sessionServer;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  /** @type {SimulationLink | undefined} */
  #link;

  /**
   * Connects to the session server.
   * @param {string} base the URL of the session server
   * @param {import('./kept.js').Store} store
   * @param {import('./panel.js').Panel} panel
   * @param {() => Choices} choices
   * @param {(before: State, state: State, event: VisitEvent) => void} changed called after each event
   */
  constructor(base, store, panel, choices, changed) {
    this.#base = base;
    this.#store = store;
    this.#panel = panel;
    this.#choices = choices;
    this.#changed = changed;
    this.#sessionServer = new SessionServer(base, store, (event) => this.take(event));
  }

  /** @param {VisitEvent} event */
  take(event) {
    // A request or a module may still be on its way.
    if (this.#isClosed) {
      return;
    }
    if (event.type === 'announced') {
      this.#panel.announce(event.text);
    }
    // The session server sends the announcement again, if there still is one.
    if (event.type === 'connected') {
      this.#panel.announce('');
    }
    const before = this.#visit;
    const { visit, effects } = next(before, event, Date.now(), Math.random);
    this.#visit = visit;
    for (const effect of effects) {
      this.#carryOut(effect);
    }
    clearTimeout(this.#timer);
    if (visit.wakeAt !== undefined) {
      this.#timer = setTimeout(() => this.take({ type: 'tick' }), Math.max(0, visit.wakeAt - Date.now()));
    }
    this.#remember(event);
    this.#panel.draw(visit, before.state);
    this.#changed(before.state, visit.state, event);
  }

  /** @param {VisitEvent} event */
  #remember(event) {
    const { state } = this.#visit;
    if (event.type === 'hidden') {
      return;
    }
    if (event.type === 'submitted') {
      this.#store.want(event.world, this.#choices().named);
    }
    if (event.type === 'left' || state.is === 'ended') {
      this.#store.forget();
    }
  }

  /** Goes on with what this tab has kept, if it has something. Returns that. */
  restore() {
    const { wish } = this.#store;
    const { named } = this.#choices();
    if (!wish || (named !== '' && named !== wish.named)) {
      this.#store.forget();
      return undefined;
    }
    const { world, simulation } = wish;
    if (simulation) {
      this.take({ type: 'restored', kept: simulation });
    } else {
      this.take({ type: this.#store.ticketFor(world) ? 'awaited' : 'submitted', world });
    }
    return wish;
  }

  /** Ends the simulation, and the connections. */
  close() {
    this.take({ type: 'left' });
    this.#isClosed = true;
    this.#sessionServer.close();
  }

  /** @param {Effect} effect */
  #carryOut(effect) {
    const { words, stage } = this.#panel;
    switch (effect.do) {
      case 'ask':
        return this.#sessionServer.ask(effect.id, effect.world, this.#choices().name);
      case 'connect':
        return this.#open(effect);
      case 'send':
        return this.#link?.send(effect.message);
      case 'store':
        return this.#store.keep(effect.kept);
      case 'show':
        // A module that is not there yet could not be loaded: the session server may be restarting.
        stage
          .show(effect, { ...this.#choices(), say: (text) => this.#panel.say(text) })
          .catch(() => this.take({ type: 'sceneFailed', why: 'not-loaded' }));
        return undefined;
      case 'freeze':
        return stage.freeze();
      case 'leave':
        return this.#leave();
      case 'endAway':
        return endAway(effect.server, effect.token);
      case 'detach':
        this.#link?.detach();
        return this.#close();
      case 'clear':
        return stage.clear(words.stage.clear);
      case 'clearLeft':
      case 'clearStopped':
        stage.clear(words.stage[effect.do]);
        return this.#panel.say(words.stage[effect.do]);
      case 'probe':
        this.#probe();
        return undefined;
      case 'sayLost':
        return this.#panel.sayLost(this.#visit.state);
      case 'sayFound':
        return this.#panel.say(words.lost.found);
      case 'stopWaiting':
        return this.#sessionServer.stopWaiting();
      case 'reconnect':
        return this.#sessionServer.reconnect();
      case 'sayTurn':
        this.#panel.say(words.line.turn);
        return ring();
    }
  }

  /** @param {Extract<Effect, { do: 'connect' }>} effect */
  #open({ server, request }) {
    this.#link?.detach();
    const { name } = this.#choices();
    const start =
      'resume' in request
        ? request
        : { start: { url: request.world, pass: request.pass, resumable: true, early: true, name } };
    this.#link = new SimulationLink(server, start, (event) => this.take(event));
  }

  #leave() {
    this.#link?.leave();
    this.#close();
    const { wish } = this.#store;
    if (wish?.simulation) {
      this.#store.want(wish.world, wish.named);
    }
  }

  #close() {
    this.#link = undefined;
    this.#panel.stage.close();
  }

  /** Whether the session server answers, and with it the network. */
  async #probe() {
    const request = { cache: /** @type {const} */ ('no-store'), signal: AbortSignal.timeout(3000) };
    const answer = await fetch(new URL('load', this.#base), request).catch(() => undefined);
    this.take({ type: 'probed', answers: answer?.ok ?? false });
  }
}
