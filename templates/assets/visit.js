// A visit of the viewer page as one state machine: what the page knows of the fleet, and the way of the visitor from a
// world's URL to a simulation and its end. No DOM, no clock, no randomness: `next` gets an event with the time, and
// returns the new visit with the effects that the page carries out.
//
//   idle -> asking -> connecting -> starting -> running <-> lost
//             ^  |        |            |           |          |
//             |  v        v            v           v          v
//   waiting, redirected <- (busy, elsewhere)     ended      ended

import { helpsToWait } from './reasons.js';

/** @typedef {import('./messages.js').Failure} Failure */
/** @typedef {import('./messages.js').Message} Message */
/** @typedef {import('./messages.js').Reason} Reason */
/** @typedef {import('./messages.js').Resumption} Resumption */

/** What a problem that the page itself has found consists of. Times in seconds.
 * @typedef {{ code: 'session-unreachable' | 'session-silent' | 'server-unreachable' | 'server-lost' | 'broken-before' | 'broken' | 'origin-refused' }
 *   | { code: 'absent', since: number }
 *   | { code: 'simulator-unreachable', address: string }
 *   | { code: 'no-scene', why: import('./scene.js').SceneProblem }} OwnProblem
 */

/** Why it did not go on: the failure that a server has sent, or what the page has found.
 * @typedef {Failure | OwnProblem} Problem
 */

/** Where a visitor wants to go. `attempt`: number of requests for another server; `wait`: the next pause while all are
 * busy, in milliseconds.
 * @typedef {{ world: string, attempt: number, wait: number }} Goal
 */

/** A goal on a simulation server. `isRestored`: the session server was not asked, because the page was loaded again.
 * @typedef {{ goal: Goal, server: string, isRestored: boolean }} Target
 */

/** What the server has said about a simulation. Points in time in milliseconds. `slow`: its share of real time, if it is slower.
 * @typedef {{ closesAt?: number | undefined, idleEndsAt?: number | undefined, isWatched: boolean, slow?: number | undefined }} Facts
 */

/** What is shown of a running simulation.
 * @typedef {{ is: 'connecting' }
 *   | { is: 'loading', status: string, percent: number }
 *   | { is: 'shown', title: string, runs: boolean }
 *   | { is: 'framed' }
 *   | { is: 'closed', until: number }} Scene
 */

/** A place in the line: how many are ahead, if that is known, and when it will be the visitor's turn, in milliseconds.
 * @typedef {{ ahead: number | undefined, turnAt?: number | undefined }} Line
 */

/** A request to the session server. `until`: how long the page waits for an answer. `id`: its number on the connection.
 * `early`: it is sent once the session server is there. `sent`: `line` is the place from before the connection broke.
 * `inLine`: the answer is a place in the line. `hasTicket`: the session server has sent a ticket, which it repeats: `until`
 * then something comes, and `isOverdue` if nothing came. `held`: the connection to the session server is broken, or not
 * there yet; it is sent again, for this place, whenever that is.
 * @typedef {{ is: 'early', until: number }
 *   | { is: 'sent', id: number, until: number, line: Line | undefined, hasTicket: boolean }
 *   | { is: 'inLine', id: number, line: Line, hasTicket: boolean, until: number | undefined, isOverdue: boolean }
 *   | { is: 'held', line: Line }} Request
 */

/** The states before a simulation server is known. `until`: when the next thing happens by itself.
 * @typedef {{ is: 'idle' }
 *   | { is: 'asking', goal: Goal, request: Request, waitsFor?: Problem | undefined }
 *   | { is: 'waiting', goal: Goal, why: Problem, until?: number | undefined }
 *   | { is: 'redirected', goal: Goal, why: Problem, until: number }} Unconnected
 */

/** Points in time: of the last sign of life of the server or the simulator, and of the last tick.
 * @typedef {{ heardAt: number, tickedAt: number }} Life
 */
/** The states on the way to a simulation; one that was accepted may have a token to return with. */
/** @typedef {Target & Life & { is: 'connecting', resumption?: Resumption | undefined, place: { is: 'opening' } | { is: 'asked' } | { is: 'queued', ahead: number } }} Connecting */
/** @typedef {Target & Life & { is: 'starting', resumption?: Resumption | undefined, phase: 'checkout' | 'launch', progress?: import('./messages.js').Progress | undefined, facts: Facts }} Starting */
/** @typedef {Target & Life & { is: 'running', address: string, scene: Scene, facts: Facts, resumption?: Resumption | undefined }} Running */
/** The simulation waits for this page, which tries to return. `hasRun`: its simulator was ready, as far as the page knows;
 * `wasShown`: the page still shows its scene;
 * `attempt`: how far the one that is under way has come; `refusedSince`: since when its server refuses all attempts although
 * the session server answers.
 * @typedef {Target & { is: 'lost', facts: Facts, heardAt: number, resumption: Resumption, hasRun: boolean, wasShown: boolean, isTold: boolean,
 *   tries: number, nextTry: number, attempt: 'none' | 'opening' | 'asked', refusedSince?: number | undefined }} Lost
 */
