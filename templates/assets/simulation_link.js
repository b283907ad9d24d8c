// The WebSocket of a simulation server, which holds a client's simulation.

import { SimulationReader } from './messages.js';

/** @typedef {import('./messages.js').Failure} Failure */
/** @typedef {import('./messages.js').Message} Message */

/** Time to wait for the close code after a sentence without a reason, in milliseconds. */
const CLOSING = 1000;

/** Timeout of the question why a connection could not be opened, in milliseconds. */
const WHY = 3000;

/** The failure, if the server has sent one, and the close code, if it is known. `isForbidden`: the server accepts no
 * connections of pages of this site.
 * @typedef {{ code?: number | undefined, failure?: Failure | undefined, isForbidden?: boolean }} Closed
 */

/**
 * What happens on the connection. `closed` is the last event.
 * @typedef {{ type: 'opened' }
 *   | { type: 'message', message: Message }
 *   | ({ type: 'closed' } & Closed)} LinkEvent
 */

export class SimulationLink {
  #socket;
  #reader = new SimulationReader();
  #tell;
  #isOver = false;
  #isOpen = false;
  /** @type {Failure | undefined} */
  #failure;

  /**
   * Connects, and sends a request as soon as the connection is open.
   * @param {string} server the WebSocket address of the simulation server
   * @param {object} request
   * @param {(event: LinkEvent) => void} tell
   */
  constructor(server, request, tell) {
    this.#tell = tell;
    this.#socket = new WebSocket(`${server}/client`);
    this.#socket.addEventListener('open', () => {
      if (this.#isOver) {
        return;
      }
      this.#isOpen = true;
      this.send(request);
      tell({ type: 'opened' });
    });
    this.#socket.addEventListener('message', ({ data }) => this.#read(String(data)));
    const url = `${server}/client`.replace(/^ws/, 'http');
    this.#socket.addEventListener('close', async ({ code }) => {
      // A browser does not tell why a connection could not be opened. One that the page gave up needs no reason.
      const isForbidden = !this.#isOver && !this.#isOpen && 'start' in request && (await forbids(url));
      this.#end(code, isForbidden);
    });
  }

  /** @param {string} text */
  #read(text) {
    if (this.#isOver || this.#failure) {
      return;
    }
    const message = this.#reader.read(text);
    if (message?.is === 'failed') {
      this.#failure = message.failure;
      if (message.failure.reason) {
        this.#end();
      } else {
        // Without a reason, the close code shows whether another server may accept the client.
        setTimeout(() => this.#end(), CLOSING);
      }
    } else if (message) {
      this.#tell({ type: 'message', message });
    }
  }

  /**
   * @param {number} [code]
   * @param {boolean} [isForbidden]
   */
  #end(code, isForbidden) {
    if (this.#isOver) {
      return;
    }
    this.#isOver = true;
    this.#tell({ type: 'closed', code, failure: this.#failure, ...(isForbidden && { isForbidden }) });
  }

  /** @param {object} message */
  send(message) {
    if (this.#socket.readyState === WebSocket.OPEN) {
      this.#socket.send(JSON.stringify(message));
    }
  }

  /** Closes the connection. A simulation that can be resumed waits. */
  detach() {
    this.#isOver = true;
    this.#socket.close();
  }

  /** Closes the connection, and ends the simulation. */
  leave() {
    this.#isOver = true;
    this.#socket.close(1000);
  }
}

/**
 * Ends a simulation that waits for this client, if its server can be reached now.
 * @param {string} server the WebSocket address of the simulation server
 * @param {string} token
 */
export function endAway(server, token) {
  const socket = new WebSocket(`${server}/client`);
  socket.addEventListener('open', () => {
    socket.send(JSON.stringify({ resume: token }));
    socket.close(1000);
  });
}

/**
 * Whether the server refuses pages of this site.
 * @param {string} url
 */
async function forbids(url) {
  const answer = await fetch(url, { signal: AbortSignal.timeout(WHY) }).catch(() => undefined);
  return answer?.status === 403;
}
