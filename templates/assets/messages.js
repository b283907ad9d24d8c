// The texts that servers send on their WebSockets, read into messages. Texts that belong together become one message:
// a reason and its sentence, a kind of stream and its address. No DOM.

/**
 * Why something failed, as a server sends it before the sentence. What others have printed is in `output`.
 * @typedef {{ code: string, blame: string, retry: string, output?: string }} Reason
 */

/**
 * A refusal, a failed start or an end: the server's sentence and, from servers that send it, the reason.
 * @typedef {{ sentence: string, reason?: Reason | undefined }} Failure
 */

/**
 * How a client resumes its simulation: the token, and how many seconds the simulation waits for its client.
 * @typedef {{ token: string, absence: number }} Resumption
 */

/** What a start does. @typedef {'search' | 'fetch' | 'write' | 'done' | 'image' | 'launch' | 'load'} StepCode */

/** How far a start is; a server in Python tells it only as text. @typedef {{ text: string, step?: StepCode, percent?: number }} Progress
 */

/**
 * A message of a simulation server.
 * @typedef {{ is: 'queued', ahead: number }
 *   | { is: 'progress', progress: Progress }
 *   | { is: 'launched', closesIn: number }
 *   | { is: 'ready', address: string, kind: string | undefined }
 *   | { is: 'resumable', resumption: Resumption }
 *   | { is: 'watched', now: boolean }
 *   | { is: 'paced', share: number | undefined }
 *   | { is: 'idle', endsIn: number | undefined }
 *   | { is: 'failed', failure: Failure }
 *   | { is: 'alive' }} Message
 */

/**
 * What follows a prefix of a text; `undefined` if the text has another beginning.
 * @param {string} text
 * @param {string} prefix
 */
export function after(text, prefix) {
  return text.startsWith(prefix) ? text.slice(prefix.length).trim() : undefined;
}

/**
 * Reads a reason, with the sentence alone if the one that follows has more in it for older pages. A malformed one counts
 * as none.
 * @param {string} json
 * @returns {{ reason: Reason, message: string | undefined } | undefined}
 */
function parseReason(json) {
  try {
    const { code, blame, retry, message, output } = JSON.parse(json);
    if (![code, blame, retry].every((value) => typeof value === 'string')) {
      return undefined;
    }
    const text = (/** @type {unknown} */ value) => (typeof value === 'string' && value !== '' ? value : undefined);
    const printed = text(output);
    return { reason: { code, blame, retry, ...(printed && { output: printed }) }, message: text(message) };
  } catch {
    return undefined;
  }
}

/**
 * Reads progress. Malformed progress counts as none: the text that follows is shown.
 * @param {string} json
 * @returns {Progress | undefined}
 */
function parseProgress(json) {
  try {
    const { step, percent, text } = JSON.parse(json);
    if (typeof step !== 'string' || typeof text !== 'string') {
      return undefined;
    }
    return { text, step: /** @type {StepCode} */ (step), ...(typeof percent === 'number' && { percent }) };
  } catch {
    return undefined;
  }
}

/** Reads reasons, each of which belongs to the sentence that follows it. */
class Reasons {
  /** @type {ReturnType<typeof parseReason>} */
  #next;

  /**
   * Whether the text was a reason.
   * @param {string} text
   */
  take(text) {
    const json = after(text, 'reason:');
    if (json !== undefined) {
      this.#next = parseReason(json);
    }
    return json !== undefined;
  }

  /** Whether the next sentence has a reason. */
  get isPending() {
    return this.#next !== undefined;
  }

  /**
   * The failure of a sentence.
   * @param {string} sentence
   * @returns {Failure}
   */
  failure(sentence) {
    const { reason, message } = this.#next ?? {};
    this.#next = undefined;
    return { sentence: message ?? sentence, reason };
  }
}

/** Reads the texts of a simulation server's WebSocket. */
export class SimulationReader {
  #reasons = new Reasons();
  #absence = 0;
  /** @type {string | undefined} */
  #kind;
  /** Whether the next text says the same for Webots' page, which shows only texts that begin with `loading:`. */
  #isRepeated = false;