/** @typedef {Connecting | Starting | Running | Lost} Connected */
/** @typedef {Unconnected | Connected} Going */
/** It is over. `from`: the state in which the problem came.
 * @typedef {{ is: 'ended', problem: Problem, from: Going }} Ended
 */
/** @typedef {Going | Ended} State */
/** @typedef {Extract<State, { is: 'asking' }>} Asking */
/** @typedef {Extract<Request, { id: number }>} Answerable */

/** What is known of the fleet: whether a simulation server is free, or that there is no connection.
 * @typedef {'connecting' | 'free' | 'busy' | 'unreachable'} Fleet
 */

/** The visit. `asked`: number of requests so far; `wakeAt`: when `next` wants a `tick`.
 * @typedef {{ fleet: Fleet, state: State, asked: number, wakeAt: number | undefined }} Visit
 */

/** A simulation that this tab can resume.
 * @typedef {{ server: string, world: string, hasRun: boolean } & Resumption} Kept
 */

/**
 * @typedef {{ type: 'submitted', world: string }
 *   | { type: 'restored', kept: Kept }
 *   | { type: 'awaited', world: string }
 *   | { type: 'left' }
 *   | { type: 'hidden' }
 *   | { type: 'keep' }
 *   | { type: 'online' }
 *   | { type: 'tick' }
 *   | { type: 'probed', answers: boolean }
 *   | { type: 'scene', scene: Exclude<Scene, { is: 'closed' }> }
 *   | { type: 'sceneFailed', why: import('./scene.js').SceneProblem }
 *   | { type: 'sceneClosed' }
 *   | { type: 'mode', runs: boolean }
 *   | { type: 'heard' }
 *   | import('./session_server.js').FleetEvent
 *   | import('./simulation_link.js').LinkEvent} Event
 */

/**
 * What the page does. `leave` ends the simulation, `detach` lets it wait; both close the viewer. `freeze` keeps what the
 * viewer shows and closes its stream. `endAway` ends a simulation to which the page has no connection. `probe` finds out whether the session server answers; `reconnect` gives up the
 * connection to it, which is dead.
 * @typedef {{ do: 'ask', id: number, world: string }
 *   | { do: 'connect', server: string, request: { world: string, pass?: string | undefined } | { resume: string } }
 *   | { do: 'show', address: string, kind: string | undefined, server: string, isBack: boolean }
 *   | { do: 'endAway', server: string, token: string }
 *   | { do: 'store', kept: Kept }
 *   | { do: 'send', message: object }
 *   | { do: 'stopWaiting' | 'sayTurn' | 'reconnect' }
 *   | { do: 'clear' | 'clearLeft' | 'clearStopped' | 'leave' | 'detach' | 'freeze' | 'probe' | 'sayLost' | 'sayFound' }} Effect
 */

/** @typedef {{ fleet: Fleet, asked: number, now: number, random: () => number }} Surroundings */
/** @typedef {{ to: State, effects?: Effect[] }} Transition */

/** How long the session server has for an answer, in milliseconds. */
const ANSWER = 10_000;
/** Maximum of requests for another server, and the pause before the first one in milliseconds; it doubles each time. */
const MOST_ATTEMPTS = 3;
const FIRST_ATTEMPT = 1000;
/** Pause before the next request although a server is free, in milliseconds; it doubles up to the longest. */
const FIRST_WAIT = 2000;
const LONGEST_WAIT = 30_000;
/** Longest random pause after a server has become free, so that not all waiting pages ask at once, in milliseconds. */
const JITTER = 3000;
/** Reasons for which a pass is refused: the session server gives another one. */
const NO_PASS = ['invalid-pass', 'used-pass', 'expired-pass'];
/** Close codes after which another simulation server may accept the client: going away, try again later. */
const TRY_ANOTHER = [1001, 1013];
/** Time without a sign of life after which the connection is lost, in milliseconds; Webots gives one every five seconds. */
const SILENCE = 8000;
/** The same for a place in the line, whose ticket comes every 30 seconds and is valid for 60. */
const LINE_SILENCE = 45_000;
/** A shorter interruption is not shown. In milliseconds. */
export const SHOWN_AFTER = 2000;
/** Timeout of an attempt to connect, or to return, in milliseconds: a second one would invalidate the token of the first. */
const ATTEMPT = 15_000;
/** Time in which a browser tells that a page is left after it has closed its connections, in milliseconds. */
const UNLOADING = 500;
/** Pause after a failed attempt to return, in milliseconds; it doubles up to the longest. */
const FIRST_PAUSE = 1000;
const LONGEST_PAUSE = 10_000;
/** A server that refuses all attempts for this long, while the session server answers, counts as gone. In milliseconds. */
const GONE = 2500;
/** Time in which a simulation server reports an end after Webots has closed its stream, in milliseconds. */
const REPORT = 2000;
const SECOND = 1000;

