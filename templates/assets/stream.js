// The streaming protocol of Webots, as a viewer speaks it: texts over a WebSocket.

/** Time without an answer after which the stream is requested by its newer name, in milliseconds. */
const SILENCE = 2000;
/** Newer versions of Webots call their 3D stream `w3d`. */
const KINDS = ['x3d', 'w3d'];

/**
 * A connection to a simulator. Events: `loading` (text), `model` (XML), `update` (object), `mode` (`pause`,
 * `real-time` or `fast`), `time` (milliseconds), `reset`, `console` (text), `closed` (clean or not).
 */
export class Stream extends EventTarget {
  #socket;
  #timer;
  #heard = false;

  /** Opens the connection. A new client makes the simulator pause; an onlooker, or a client that returns, does not. */
  constructor(url, onlooker = false) {
    super();
    this.#socket = new WebSocket(`${url}/`);
    this.#socket.addEventListener('open', () => this.#introduce(onlooker ? ';broadcast' : '', 0));
    this.#socket.addEventListener('message', ({ data }) => {
      this.#heard = true;
      this.#understand(data);
    });
    this.#socket.addEventListener('close', ({ wasClean }) => {
      clearTimeout(this.#timer);
      this.#tell('closed', wasClean);
    });
  }

  #introduce(suffix, attempt) {
    this.send(KINDS[attempt] + suffix);
    this.#timer = setTimeout(() => {
      if (!this.#heard && attempt + 1 < KINDS.length)
        this.#introduce(suffix, attempt + 1);
    }, SILENCE);
  }

  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }

  send(text) {
    if (this.#socket.readyState === WebSocket.OPEN)
      this.#socket.send(text);
  }

  close() {
    this.#socket.close(1000);
  }

  #understand(text) {
    const rest = (prefix) => text.slice(prefix.length);
    if (text.startsWith('application/json:')) {
      const update = JSON.parse(rest('application/json:'));
      // Up to R2022b the key was `poses`.
      this.#tell('update', { ...update, updates: update.updates ?? update.poses });
    } else if (text.startsWith('model:'))
      this.#tell('model', rest('model:'));
    else if (text.startsWith('loading:')) {
      const [status, percent] = rest('loading:').split(':');
      this.#tell('loading', `${status.trim()} ${percent} %`);
    } else if (text.startsWith('pause:')) {
      this.#tell('mode', 'pause');
      this.#tell('time', Number(rest('pause:')));
    } else if (text === 'paused by client')
      this.#tell('mode', 'pause');
    else if (text === 'real-time' || text === 'fast')
      this.#tell('mode', text);
    else if (text === 'run')
      this.#tell('mode', 'fast');
    else if (text === 'reset finished')
      this.#tell('reset');
    else if (text.startsWith('stdout:') || text.startsWith('stderr:'))
      this.#tell('console', text.split('\n').map((line) => line.replace(/^(stdout|stderr):/, '')).join('\n'));
  }
}

/** Whether the simulator at this address is the demonstration's, as its scene says. */
export function isDemonstration(url) {
  return new Promise((resolve) => {
    const stream = new Stream(url, true);
    const answer = (found) => {
      clearTimeout(timer);
      stream.close();
      resolve(found);
    };
    const timer = setTimeout(() => answer(false), 3 * SILENCE);
    stream.addEventListener('model', ({ detail }) => answer(/name="simulator" content="demo"/.test(detail.slice(0, 500))));
    stream.addEventListener('closed', () => answer(false));
  });
}
