// Stand-ins for what a browser has: timers that pass when a test says so, and WebSockets whose server is the test.

/** Replaces the timers of this process. */
export class Clock {
  now = 0;
  /** @type {Map<number, { at: number, call: () => void }>} */
  #timers = new Map();
  #count = 0;

  constructor() {
    Object.assign(globalThis, {
      /** @type {(call: () => void, pause: number) => number} */
      setTimeout: (call, pause) => {
        this.#count += 1;
        this.#timers.set(this.#count, { at: this.now + pause, call });
        return this.#count;
      },
      /** @type {(timer: number) => void} */
      clearTimeout: (timer) => this.#timers.delete(timer),
    });
  }

  /**
   * Lets time pass, with the timers that are due.
   * @param {number} milliseconds
   */
  pass(milliseconds) {
    const end = this.now + milliseconds;
    for (;;) {
      const [next] = [...this.#timers]
        .filter(([, { at }]) => at <= end)
        .sort(([, one], [, other]) => one.at - other.at);
      if (!next) {
        this.now = end;
        return;
      }
      const [timer, { at, call }] = next;
      this.#timers.delete(timer);
      this.now = at;
      call();
    }
  }
}

/** A WebSocket of a page; the test is its server. */
export class FakeWebSocket extends EventTarget {
  static OPEN = 1;
  /** All that were opened. @type {FakeWebSocket[]} */
  static all = [];
  readyState = 0;
  /** What the page has sent. @type {string[]} */
  sent = [];
  /** The close code of the page. @type {number | undefined} */
  closedWith;
  /** The server, called with each text. @type {(text: string) => void} */
  server = () => {};

  /** @param {string | URL} url */
  constructor(url) {
    super();
    this.url = String(url);
    FakeWebSocket.all.push(this);
  }

  /** Replaces the browser's; begins to count anew. */
  static install() {
    FakeWebSocket.all = [];
    Object.assign(globalThis, { WebSocket: FakeWebSocket });
  }

  /** The last that was opened. */
  static get last() {
    const last = FakeWebSocket.all.at(-1);
    if (!last) {
      throw new Error('no WebSocket was opened');
    }
    return last;
  }

  /** @param {string} text */
  send(text) {
    this.sent.push(text);
    this.server(text);
  }

  /** @param {number} [code] */
  close(code) {
    this.readyState = 3;
    this.closedWith = code;
  }

  /** The server accepts the connection. */
  open() {
    this.readyState = FakeWebSocket.OPEN;
    this.dispatchEvent(new Event('open'));
  }

  /**
   * The server sends texts.
   * @param {string[]} texts
   */
  receive(...texts) {
    for (const data of texts) {
      this.dispatchEvent(Object.assign(new Event('message'), { data }));
    }
  }

  /**
   * The server closes the connection.
   * @param {number} code
   */
  end(code) {
    this.readyState = 3;
    this.dispatchEvent(Object.assign(new Event('close'), { code, wasClean: code === 1000 }));
  }
}