/** @type {Visit} */
export const BEGIN = { fleet: 'connecting', state: { is: 'idle' }, asked: 0, wakeAt: undefined };

/**
 * The visit after an event, and what the page has to do.
 * @param {Visit} visit
 * @param {Event} event
 * @param {number} now in milliseconds
 * @param {() => number} random from 0 to 1
 * @returns {{ visit: Visit, effects: Effect[] }}
 */
export function next(visit, event, now, random) {
  const { state: from } = visit;
  const fleet = fleetAfter(visit.fleet, event);
  const { to, effects = [] } = transition(from, event, { fleet, asked: visit.asked, now, random }) ?? { to: from };
  // Whatever the way out: the connection does not outlive the states that hold it.
  if (isConnected(from) && !isConnected(to)) {
    effects.unshift({ do: event.type === 'hidden' && resumptionOf(from) ? 'detach' : 'leave' });
    if (from.is === 'lost' && (event.type === 'left' || event.type === 'submitted')) {
      effects.unshift({ do: 'endAway', server: from.server, token: from.resumption.token });
    }
  }
  const asked = to.is === 'asking' && 'id' in to.request ? to.request.id : visit.asked;
  return { visit: { fleet, state: to, asked, wakeAt: wakeAt(to, visit.wakeAt, now) }, effects };
}

/**
 * @param {Fleet} fleet
 * @param {Event} event
 * @returns {Fleet}
 */
function fleetAfter(fleet, event) {
  if (event.type === 'available') {
    return event.now ? 'free' : 'busy';
  }
  return event.type === 'disconnected' ? 'unreachable' : fleet;
}

/**
 * While there is a connection, the time goes on every second.
 * @param {State} state
 * @param {number | undefined} before
 * @param {number} now
 */
function wakeAt(state, before, now) {
  if (isConnected(state)) {
    const tick = before !== undefined && before > now && before <= now + SECOND ? before : now + SECOND;
    return state.is === 'lost' && state.nextTry > now ? Math.min(tick, state.nextTry) : tick;
  }
  const waits = state.is === 'asking' ? state.request : state;
  return 'until' in waits ? waits.until : undefined;
}

/**
 * @param {State} state
 * @returns {state is Connected}
 */
export function isConnected(state) {
  return ['connecting', 'starting', 'running', 'lost'].includes(state.is);
}

/**
 * How the simulation of a state can be resumed, if it can.
 * @param {State} state
 */
export function resumptionOf(state) {
  return isConnected(state) ? state.resumption : undefined;
}

/**
 * @param {State} state
 * @param {Event} event
 * @param {Surroundings} around
 * @returns {Transition | undefined}
 */
function transition(state, event, around) {
  switch (event.type) {
    case 'submitted':
      return ask({ world: event.world, attempt: 0, wait: FIRST_WAIT }, around, { before: [{ do: 'clear' }] });
    case 'restored':
      return restore(event.kept, around);
    case 'awaited':
      // It is asked for when the session server is there.
      return { to: held({ world: event.world, attempt: 0, wait: FIRST_WAIT }, { ahead: undefined }) };
    case 'left':
      return {
        to: { is: 'idle' },
        effects: isConnected(state) ? [{ do: 'clearLeft' }] : [{ do: 'stopWaiting' }, { do: 'clearStopped' }],
      };
    case 'hidden':
      return state.is === 'ended' ? undefined : { to: { is: 'idle' } };
  }
  switch (state.is) {
    case 'asking':
      return whileAsking(state, event, around);
    case 'waiting':
      return whileWaiting(state, event, around);
    case 'redirected':
      return event.type === 'tick' && around.now >= state.until ? askOnceThere(state, around) : undefined;
    case 'connecting':
    case 'starting':
      return whileStarting(state, event, around);
    case 'running':
      return whileRunning(state, event, around);
    case 'lost':
      return whileLost(state, event, around);
    case 'ended':
      return whileEnded(state, event);
  }
  return undefined;
}

/* the session server */

