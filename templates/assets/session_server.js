// The WebSocket of the session server: whether a simulation server is free, announcements, and requests for a server.

import { FleetReader } from './messages.js';

/** @typedef {import('./messages.js').Failure} Failure */

/** Pause before a new connection, in milliseconds. */
const RECONNECT = 2000;

/**
 * What the session server sends. `answered`: the answer to the request with this number.
 * @typedef {{ type: 'connected' }
 *   | { type: 'disconnected' }
 *   | { type: 'available', now: boolean }
 *   | { type: 'announced', text: string }
 *   | { type: 'answered', id: number, answer: { server: string } | { failure: Failure } }} FleetEvent
 */

export class SessionServer {
  #tell;
  /** @type {WebSocket} */
  #socket;
  /** The numbers of the requests that are not answered yet; answers come in order. @type {number[]} */
  #asked = [];

  /**
   * Connects, again and again.
   * @param {(event: FleetEvent) => void} tell
   */
  constructor(tell) {
    this.#tell = tell;
    this.#socket = this.#open();
  }

  #open() {
    const reader = new FleetReader();
    const url = new URL('session?announcements=1', location.href);
    url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
    const socket = new WebSocket(url);
    socket.addEventListener('open', () => this.#tell({ type: 'connected' }));
    socket.addEventListener('message', ({ data }) => this.#read(reader.read(String(data))));
    socket.addEventListener('close', () => {
      this.#asked = [];
      this.#tell({ type: 'disconnected' });
      setTimeout(() => {
        this.#socket = this.#open();
      }, RECONNECT);
    });
    return socket;
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
      case 'chosen':
        this.#answer({ server: message.server });
        break;
      case 'refused':
        this.#answer({ failure: message.failure });
        break;
    }
  }

  /** @param {{ server: string } | { failure: Failure }} answer */
  #answer(answer) {
    const id = this.#asked.shift();
    if (id !== undefined) {
      this.#tell({ type: 'answered', id, answer });
    }
  }

  /**
   * Requests a simulation server for a world. Without a connection there is no answer.
   * @param {number} id
   * @param {string} world
   */
  ask(id, world) {
    if (this.#socket.readyState !== WebSocket.OPEN) {
      return;
    }
    this.#asked.push(id);
    this.#socket.send(JSON.stringify({ url: world, reason: true }));
  }
}
