// The streaming protocol of Webots, as a viewer speaks it: texts over a WebSocket. No DOM.

/** Time without a scene after which the stream is requested by its newer name, in milliseconds. */
const SILENCE = 2000;
/** The names of the 3D stream, in the order in which they are tried if the server has not told which one it is. */
const KINDS = ['x3d', 'w3d'];

/**
 * An update of the scene, as the simulator sends it.
 * @typedef {{ time: number, updates?: { id: number, translation?: string, rotation?: string }[] }} Update
 */

/** @typedef {'pause' | 'real-time' | 'fast'} Mode */

/**
 * What a simulator sends. `closed` is the last event.
 * @typedef {{ is: 'loading', status: string, percent: number }
 *   | { is: 'model', xml: string }
 *   | { is: 'update', update: Update }
 *   | { is: 'mode', mode: Mode }
 *   | { is: 'time', time: number }
 *   | { is: 'reset' }
 *   | { is: 'console', text: string }
 *   | { is: 'closed' }} StreamEvent
 */

/** A connection to a simulator. */
export class Stream {
  #socket;
  #tell;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  /**
   * Whether the simulator has answered the request for its scene. It sends updates, errors and warnings to everybody,
   * asked or not: they say nothing about that.
   */
  #isAnswered = false;

  /**
   * Connects, and requests the scene.
   * @param {string} url
   * @param {{ kind?: string | undefined, isOnlooker?: boolean }} options the kind of stream that the simulator offers, if
   *   it is known; a new client makes the simulator pause, an onlooker, or a client that returns, does not
   * @param {(event: StreamEvent) => void} tell
   */
  constructor(url, { kind, isOnlooker = false }, tell) {
    this.#tell = tell;
    this.#socket = new WebSocket(`${url}/`);
    const kinds = kind ? [kind] : KINDS;
    this.#socket.addEventListener('open', () => this.#request(kinds, isOnlooker ? ';broadcast' : ''));
    this.#socket.addEventListener('message', ({ data }) => this.#read(String(data)));
    this.#socket.addEventListener('close', () => {
      clearTimeout(this.#timer);
      tell({ is: 'closed' });
    });
  }

  /**
   * @param {string[]} kinds
   * @param {string} suffix
   */
  #request([kind, ...others], suffix) {
    this.send(`${kind}${suffix}`);
    if (others.length === 0) {
      return;
    }
    this.#timer = setTimeout(() => {
      if (!this.#isAnswered) {
        this.#request(others, suffix);
      }
    }, SILENCE);
  }

  /** @param {string} text */
  send(text) {
    if (this.#socket.readyState === WebSocket.OPEN) {
      this.#socket.send(text);
    }
  }

  close() {
    this.#socket.close(1000);
  }

  /** @param {string} text */
  #read(text) {
    if (['world:', 'model:', 'loading:'].some((prefix) => text.startsWith(prefix))) {
      this.#isAnswered = true;
    }
    for (const event of events(text)) {
      this.#tell(event);
    }
  }
}

/**
 * The events of a text.
 * @param {string} text
 * @returns {StreamEvent[]}
 */
function events(text) {
  switch (text) {
    case 'paused by client':
      return [{ is: 'mode', mode: 'pause' }];
    case 'real-time':
    case 'fast':
      return [{ is: 'mode', mode: text }];
    case 'run':
      return [{ is: 'mode', mode: 'fast' }];
    case 'reset finished':
      return [{ is: 'reset' }];
  }
  const colon = text.indexOf(':');
  const rest = text.slice(colon + 1);
  switch (text.slice(0, Math.max(colon, 0))) {
    case 'application/json': {
      const update = JSON.parse(rest);
      // Up to R2022b the key was `poses`.
      return [{ is: 'update', update: { ...update, updates: update.updates ?? update.poses } }];
    }
    case 'model':
      return [{ is: 'model', xml: rest }];
    case 'loading': {
      const [status = '', percent = ''] = rest.split(':');
      return [{ is: 'loading', status: status.trim(), percent: Number(percent) }];
    }
    case 'pause':
      return [
        { is: 'mode', mode: 'pause' },
        { is: 'time', time: Number(rest) },
      ];
    case 'stdout':
    case 'stderr':
      return [{ is: 'console', text: text.split('\n').map(printed).join('\n') }];
  }
  return [];
}

/**
 * A line of the console without the name of its stream.
 * @param {string} line
 */
function printed(line) {
  const prefix = ['stdout:', 'stderr:'].find((name) => line.startsWith(name)) ?? '';
  return line.slice(prefix.length);
}