/**
 * Requests a simulation server. `waitsFor`: why it has waited; `line`: its place so far; `before`: effects before that.
 * @param {Goal} goal
 * @param {Surroundings} around
 * @param {{ waitsFor?: Problem | undefined, line?: Line | undefined, before?: Effect[] }} [after]
 * @returns {Transition}
 */
function ask(goal, { fleet, asked, now }, { waitsFor, line, before = [] } = {}) {
  const until = now + ANSWER;
  if (fleet === 'connecting' || fleet === 'unreachable') {
    /** @type {Going} */
    const asking = { is: 'asking', goal, request: { is: 'early', until }, waitsFor };
    const to = fleet === 'connecting' ? asking : end({ code: 'session-unreachable' }, asking);
    return { to, effects: before };
  }
  const id = asked + 1;
  return {
    to: { is: 'asking', goal, request: { is: 'sent', id, until, line, hasTicket: false }, waitsFor },
    effects: [...before, { do: 'ask', id, world: goal.world }],
  };
}

/**
 * Requests another simulation server, if the connection to the session server is broken once that is there again.
 * @param {Extract<State, { is: 'redirected' }>} state
 * @param {Surroundings} around
 * @returns {Transition}
 */
function askOnceThere(state, around) {
  const isThere = around.fleet === 'free' || around.fleet === 'busy';
  return isThere ? ask(state.goal, around) : { to: { ...state, until: around.now + FIRST_ATTEMPT } };
}

/**
 * @param {Asking} state
 * @param {Event} event
 * @param {Surroundings} around
 * @returns {Transition | undefined}
 */
function whileAsking(state, event, around) {
  const { goal, request } = state;
  const line = lineOf(state);
  if (event.type === 'disconnected') {
    return { to: line ? held(goal, line) : end({ code: 'session-unreachable' }, state) };
  }
  if (event.type === 'available' && !('id' in request)) {
    return ask(goal, around, { line });
  }
  if (event.type === 'tick' && 'until' in request && request.until !== undefined && around.now >= request.until) {
    return request.is === 'inLine'
      ? lineIsSilent(state, request, around.now)
      : { to: end({ code: 'session-silent' }, state) };
  }
  if (!('id' in event) || !('id' in request) || event.id !== request.id) {
    return undefined;
  }
  if (event.type === 'ticketed') {
    const ticketed = { ...request, hasTicket: true };
    return {
      to:
        line && ticketed.is === 'inLine' ? inLine(state, ticketed, line, around.now) : { ...state, request: ticketed },
    };
  }
  if (event.type === 'queued') {
    return { to: inLine(state, request, { ...line, ahead: event.ahead }, around.now) };
  }
  if (event.type === 'estimated') {
    const turnAt = around.now + SECOND * event.seconds;
    return { to: inLine(state, request, { ahead: line?.ahead, turnAt }, around.now) };
  }
  if ('failure' in event.answer) {
    const { failure } = event.answer;
    // After a redirection the session server may not have noticed yet that the last server can't take anybody.
    const isFinal = goal.attempt === 0 || failure.reason?.retry === 'no';
    return isFinal ? waitOrEnd(failure, goal, state, around) : redirect(failure, goal, state, around);
  }
  const { server, pass } = event.answer;
  /** @type {Effect[]} */
  const effects = [{ do: 'connect', server, request: { world: goal.world, ...(pass && { pass }) } }];
  return {
    to: { is: 'connecting', goal, server, isRestored: false, place: { is: 'opening' }, ...aliveAt(around.now) },
    effects: line ? [...effects, { do: 'sayTurn' }] : effects,
  };
}

/**
 * The session server has said something about a place in the line. One that sends no tickets may be silent.
 * @param {Asking} state
 * @param {Answerable} request
 * @param {Line} line
 * @param {number} now
 * @returns {Unconnected}
 */
function inLine(state, { id, hasTicket }, line, now) {
  const until = hasTicket ? now + LINE_SILENCE : undefined;
  return { ...state, request: { is: 'inLine', id, line, hasTicket, until, isOverdue: false } };
}

/**
 * Nothing has come from the line for too long. A page that was blocked may tick before it gets what has come meanwhile.
 * @param {Asking} state
 * @param {Extract<Request, { is: 'inLine' }>} request
 * @param {number} now
 * @returns {Transition}
 */
function lineIsSilent(state, request, now) {
  return request.isOverdue
    ? { to: { ...state, request: { ...request, until: undefined } }, effects: [{ do: 'reconnect' }] }
    : { to: { ...state, request: { ...request, until: now + SECOND, isOverdue: true } } };
}

/**
 * A place in the line, for which the session server is asked when it is there.
 * @param {Goal} goal
 * @param {Line} line
 * @returns {Unconnected}
 */
