// What the reasons of failures mean for a visitor: the advice, and whether waiting or another server helps.

/** @typedef {import('./messages.js').Reason} Reason */

/** The advice that a page has words for. @typedef {keyof typeof import('./english.js').words.advice} AdviceName */

/**
 * The advice for each reason of a server, by its name in the page's words.
 * @satisfies {Record<string, AdviceName>}
 */
export const ADVICE = {
  'invalid-request': 'general',
  'too-many-requests': 'later',
  'invalid-world': 'address',
  'repository-not-allowed': 'allowed',
  'repository-blocked': 'allowed',
  'no-idle-time': 'idleTime',
  'no-server-available': 'later',
  'queue-full': 'later',
  'invalid-pass': 'again',
  'used-pass': 'again',
  'expired-pass': 'again',
  'share-used': 'share',
  draining: 'elsewhere',
  'not-ready': 'administrator',
  'nothing-to-reset': 'general',
  'repository-not-found': 'exists',
  'repository-moved': 'moved',
  'commit-not-found': 'exists',
  'world-not-found': 'exists',
  'project-too-large': 'smaller',
  'checkout-timeout': 'smaller',
  'remote-failed': 'later',
  'invalid-project': 'project',
  'remote-unreachable': 'administrator',
  'image-not-found': 'project',
  'builders-busy': 'later',
  'build-failed': 'project',
  'build-timeout': 'project',
  'image-too-large': 'project',
  'load-failed': 'project',
  'load-timeout': 'project',
  'launch-failed': 'administrator',
  'disk-full': 'administrator',
  'docker-unavailable': 'administrator',
  'server-fault': 'administrator',
  left: 'again',
  away: 'again',
  'no-viewer': 'again',
  'taken-over': 'takenOver',
  finished: 'again',
  'time-limit': 'again',
  idle: 'again',
  'stopped-by-administrator': 'teacher',
  'server-stopped': 'elsewhere',
  crashed: 'project',
  hung: 'project',
  'memory-limit': 'project',
  'out-of-memory': 'later',
  'disk-limit': 'project',
  lost: 'general',
  ended: 'again',
  // Why a server gets no clients: administrators read these.
  'no-answer': 'elsewhere',
  'invalid-answer': 'elsewhere',
  'starts-fail': 'elsewhere',
};

/**
 * The advice for a code. Codes of later versions, and failures without one, get the general advice.
 * @param {string | undefined} code
 * @returns {AdviceName}
 */
export function adviceFor(code) {
  const advice = new Map(Object.entries(ADVICE));
  return advice.get(code ?? '') ?? 'general';
}

/**
 * Whether a client that waits is served when others leave.
 * @param {Reason | undefined} reason
 */
export function helpsToWait(reason) {
  return reason?.retry === 'later' && (reason.blame === 'fleet' || reason.code === 'share-used');
}
