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