function held(goal, line) {
  return { is: 'asking', goal, request: { is: 'held', line } };
}

/**
 * The place in the line of a state, if it has one.
 * @param {State} state
 */
export function lineOf(state) {
  return state.is === 'asking' && 'line' in state.request ? state.request.line : undefined;
}

/**
 * @param {Extract<State, { is: 'waiting' }>} state
 * @param {Event} event
 * @param {Surroundings} around
 * @returns {Transition | undefined}
 */
function whileWaiting(state, event, around) {
  if (event.type === 'available' && event.now) {
    return { to: { ...state, until: around.now + JITTER * around.random() } };
  }
  if (event.type === 'available' && state.until === undefined) {
    return { to: { ...state, until: around.now + pauseWhileBusy(around) } };
  }
  if (event.type !== 'tick' || state.until === undefined || around.now < state.until) {
    return undefined;
  }
  if (around.fleet === 'unreachable') {
    // The next report sets another time.
    return { to: { ...state, until: undefined } };
  }
  return ask({ ...state.goal, attempt: 0 }, around, { waitsFor: state.why });
}

/**
 * While clients wait in the line, no server is free for others: who asks again gets a place in it.
 * @param {Pick<Surroundings, 'random'>} around
 */
function pauseWhileBusy({ random }) {
  return LONGEST_WAIT * (0.5 + random());
}

/**
 * Waits until a server is free, if that helps.
 * @param {Problem} problem
 * @param {Goal} goal
 * @param {Going} from
 * @param {Surroundings} around
 * @returns {Transition}
 */
function waitOrEnd(problem, goal, from, { fleet, now, random }) {
  if (!helpsToWait(reasonOf(problem))) {
    return { to: end(problem, from) };
  }
  const until = now + (fleet === 'free' ? goal.wait * (0.5 + random()) : pauseWhileBusy({ random }));
  return { to: { is: 'waiting', goal: { ...goal, wait: Math.min(LONGEST_WAIT, 2 * goal.wait) }, why: problem, until } };
}

/**
 * Requests another server after a pause: the session server notices within seconds that this one is stopping,
 * unreachable, or can't start the simulation.
 * @param {Problem} problem
 * @param {Goal} goal
 * @param {Going} from
 * @param {Surroundings} around
 * @returns {Transition}
 */
function redirect(problem, goal, from, around) {
  if (goal.attempt === MOST_ATTEMPTS) {
    return waitOrEnd(problem, goal, from, around);
  }
  const until = around.now + FIRST_ATTEMPT * 2 ** goal.attempt;
  return { to: { is: 'redirected', goal: { ...goal, attempt: goal.attempt + 1 }, why: problem, until } };
}

/* the way to a simulation */

/**
 * @param {Connecting | Starting} state
 * @param {Event} event
 * @param {Surroundings} around
 * @returns {Transition | undefined}
 */
function whileStarting(state, event, around) {
  const { now } = around;
  switch (event.type) {
    case 'opened':
      return state.is === 'connecting' ? { to: { ...state, place: { is: 'asked' }, heardAt: now } } : undefined;
    case 'closed':
      return startFailed(state, event, around);
    case 'tick':
      return startOn(state, around);
    case 'message':
      return hearOfStart({ ...state, heardAt: now }, event.message, now);
  }
  return undefined;
}

/**
 * @param {Connecting | Starting} state
 * @param {Message} message
 * @param {number} now
 * @returns {Transition}
 */
function hearOfStart(state, message, now) {
  if (message.is === 'ready') {
    const facts = factsAfter(state.is === 'starting' ? state.facts : { isWatched: false }, message, now);
    return run(state, message, facts, false, now, state.resumption);
  }
  if (message.is === 'resumable') {
    return keep(state, message.resumption, false);
  }
  return { to: startGoesOn(state, message, now) ?? state };
}

/**
 * A second of a start has passed. A server that sends tokens also sends signs of life; another one may be silent for as
 * long as it takes, once it has accepted the connection.
 * @param {Connecting | Starting} state
 * @param {Surroundings} around
 * @returns {Transition}
 */
function startOn(state, around) {
  const { now } = around;
  if (state.resumption && isSilent(state, SILENCE, now)) {
    return lose(state, state.resumption, now);
  }
  if (state.is === 'connecting' && state.place.is === 'opening' && isSilent(state, ATTEMPT, now)) {
    return startFailed(state, {}, around);
  }
  return { to: { ...state, tickedAt: now } };
}

/** @param {number} now @returns {Life} */
function aliveAt(now) {
  return { heardAt: now, tickedAt: now };
}

