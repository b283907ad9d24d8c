// Stores the simulation of a tab while it runs, so that the page can resume it after a reload or a return. The store
// ends with the tab, and no other page can read it.

/** @typedef {import('./visit.js').Kept} Kept */

const NAME = 'simulation';
/** The page's own copy, if the browser stores nothing. @type {Kept | undefined} */
let own;

/**
 * The simulation of this tab, if it has one.
 * @returns {Kept | undefined}
 */
export function kept() {
  try {
    return JSON.parse(sessionStorage.getItem(NAME) ?? 'null') ?? own;
  } catch {
    return own;
  }
}

/**
 * Stores the simulation of this tab. Without the browser's store, it can't be resumed after a reload.
 * @param {Kept} simulation
 */
export function keep(simulation) {
  own = simulation;
  try {
    sessionStorage.setItem(NAME, JSON.stringify(simulation));
  } catch {
    // The page's own copy remains.
  }
}

/** Removes the simulation: it has ended, was left, or belongs to another tab. */
export function forget() {
  own = undefined;
  try {
    sessionStorage.removeItem(NAME);
  } catch {
    // Nothing was stored.
  }
}

/* the place in the line */

const TICKET = 'ticket';
/** How long a ticket is valid, in milliseconds: the session server sends it again and again. */
const VALIDITY = 30_000;
/** @type {{ world: string, ticket: string, at: number } | undefined} */
let place;

/**
 * Stores the ticket of this tab for its place in the line.
 * @param {string} world
 * @param {string} ticket
 */
export function keepTicket(world, ticket) {
  place = { world, ticket, at: Date.now() };
  try {
    sessionStorage.setItem(TICKET, JSON.stringify(place));
  } catch {
    // The page's own copy remains.
  }
}

/**
 * The world that this tab waits for, and its ticket, if it is still valid.
 * @returns {{ world: string, ticket: string } | undefined}
 */
export function keptTicket() {
  let stored = place;
  try {
    stored = JSON.parse(sessionStorage.getItem(TICKET) ?? 'null') ?? place;
  } catch {
    // The page's own copy remains.
  }
  return stored && Date.now() - stored.at < VALIDITY ? stored : undefined;
}

/**
 * The ticket for a world, if there is one.
 * @param {string} world
 */
export function ticketFor(world) {
  const stored = keptTicket();
  return stored?.world === world ? stored.ticket : undefined;
}

/** Removes the ticket: its turn is over, or the visitor waits no longer. */
export function forgetTicket() {
  place = undefined;
  try {
    sessionStorage.removeItem(TICKET);
  } catch {
    // Nothing was stored.
  }
}
