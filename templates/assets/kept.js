// What a tab keeps of its simulation while it runs: with it a page that is loaded again, or was left, finds it again. It
// ends with the tab, and no other page gets it.

const NAME = 'simulation';
/** What the page itself keeps, where the browser keeps nothing. */
let own;

/** The simulation of this tab, if it has one: server, world, token, absence. */
export function kept() {
  try {
    return JSON.parse(sessionStorage.getItem(NAME)) ?? own;
  } catch {
    return own;
  }
}

/** Keeps the simulation of this tab. A browser that keeps nothing can't come back to it after a reload. */
export function keep(simulation) {
  own = simulation;
  try {
    sessionStorage.setItem(NAME, JSON.stringify(simulation));
  } catch {
    // There is nothing to be done about that.
  }
}

/** The simulation has ended, or is somebody else's. */
export function forget() {
  own = undefined;
  try {
    sessionStorage.removeItem(NAME);
  } catch {
    // Nothing was kept.
  }
}