/**
 * Whether there was no sign of life for so many milliseconds. A page that was blocked, for example while it read a large
 * scene, may tick before it gets the messages that have come meanwhile: these are there before the next tick.
 * @param {Life} life
 * @param {number} limit
 * @param {number} now
 */
function isSilent({ heardAt, tickedAt }, limit, now) {
  return now - heardAt >= limit && tickedAt - heardAt >= limit - SECOND;
}

/**
 * The state after a message about a start. `undefined`: it says nothing about it.
 * @param {Connecting | Starting | Lost} state
 * @param {Message} message
 * @param {number} now
 * @returns {Connecting | Starting | undefined}
 */
function startGoesOn(state, message, now) {
  const { goal, server, isRestored, resumption } = state;
  const life = { heardAt: now, tickedAt: 'tickedAt' in state ? state.tickedAt : now };
  const target = { goal, server, isRestored, resumption, ...life };
  const facts = factsAfter('facts' in state ? state.facts : { isWatched: false }, message, now);
  const phase = state.is === 'starting' ? state.phase : 'checkout';
  switch (message.is) {
    case 'queued':
      return { ...target, is: 'connecting', place: { is: 'queued', ahead: message.ahead } };
    case 'progress':
      return {
        ...target,
        is: 'starting',
        phase: message.progress.step === 'launch' ? 'launch' : phase,
        progress: message.progress,
        facts,
      };
    case 'launched':
      return { ...target, is: 'starting', phase: 'launch', facts };
    default:
      return state.is === 'starting' ? { ...state, facts } : undefined;
  }
}

/**
 * The page has got a token to return with, which replaces the one before.
 * @template {Connecting | Starting | Running | Lost} T
 * @param {T} state
 * @param {Resumption} resumption
 * @param {boolean} hasRun
 * @returns {{ to: T, effects: Effect[] }}
 */
function keep(state, resumption, hasRun) {
  const { server, goal } = state;
  const kept = { ...resumption, server, world: goal.world, hasRun };
  return { to: { ...state, resumption }, effects: [{ do: 'store', kept }] };
}

/**
 * A start has failed: perhaps another server can do it, or this one later; or the page finds it again.
 * @param {Connecting | Starting | Lost} state
 * @param {import('./simulation_link.js').Closed} closed
 * @param {Surroundings} around
 * @returns {Transition}
 */
function startFailed(state, { code, failure, isForbidden }, around) {
  const { goal } = state;
  const isGranted = state.is !== 'connecting';
  if (isForbidden) {
    return { to: end({ code: 'origin-refused' }, state) };
  }
  if (!failure && state.resumption && state.is !== 'lost') {
    return loseClosed(state, state.resumption, around.now);
  }
  if (!failure) {
    return isGranted
      ? { to: end({ code: 'broken-before' }, state) }
      : redirect({ code: 'server-unreachable' }, goal, state, around);
  }
  const isForAnother = failure.reason
    ? failure.reason.retry === 'elsewhere' || NO_PASS.includes(failure.reason.code)
    : code !== undefined && TRY_ANOTHER.includes(code);
  return isForAnother ? redirect(failure, goal, state, around) : waitOrEnd(failure, goal, state, around);
}

/**
 * What a message says about a simulation.
 * @param {Facts} facts
 * @param {Message} message
 * @param {number} now
 * @returns {Facts}
 */
function factsAfter(facts, message, now) {
  switch (message.is) {
    case 'launched':
      return { ...facts, closesAt: now + SECOND * message.closesIn };
    case 'watched':
      return { ...facts, isWatched: message.now };
    case 'paced':
      return { ...facts, slow: message.share };
    case 'idle':
      return { ...facts, idleEndsAt: message.endsIn === undefined ? undefined : now + SECOND * message.endsIn };
    default:
      return facts;
  }
}

/* the simulation */

/**
 * The simulator is ready.
 * @param {Target} target
 * @param {Extract<Message, { is: 'ready' }>} ready
 * @param {Facts} facts
 * @param {boolean} isBack whether its client has returned to it
 * @param {number} now
 * @param {Resumption} [resumption]
 * @returns {{ to: Running, effects: Effect[] }}
 */
function run({ goal, server, isRestored }, { address, kind }, facts, isBack, now, resumption) {
  return {
    to: {
      is: 'running',
      goal,
      server,
      isRestored,
      address,
      facts,
      ...aliveAt(now),
      resumption,
      scene: { is: 'connecting' },
    },
    effects: [{ do: 'show', address, kind, server, isBack }],
  };
}

/**
 * @param {Running} state
 * @param {Event} event
 * @param {Surroundings} around
 * @returns {Transition | undefined}
 */
