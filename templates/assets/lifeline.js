// Watches the connection to a simulation that waits for its client, and says when to try to come back.

/** No sign of life for so long means that the connection is lost, in seconds; Webots gives one every five. */
const SILENCE = 8;
/** A shorter one is not worth a word. */
const WORTH_A_WORD = 2;
/** How long a try may take: a second one would take its token away. In milliseconds. */
const TRY = 15_000;
/** A server that refuses all tries for so long, while the session server answers, is gone with its simulations; in milliseconds. */
const GONE = 2500;
/** Before the second try, doubled each time up to the longest, in milliseconds. */
const FIRST_PAUSE = 1000;
const LONGEST_PAUSE = 10_000;

/**
 * Events: `lost` ({ since, left }, in seconds; each second while there is no connection), `try` (come back now), `refused` (a
 * try has failed), `found` (there is a sign of life again), `over` (nobody can still be waiting).
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

  /** The simulation waits for so many seconds once its server has noticed that its client is away. */
  constructor(absence) {
    super();
    this.absence = absence;
    this.#timer = setInterval(() => this.#look(), 1000);
    addEventListener('online', this.#online);
  }

  /** For how long there has been no sign of life, in seconds. */
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
      // Those who were lost together don't come back together.
      const pause = Math.min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** (this.#tries - 1)) * (0.5 + Math.random());
      this.#next = Math.min(this.#next, Date.now() + pause);
      this.#tell('refused');
    }
    this.#look();
  }

  /** A try has failed although this page's own server answers: the network is there. */
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
    // The server may notice it later, by as long as it takes a connection to be silent.
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
