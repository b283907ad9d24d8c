// What a tab keeps of one simulation, so that a page that is loaded again, or returned to, goes on: the world that its
// visitor wants, the ticket for the place in the line, and how to resume the simulation. The store ends with the tab, and
// no page of another site can read it.

/** @typedef {import('./visit.js').Kept} Kept */

/** `named`: the world that the page names itself, which a visitor may have replaced; `ticket`: with the time when it came.
 * @typedef {{ world: string, named: string, ticket?: { text: string, at: number } | undefined, simulation?: Kept | undefined }} Wish
 */

/** How long a ticket is valid, in milliseconds: the session server sends it again and again. */
const VALIDITY = 60_000;

export class Store {
  #name;
  /** The page's own copy, if the browser stores nothing. @type {Wish | undefined} */
  #own;

  /** @param {string} name of the simulation, among those of the tab */
  constructor(name) {
    this.#name = name;
  }

  /**
   * What is kept, if there is something.
   * @returns {Wish | undefined}
   */
  get wish() {
    try {
      return JSON.parse(sessionStorage.getItem(this.#name) ?? 'null') ?? this.#own;
    } catch {
      return this.#own;
    }
  }

  /**
   * Without the browser's store, nothing is left after a reload.
   * @param {Wish | undefined} wish
   */
  #write(wish) {
    this.#own = wish;
    try {
      if (wish) {
        sessionStorage.setItem(this.#name, JSON.stringify(wish));
      } else {
        sessionStorage.removeItem(this.#name);
      }
    } catch {
      // The page's own copy remains.
    }
  }

  /**
   * The visitor wants this world; the ticket for it remains.
   * @param {string} world
   * @param {string} named the world that the page names
   */
  want(world, named) {
    const { wish } = this;
    this.#write({ world, named, ticket: wish?.world === world ? wish.ticket : undefined });
  }

  /** @param {Kept} simulation */
  keep(simulation) {
    this.#write({ world: simulation.world, named: this.wish?.named ?? '', simulation });
  }

  /**
   * @param {string} world
   * @param {string} text
   */
  keepTicket(world, text) {
    this.#write({ world, named: this.wish?.named ?? '', ticket: { text, at: Date.now() } });
  }

  /**
   * The ticket for a world, if there is a valid one.
   * @param {string} world
   */
  ticketFor(world) {
    const { wish } = this;
    const isValid = wish?.ticket && wish.world === world && Date.now() - wish.ticket.at < VALIDITY;
    return isValid ? wish.ticket?.text : undefined;
  }

  /** It is over, or was left. */
  forget() {
    this.#write(undefined);
  }
}