  /**
   * Reads a text; `undefined` if it belongs to the next one.
   * @param {string} text
   * @returns {Message | undefined}
   */
  read(text) {
    if (this.#reasons.take(text)) {
      return undefined;
    }
    const isReasoned = this.#reasons.isPending;
    // An end without an error is not called one.
    const sentence =
      after(text, 'loading: Error:') ?? after(text, 'error:') ?? (isReasoned ? after(text, 'loading:') : undefined);
    if (sentence !== undefined) {
      return { is: 'failed', failure: this.#reasons.failure(sentence) };
    }
    const isRepetition = this.#isRepeated;
    this.#isRepeated = false;
    const loading = after(text, 'loading:');
    if (loading === undefined) {
      return this.#readValue(text);
    }
    return isRepetition ? { is: 'alive' } : { is: 'progress', progress: { text: loading } };
  }

  /**
   * @param {string} text
   * @returns {Message | undefined}
   */
  #readValue(text) {
    const colon = text.indexOf(':');
    if (colon < 0) {
      return { is: 'alive' };
    }
    const value = text.slice(colon + 1).trim();
    switch (text.slice(0, colon)) {
      case 'queue':
        this.#isRepeated = true;
        return { is: 'queued', ahead: Number(value) };
      case 'progress': {
        const progress = parseProgress(value);
        this.#isRepeated = progress !== undefined;
        return progress ? { is: 'progress', progress } : { is: 'alive' };
      }
      case 'shutdownTimeout':
        return { is: 'launched', closesIn: Number(value) };
      case 'kind':
        this.#kind = value;
        return undefined;
      case 'webots':
        return { is: 'ready', address: value, kind: this.#kind };
      case 'absence':
        this.#absence = Number(value);
        return { is: 'alive' };
      case 'resume':
        return { is: 'resumable', resumption: { token: value, absence: this.#absence } };
      case 'watched':
        return { is: 'watched', now: value === '1' };
      case 'realTime':
        return { is: 'paced', share: Number(value) < 1 ? Number(value) : undefined };
      case 'idle':
        return { is: 'idle', endsIn: value === 'never' ? undefined : Number(value) };
      default:
        return { is: 'alive' };
    }
  }
}

/**
 * A message of the session server.
 * @typedef {{ is: 'available', now: boolean }
 *   | { is: 'announced', text: string }
 *   | { is: 'ticket', ticket: string }
 *   | { is: 'queued', ahead: number }
 *   | { is: 'estimated', seconds: number }
 *   | { is: 'chosen', server: string, pass?: string }
 *   | { is: 'refused', failure: Failure }} FleetMessage
 */

/** Reads the texts of the session server's WebSocket. */
export class FleetReader {
  #reasons = new Reasons();
  /** @type {string | undefined} */
  #pass;

  /**
   * Reads a text; `undefined` if it belongs to the next one, or is of a later version.
   * @param {string} text
   * @returns {FleetMessage | undefined}
   */
  read(text) {
    if (this.#reasons.take(text)) {
      return undefined;
    }
    if (text === '1' || text === '0') {
      return { is: 'available', now: text === '1' };
    }
    const announcement = after(text, 'announcement:');
    if (announcement !== undefined) {
      return { is: 'announced', text: announcement };
    }
    const sentence = after(text, 'Error:');
    if (sentence !== undefined) {
      return { is: 'refused', failure: this.#reasons.failure(sentence) };
    }
    if (text.startsWith('ws://') || text.startsWith('wss://')) {
      const pass = this.#pass;
      this.#pass = undefined;
      return { is: 'chosen', server: text, ...(pass && { pass }) };
    }
    return this.#readLine(text);
  }

  /**
   * Reads a text about the line.
   * @param {string} text
   * @returns {FleetMessage | undefined}
   */
  #readLine(text) {
    this.#pass = after(text, 'pass:') ?? this.#pass;
    const ticket = after(text, 'ticket:');
    if (ticket !== undefined) {
      return { is: 'ticket', ticket };
    }
    const ahead = after(text, 'queue:');
    if (ahead !== undefined) {
      return { is: 'queued', ahead: Number(ahead) };
    }
    const seconds = after(text, 'estimate:');
    return seconds === undefined ? undefined : { is: 'estimated', seconds: Number(seconds) };
  }
}