function whileRunning(state, event, { now }) {
  const { scene } = state;
  switch (event.type) {
    case 'message':
      return hear(state, event.message, now);
    case 'heard':
      return { to: { ...state, heardAt: now } };
    case 'keep':
      return { to: state, effects: [{ do: 'send', message: { keep: true } }] };
    case 'closed':
      if (event.failure) {
        return { to: end(event.failure, state) };
      }
      return state.resumption ? loseClosed(state, state.resumption, now) : { to: end({ code: 'broken' }, state) };
    case 'scene':
      return { to: { ...state, scene: event.scene } };
    case 'mode':
      return scene.is === 'shown' ? { to: { ...state, scene: { ...scene, runs: event.runs } } } : undefined;
    case 'sceneFailed':
      return { to: end({ code: 'no-scene', why: event.why }, state) };
    case 'sceneClosed':
      // Either the simulator has ended, which its server reports in a moment, or only the stream is lost.
      return {
        to:
          scene.is === 'connecting'
            ? end({ code: 'simulator-unreachable', address: state.address }, state)
            : { ...state, scene: { is: 'closed', until: now + REPORT } },
      };
    case 'tick':
      return runOn(state, now);
  }
  return undefined;
}

/**
 * A second has passed.
 * @param {Running} state
 * @param {number} now
 * @returns {Transition}
 */
function runOn(state, now) {
  const { scene, resumption } = state;
  const isStreamLost = scene.is === 'closed' && now >= scene.until;
  if (resumption && (isStreamLost || isSilent(state, SILENCE, now))) {
    return lose(state, resumption, now);
  }
  // If a controller has started the simulation, only its server still takes it for paused.
  const isKept = state.facts.idleEndsAt !== undefined && scene.is === 'shown' && scene.runs;
  return { to: { ...state, tickedAt: now }, effects: isKept ? [{ do: 'send', message: { keep: true } }] : [] };
}

/**
 * @param {Running} state
 * @param {Message} message
 * @param {number} now
 * @returns {Transition}
 */
function hear(state, message, now) {
  const facts = factsAfter(state.facts, message, now);
  if (message.is === 'ready') {
    return run(state, message, facts, false, now, state.resumption);
  }
  const to = { ...state, facts, heardAt: now };
  if (message.is !== 'resumable') {
    return { to };
  }
  return keep(to, message.resumption, true);
}

/* coming back */

/**
 * The connection is lost: the page tries at once to return.
 * @param {Running | Connecting | Starting} state
 * @param {Resumption} resumption
 * @param {number} now
 * @returns {Transition}
 */
function lose(state, resumption, now) {
  return tryAgain(lost(state, resumption, now), now, [{ do: 'freeze' }]);
}

/**
 * The connection has closed. Firefox closes those of a page before it says that the page is left: one that returned at
 * once would take the simulation from the page that is loaded next.
 * @param {Connecting | Starting | Running} state
 * @param {Resumption} resumption
 * @param {number} now
 * @returns {Transition}
 */
function loseClosed(state, resumption, now) {
  return { to: { ...lost(state, resumption, now), nextTry: now + UNLOADING }, effects: [{ do: 'freeze' }] };
}

/**
 * @param {Connecting | Starting | Running} state
 * @param {Resumption} resumption
 * @param {number} now
 * @returns {Lost}
 */
function lost(state, resumption, now) {
  const { goal, server, isRestored, heardAt } = state;
  return {
    is: 'lost',
    goal,
    server,
    isRestored,
    resumption,
    heardAt,
    hasRun: state.is === 'running',
    wasShown: state.is === 'running' && ['shown', 'closed', 'framed'].includes(state.scene.is),
    isTold: false,
    tries: 0,
    nextTry: now,
    attempt: 'none',
    // The server says again what still applies.
    facts: { closesAt: 'facts' in state ? state.facts.closesAt : undefined, isWatched: false },
  };
}

/**
 * The page was loaded again, or is shown again: its simulation waits.
 * @param {Kept} kept
 * @param {Surroundings} around
 * @returns {Transition}
 */
function restore({ server, world, token, absence, hasRun }, { now }) {
  return tryAgain(
    {
      is: 'lost',
      goal: { world, attempt: 0, wait: FIRST_WAIT },
      server,
      isRestored: true,
      resumption: { token, absence },
      heardAt: now,
      hasRun,
      wasShown: false,
      isTold: false,
      tries: 0,
      nextTry: now,
      attempt: 'none',
      facts: { isWatched: false },
    },
    now,
  );
}

/**
 * @param {Lost} state
 * @param {number} now
 * @param {Effect[]} [before]
 * @returns {Transition}
 */
