// What the viewer page shows during a visit, derived from its state alone. No DOM.

import { adviceFor } from './reasons.js';
import { isConnected, lineOf, reasonOf, SHOWN_AFTER } from './visit.js';

/** @typedef {import('./language.js').Words} Words */
/** @typedef {import('./visit.js').Going} Going */
/** @typedef {import('./visit.js').Lost} Lost */
/** @typedef {import('./visit.js').Problem} Problem */
/** @typedef {import('./visit.js').State} State */
/** @typedef {import('./visit.js').Visit} Visit */

/** The steps, in their order. */
export const STEPS = /** @type {const} */ (['session', 'server', 'place', 'checkout', 'launch', 'simulation']);
/** @typedef {typeof STEPS[number]} StepName */

/** How far a visit is: those before `at` are done. `notes`: the texts of some.
 * @typedef {{ at: StepName, is: 'doing' | 'done' | 'failed', notes: Partial<Record<StepName, string>> }} Progress
 */

/** @typedef {{ text: string, advice: string }} Notice */

/**
 * What is shown. `sentence`: what the server said, if that is not the text. `idle`, `closes`: seconds left. `leave`: the label of the button that leaves, which is off without one.
 * @typedef {{ lamp: 'on' | 'off' | undefined, availability: string[], progress: Progress | undefined,
 *   notice: Notice | undefined, problem: (Notice & { sentence: string | undefined, output: string | undefined }) | undefined,
 *   idle: string | undefined, closes: string | undefined, isWatched: boolean, slow: string | undefined, leave: string | undefined }} PageView
 */

/**
 * @param {Visit} visit
 * @param {number} now in milliseconds
 * @param {Words} words
 * @returns {PageView}
 */
export function view({ fleet, state }, now, words) {
  const facts = isConnected(state) && 'facts' in state ? state.facts : undefined;
  const isLost = state.is === 'lost' && now - state.heardAt >= SHOWN_AFTER;
  /** @param {number | undefined} time */
  const left = (time) => (time === undefined ? undefined : (time - now) / 1000);
  const [idle, closes] = [left(facts?.idleEndsAt), left(facts?.closesAt)];
  const lamps = /** @type {const} */ ({ free: 'on', busy: 'off', connecting: undefined, unreachable: undefined });
  return {
    lamp: isLost ? undefined : lamps[fleet],
    availability: words.availability[isLost ? 'lost' : fleet],
    progress: state.is === 'ended' ? failedProgress(state.from, now, words) : progress(state, now, words),
    notice: isLost ? lostNotice(state, now, words) : waitingNotice(state, words),
    problem: state.is === 'ended' ? problemView(state.problem, words) : undefined,
    idle: idle === undefined ? undefined : words.idle(idle),
    closes: closes === undefined ? undefined : words.closes(closes),
    isWatched: facts?.isWatched ?? false,
    slow: facts?.slow === undefined ? undefined : words.slow(facts.slow),
    leave: leaveLabel(state, words),
  };
}

/**
 * @param {State} state
 * @param {Words} words
 */
function leaveLabel(state, words) {
  if (state.is === 'idle' || state.is === 'ended') {
    return undefined;
  }
  return waitingNotice(state, words) ? words.buttons.stop : words.buttons.leave;
}

/**
 * @param {State} state
 * @param {Words} words
 * @returns {Notice | undefined}
 */
export function waitingNotice(state, words) {
  if (lineOf(state)) {
    return { text: words.waiting.general, advice: words.line.advice };
  }
  const why = state.is === 'waiting' ? state.why : state.is === 'asking' ? state.waitsFor : undefined;
  if (!why) {
    return undefined;
  }
  const advice = adviceFor(reasonOf(why)?.code);
  const text = advice === 'share' || advice === 'idleTime' ? words.waiting[advice] : words.waiting.general;
  return { text, advice: words.waiting.advice };
}

/**
 * How long a lost simulation still waits, in seconds.
 * @param {Lost} state
 * @param {number} now
 */
export function timeLeft({ resumption, heardAt }, now) {
  return resumption.absence - (now - heardAt) / 1000;
}

/**
 * @param {Lost} state
 * @param {number} now
 * @param {Words} words
 * @returns {Notice}
 */
function lostNotice(state, now, words) {
  return { text: words.lost.since((now - state.heardAt) / 1000), advice: words.lost.waits(timeLeft(state, now)) };
}

/* problems */

/**
 * A sentence of a server begins with a capital, but an address stays as it is.
 * @param {string} sentence
 */
function capitalized(sentence) {
  const [first = ''] = sentence.split(' ');
  const isWord = [...first].every((letter) => letter >= 'a' && letter <= 'z');
  return isWord ? sentence.charAt(0).toUpperCase() + sentence.slice(1) : sentence;
}

/**
 * What happened; without words for the code, the sentence of the server.
 * @param {Problem} problem
 * @param {Words} words
 */
export function problemText(problem, words) {
  if ('sentence' in problem) {
    const known = new Map(Object.entries(words.reasons));
    return known.get(problem.reason?.code ?? '') ?? capitalized(problem.sentence);
  }
  switch (problem.code) {
    case 'absent':
      return words.problems.absent(problem);
    case 'simulator-unreachable':
      return words.problems['simulator-unreachable'](problem);
    case 'no-scene':
      return words.problems['no-scene'](problem);
    default:
      return words.problems[problem.code];
  }
}

