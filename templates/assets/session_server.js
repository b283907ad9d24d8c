// The WebSocket of the session server: whether a simulation server is free, announcements, and the line for a server.

import { FleetReader } from './messages.js';

/** @typedef {import('./messages.js').Failure} Failure */

/** Pause before a new connection, in milliseconds. */
const RECONNECT = 2000;

/**
 * What the session server sends. `answered`: the answer to the request with this number; `ticketed`: it has a place in the
 * line, which is said again and again; `queued`, `estimated`: how many clients are ahead of it, and the seconds until its
 * turn.
 * @typedef {{ type: 'connected' }
 *   | { type: 'disconnected' }
 *   | { type: 'available', now: boolean }
 *   | { type: 'announced', text: string }
 *   | { type: 'ticketed', id: number }
 *   | { type: 'queued', id: number, ahead: number }
 *   | { type: 'estimated', id: number, seconds: number }
 *   | { type: 'answered', id: number, answer: { server: string, pass?: string | undefined } | { failure: Failure } }} FleetEvent
 */

export class SessionServer {
  #base;
  #store;
  #tell;
  #isClosed = false;
  /** @type {WebSocket} */
  #socket;
  /** The request that is not answered yet: another one replaces it. @type {{ id: number, world: string } | undefined} */
  #asked;

  /**
   * Connects, again and again.
   * @param {string} base the URL of the session server
   * @param {import('./kept.js').Store} store of tickets
   * @param {(event: FleetEvent) => void} tell
   */
  constructor(base, store, tell) {
    this.#base = base;
    this.#store = store;
    this.#tell = tell;
    this.#socket = this.#open();
  }

  #open() {
    const reader = new FleetReader();
    const url = new URL('session?announcements=1', this.#base);
    url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
    const socket = new WebSocket(url);
    socket.addEventListener('open', () => this.#tell({ type: 'connected' }));
    socket.addEventListener('message', ({ data }) => this.#read(reader.read(String(data))));
    const closed = () => {
      this.#asked = undefined;
      if (this.#isClosed) {
        return;
      }
      this.#tell({ type: 'disconnected' });
      setTimeout(() => {
        if (!this.#isClosed) {
          this.#socket = this.#open();
        }
      }, RECONNECT);
    };
    socket.addEventListener('close', closed, { once: true });
    return socket;
  }

  /** Gives up a connection that is dead, which the browser itself may notice only after minutes. */
  reconnect() {
    const socket = this.#socket;
    socket.close();
    queueMicrotask(() => socket.dispatchEvent(new Event('close')));
  }

  /** @param {import('./messages.js').FleetMessage | undefined} message */
  #read(message) {
    switch (message?.is) {
      case 'available':
        this.#tell({ type: 'available', now: message.now });
        break;
      case 'announced':
        this.#tell({ type: 'announced', text: message.text });
        break;
      case 'ticket':
        if (this.#asked) {
          this.#store.keepTicket(this.#asked.world, message.ticket);
          this.#tell({ type: 'ticketed', id: this.#asked.id });
        }
        break;
      case 'queued':
        if (this.#asked) {
          this.#tell({ type: 'queued', id: this.#asked.id, ahead: message.ahead });
        }
        break;
      case 'estimated':
        if (this.#asked) {
          this.#tell({ type: 'estimated', id: this.#asked.id, seconds: message.seconds });
        }
        break;
      case 'chosen':
        this.#answer({ server: message.server, pass: message.pass });
        break;
      case 'refused':
        this.#answer({ failure: message.failure });
        break;
    }
  }

  /** @param {{ server: string, pass?: string | undefined } | { failure: Failure }} answer */
  #answer(answer) {
    const asked = this.#asked;
    this.#asked = undefined;
    if (asked) {
      this.#tell({ type: 'answered', id: asked.id, answer });
    }
  }

  /**
   * Requests a simulation server for a world, at the place in the line that this tab had. Without a connection there is
   * no answer.
   * @param {number} id
   * @param {string} world
   * @param {string | undefined} name of the visitor
   */
  ask(id, world, name) {
    if (this.#socket.readyState !== WebSocket.OPEN) {
      return;
    }
    this.#asked = { id, world };
    this.#socket.send(
      JSON.stringify({ url: world, name, reason: true, wait: true, ticket: this.#store.ticketFor(world) }),
    );
  }

  /** Gives up the place in the line. */
  stopWaiting() {
    this.#asked = undefined;
    if (this.#socket.readyState === WebSocket.OPEN) {
      this.#socket.send(JSON.stringify({ wait: false }));
    }
  }

  /** Ends the connection, and with it the place in the line. */
  close() {
    this.#isClosed = true;
    this.#socket.close();
  }
}