function tryAgain(state, now, before = []) {
  return {
    to: { ...state, tries: state.tries + 1, nextTry: now + ATTEMPT, attempt: 'opening' },
    effects: [...before, { do: 'connect', server: state.server, request: { resume: state.resumption.token } }],
  };
}

/**
 * @param {Lost} state
 * @param {Event} event
 * @param {Surroundings} around
 * @returns {Transition | undefined}
 */
function whileLost(state, event, around) {
  const { now, random } = around;
  const away = now - state.heardAt;
  switch (event.type) {
    case 'message':
      return found(state, event.message, now);
    case 'opened':
      return { to: { ...state, attempt: 'asked' } };
    case 'closed': {
      if (event.failure && !state.hasRun && event.failure.reason?.code !== 'ended') {
        return startFailed(state, event, around);
      }
      if (event.failure) {
        return {
          to: end(
            isTooLate(state, event.failure, away) ? { code: 'absent', since: away / SECOND } : event.failure,
            state,
          ),
        };
      }
      // Random, so that clients that were disconnected together do not return together.
      const pause = Math.min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** (state.tries - 1)) * (0.5 + random());
      const nextTry = Math.min(state.nextTry, now + pause);
      return { to: { ...state, attempt: 'none', nextTry }, effects: [{ do: 'probe' }] };
    }
    case 'probed': {
      if (!event.answers) {
        return { to: { ...state, refusedSince: undefined } };
      }
      const refusedSince = state.refusedSince ?? now;
      if (now - refusedSince < GONE) {
        return { to: { ...state, refusedSince } };
      }
      return state.hasRun
        ? { to: end({ code: 'server-lost' }, state) }
        : redirect({ code: 'server-unreachable' }, state.goal, state, around);
    }
    case 'online':
      // An attempt that has asked may have its answer on the way, with the next token.
      return state.attempt === 'asked' ? undefined : { to: { ...state, nextTry: now } };
    case 'tick':
      return waitOn(state, away, now);
  }
  return undefined;
}

/**
 * The server answers again.
 * @param {Lost} state
 * @param {Message} message
 * @param {number} now
 * @returns {Transition}
 */
function found(state, message, now) {
  const facts = factsAfter(state.facts, message, now);
  /** @type {Effect[]} */
  const said = state.isTold ? [{ do: 'sayFound' }] : [];
  if (message.is === 'ready') {
    const { to, effects } = run(state, message, facts, state.hasRun, now, state.resumption);
    return { to, effects: [...effects, ...said] };
  }
  // It still waits for a slot, or starts.
  const start = state.hasRun ? undefined : startGoesOn(state, message, now);
  if (start) {
    return { to: start, effects: said };
  }
  const to = { ...state, facts, heardAt: now, tries: 1, refusedSince: undefined };
  return message.is === 'resumable' ? keep(to, message.resumption, state.hasRun) : { to };
}

/**
 * A second without a connection has passed.
 * @param {Lost} state
 * @param {number} away in milliseconds
 * @param {number} now
 * @returns {Transition}
 */
function waitOn(state, away, now) {
  // The server may notice the loss later, by its timeout of silent connections.
  if (away > 2 * SECOND * state.resumption.absence) {
    return { to: end({ code: 'absent', since: away / SECOND }, state) };
  }
  const isTold = state.isTold || away >= SHOWN_AFTER;
  /** @type {Effect[]} */
  const effects = isTold && !state.isTold ? [{ do: 'sayLost' }] : [];
  const told = { ...state, isTold };
  return now >= state.nextTry ? tryAgain(told, now, effects) : { to: told, effects };
}

/**
 * Whether a simulation that has ended did so because the page was away for too long.
 * @param {Lost} state
 * @param {Failure} failure
 * @param {number} away in milliseconds
 */
function isTooLate({ resumption }, { reason }, away) {
  return away > SECOND * resumption.absence && ['ended', 'away', undefined].includes(reason?.code);
}

/* the end */

/**
 * @param {Problem} problem
 * @param {Going} from
 * @returns {Ended}
 */
function end(problem, from) {
  return { is: 'ended', problem, from };
}

/**
 * A problem of the session server is over when it sends something again.
 * @param {Ended} state
 * @param {Event} event
 * @returns {Transition | undefined}
 */
function whileEnded({ problem }, event) {
  const isOver = 'code' in problem && (problem.code === 'session-unreachable' || problem.code === 'session-silent');
  return isOver && event.type === 'available' ? { to: { is: 'idle' } } : undefined;
}

/**
 * The reason of a problem, if a server has sent one.
 * @param {Problem} problem
 */
export function reasonOf(problem) {
  return 'sentence' in problem ? problem.reason : undefined;
}
