// A visitor of the viewer page in tests: the visit with a clock of its own, and the texts of servers.

import { words } from '../../templates/assets/english.js';
import { FleetReader, SimulationReader } from '../../templates/assets/messages.js';
import { view } from '../../templates/assets/page_view.js';
import { BEGIN, next } from '../../templates/assets/visit.js';

/** @typedef {import('../../templates/assets/visit.js').Event} VisitEvent */
/** @typedef {import('../../templates/assets/visit.js').Effect} Effect */

/** A visit, with a clock of its own and without chance. */
export class Visit {
  visit = BEGIN;
  now = 1_000_000;
  reader = new SimulationReader();
  /** All effects so far. @type {Effect[]} */
  effects = [];

  /** @param {VisitEvent[]} events */
  take(...events) {
    for (const event of events) {
      const { visit, effects } = next(this.visit, event, this.now, () => 0.5);
      this.visit = visit;
      this.effects.push(...effects);
      if (effects.some((effect) => effect.do === 'connect')) {
        this.reader = new SimulationReader();
      }
    }
    return this;
  }

  /**
   * Lets time pass, with the ticks that the visit asks for.
   * @param {number} seconds
   */
  pass(seconds) {
    const end = this.now + 1000 * seconds;
    while (this.visit.wakeAt !== undefined && this.visit.wakeAt <= end) {
      this.now = Math.max(this.now, this.visit.wakeAt);
      this.take({ type: 'tick' });
    }
    this.now = end;
    return this;
  }

  /**
   * The simulation server sends texts.
   * @param {string[]} texts
   */
  receive(...texts) {
    for (const text of texts) {
      const message = this.reader.read(text);
      if (message?.is === 'failed') {
        this.take({ type: 'closed', failure: message.failure });
      } else if (message) {
        this.take({ type: 'message', message });
      }
    }
    return this;
  }

  /**
   * The session server answers the last request.
   * @param {string[]} texts
   */
  answer(...texts) {
    const reader = new FleetReader();
    for (const text of texts) {
      const message = reader.read(text);
      if (message?.is === 'chosen') {
        const { server, pass } = message;
        this.take({ type: 'answered', id: this.visit.asked, answer: { server, pass } });
      } else if (message?.is === 'ticket') {
        this.take({ type: 'ticketed', id: this.visit.asked });
      } else if (message?.is === 'queued') {
        this.take({ type: 'queued', id: this.visit.asked, ahead: message.ahead });
      } else if (message?.is === 'estimated') {
        this.take({ type: 'estimated', id: this.visit.asked, seconds: message.seconds });
      } else if (message?.is === 'refused') {
        this.take({ type: 'answered', id: this.visit.asked, answer: { failure: message.failure } });
      }
    }
    return this;
  }

  get state() {
    return this.visit.state;
  }

  /** What the page shows. */
  get view() {
    return view(this.visit, this.now, words);
  }

  /** The names of the effects since the last call. */
  did() {
    const names = this.effects.map((effect) => effect.do);
    this.effects = [];
    return names;
  }
}
