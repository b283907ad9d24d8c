// Monitors the connection to a simulation that waits for its client, and decides when to try to return.

/** Time without a sign of life after which the connection is lost, in seconds; Webots gives one every five. */
const SILENCE = 8;
/** A shorter interruption is not shown. In seconds. */
const WORTH_A_WORD = 2;
/** Timeout of a try, in milliseconds: a second try would invalidate the token of the first. */
const TRY = 15_000;
/** A server that refuses all tries for this many milliseconds, while the session server answers, counts as gone. */
const GONE = 2500;
/** Pause before the second try, in milliseconds; it doubles each time up to the longest. */
const FIRST_PAUSE = 1000;
const LONGEST_PAUSE = 10_000;

/**
 * Events: `lost` ({ since, left }, in seconds; each second while there is no connection), `try` (return now), `refused`
 * (a try has failed), `found` (there is a sign of life again), `over` (the simulation can't be waiting any more).
 */
export class Lifeline extends EventTarget {
  #heard = Date.now();
  #isLost = false;
  #tries = 0;
  #next = 0;
  #refused;
  #timer;
  #online = () => {
    this.#next = 0;
  };

  /** `absence`: how many seconds the simulation waits once its server has noticed that the client is away. */
  constructor(absence) {
    super();
    this.absence = absence;
    this.#timer = setInterval(() => this.#look(), 1000);
    addEventListener('online', this.#online);
  }

  /** Time since the last sign of life, in seconds. */
  get silence() {
    return (Date.now() - this.#heard) / 1000;
  }

  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }

  /** There was a sign of life. */
  alive() {
    this.#heard = Date.now();
    this.#tries = 0;
    this.#next = 0;
    this.#refused = undefined;
    if (this.#isLost) {
      this.#isLost = false;
      this.#tell('found');
    }
  }

  /** The connection has closed. */
  broken() {
    this.#isLost = true;
    if (this.#tries > 0) {
      // Random, so that clients that were disconnected together do not return together.
      const pause = Math.min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** (this.#tries - 1)) * (0.5 + Math.random());
      this.#next = Math.min(this.#next, Date.now() + pause);
      this.#tell('refused');
    }
    this.#look();
  }

  /** A try has failed although this page's own server answers: the network works. */
  refused() {
    this.#refused ??= Date.now();
    if (this.#isLost && Date.now() - this.#refused >= GONE)
      this.#end();
  }

  #look() {
    const since = this.silence;
    if (!this.#isLost && since < SILENCE)
      return;
    this.#isLost = true;
    if (since >= WORTH_A_WORD)
      this.#tell('lost', { since, left: this.absence - since });
    // The server may notice the loss later, by its timeout of silent connections.
    if (this.#tries > 0 && since > 2 * this.absence) {
      this.#end();
    } else if (Date.now() >= this.#next) {
      this.#tries += 1;
      this.#next = Date.now() + TRY;
      this.#tell('try');
    }
  }

  #end() {
    this.close();
    this.#tell('over', this.silence);
  }

  close() {
    clearInterval(this.#timer);
    removeEventListener('online', this.#online);
  }
}