/**
 * @param {Problem} problem
 * @param {Words} words
 */
function problemAdvice(problem, words) {
  if ('sentence' in problem) {
    return words.advice[adviceFor(problem.reason?.code)];
  }
  /** @type {Partial<Record<import('./visit.js').OwnProblem['code'], import('./reasons.js').AdviceName>>} */
  const own = {
    'simulator-unreachable': 'firewall',
    'server-lost': 'again',
    absent: 'again',
    'origin-refused': 'origin',
  };
  return words.advice[own[problem.code] ?? 'general'];
}

/**
 * @param {Problem} problem
 * @param {Words} words
 */
function problemView(problem, words) {
  const text = problemText(problem, words);
  const sentence = 'sentence' in problem ? capitalized(problem.sentence) : undefined;
  return {
    text,
    sentence: sentence === text ? undefined : sentence,
    advice: problemAdvice(problem, words),
    output: reasonOf(problem)?.output,
  };
}

/* steps */

/**
 * @param {Going} from
 * @param {number} now
 * @param {Words} words
 * @returns {Progress}
 */
function failedProgress(from, now, words) {
  return { ...(progress(from, now, words) ?? { at: 'session', notes: {} }), is: 'failed' };
}

/**
 * @param {Going} state
 * @param {number} now
 * @param {Words} words
 * @returns {Progress | undefined}
 */
function progress(state, now, words) {
  if (isConnected(state)) {
    return connectedProgress(state, words);
  }
  switch (state.is) {
    case 'asking': {
      const line = lineOf(state);
      if (line) {
        return { at: 'session', is: 'doing', notes: { session: lineNote(line, now, words) } };
      }
      return {
        at: 'session',
        is: 'doing',
        notes: { session: state.goal.attempt ? words.steps.choosingAnother : words.steps.choosing },
      };
    }
    case 'waiting':
      return { at: 'session', is: 'doing', notes: { session: words.steps.allBusy } };
    case 'redirected':
      return { at: 'session', is: 'doing', notes: { session: words.steps.redirected(problemText(state.why, words)) } };
    default:
      return undefined;
  }
}

/**
 * @param {import('./visit.js').Connected} state
 * @param {Words} words
 * @returns {Progress}
 */
function connectedProgress(state, words) {
  const session = state.isRestored ? words.steps.notAsked : words.steps.chosen;
  const asked = { session, server: state.server };
  switch (state.is) {
    case 'connecting':
      if (state.place.is === 'opening') {
        return { at: 'server', is: 'doing', notes: { session, server: words.steps.connecting(state.server) } };
      }
      return { at: 'place', is: 'doing', notes: { ...asked, place: placeNote(state.place, words) } };
    case 'starting': {
      const granted = { ...asked, place: words.steps.granted };
      return state.phase === 'checkout'
        ? { at: 'checkout', is: 'doing', notes: { ...granted, checkout: startNote(state, words) ?? '' } }
        : {
            at: 'launch',
            is: 'doing',
            notes: { ...granted, launch: startNote(state, words) ?? words.steps.launching },
          };
    }
    case 'running': {
      const ready = { ...asked, place: words.steps.granted, launch: words.steps.launched };
      const { is, note } = sceneProgress(state.scene, words);
      return { at: 'simulation', is, notes: { ...ready, simulation: note } };
    }
    case 'lost':
      if (!state.hasRun) {
        return { at: 'server', is: 'doing', notes: { session, server: words.steps.returning } };
      }
      return {
        at: 'simulation',
        is: state.wasShown ? 'done' : 'doing',
        notes: { ...asked, simulation: words.steps.returning },
      };
  }
}

/**
 * @param {import('./visit.js').Line} line
 * @param {number} now
 * @param {Words} words
 */
function lineNote({ ahead, turnAt }, now, words) {
  if (ahead === undefined) {
    return words.steps.choosing;
  }
  const position = words.steps.queued(ahead);
  return turnAt === undefined ? position : words.line.estimated(position, Math.max(0, (turnAt - now) / 1000));
}

/**
 * What the server says of a start; in other languages than its own, by the code of the step.
 * @param {import('./visit.js').Starting} state
 * @param {Words} words
 */
function startNote({ progress: told }, words) {
  /** @type {Partial<Record<import('./messages.js').StepCode, string>>} */
  const known = words.steps.progress;
  const step = told?.step && known[told.step];
  return step && told.percent !== undefined ? words.steps.loading(step, told.percent) : (step ?? told?.text);
}

/**
 * @param {Extract<import('./visit.js').Connecting['place'], { is: 'asked' | 'queued' }>} place
 * @param {Words} words
 */
function placeNote(place, words) {
  return place.is === 'queued' ? words.steps.queued(place.ahead) : words.steps.requesting;
}

/**
 * @param {import('./visit.js').Scene} scene
 * @param {Words} words
 * @returns {{ is: 'doing' | 'done' | 'failed', note: string }}
 */
function sceneProgress(scene, words) {
  switch (scene.is) {
    case 'connecting':
      return { is: 'doing', note: words.steps.joining };
    case 'loading':
      return { is: 'doing', note: words.steps.loading(scene.status, scene.percent) };
    case 'shown':
      return { is: 'done', note: scene.title || words.steps.shown };
    case 'framed':
      return { is: 'done', note: words.steps.framed };
    case 'closed':
      return { is: 'failed', note: words.steps.closed };
  }
}
