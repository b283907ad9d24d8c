// The visit of the viewer page: events in, states and effects out.

import assert from 'node:assert/strict';
import { test } from 'node:test';
import { Visit } from './visitor.js';

/** @typedef {import('../../templates/assets/visit.js').Event} VisitEvent */
/** @typedef {import('../../templates/assets/messages.js').Reason} Reason */

const WORLD = 'https://github.com/demo/worlds/blob/main/worlds/playground.wbt';
const SERVER = 'ws://one:2000';
const TOKEN = 'f00d';
const KEPT = { server: SERVER, world: WORLD, token: TOKEN, absence: 60, hasRun: true };
const SHOWN = /** @type {const} */ ({ type: 'scene', scene: { is: 'shown', title: 'Playground', runs: false } });

/** @type {(code: string, blame: string, retry: string, output?: string) => Reason} */
const reason = (code, blame, retry, output) => ({ code, blame, retry, ...(output && { output }) });
const FULL = reason('no-server-available', 'fleet', 'later');
const DRAINING = reason('draining', 'server', 'elsewhere');
const CRASHED = reason('crashed', 'project', 'here');

/** A visit whose session server is free, and was asked for a world. */
const asking = () =>
  new Visit().take({ type: 'connected' }, { type: 'available', now: true }).take({ type: 'submitted', world: WORLD });
/** One that was led to a simulation server. */
const connecting = () => asking().answer(SERVER).take({ type: 'opened' });
/** One whose simulation can be resumed, and is shown. */
const running = () =>
  connecting()
    .receive(
      'session: 1',
      'loading: Step 1/9 : fetching',
      'shutdownTimeout: 7200',
      'kind: w3d',
      'webots:ws://one:2001',
      'absence: 60',
      `resume: ${TOKEN}`,
    )
    .take(SHOWN);
/** A step of a start, for programs and for Webots' page. @type {(code: string, text: string) => string[]} */
const step = (code, text) => [`progress: ${JSON.stringify({ step: code, text })}`, `loading: ${text}`];
/** A sentence of a server behind its reason. @type {(sentence: string, why?: Reason) => string[]} */
const error = (sentence, why) => [...(why ? [`reason: ${JSON.stringify(why)}`] : []), `loading: Error: ${sentence}`];

test('a place in the line, its turn, and the pass', () => {
  const visit = asking();
  visit.answer('ticket: t', 'queue: 2', 'estimate: 240');
  assert.equal(visit.view.progress?.notes.session, '2 clients are ahead of you, about 4 minutes');
  assert.equal(visit.view.leave, 'Stop waiting');
  // It waits longer than any answer may take.
  for (let time = 0; time < 20; ++time) {
    visit.pass(30).answer('ticket: t');
  }
  visit.answer('queue: 0');
  assert.equal(visit.view.progress?.notes.session, 'you are next, about 1 minute');
  visit.answer('pass: p', SERVER);
  const request = { world: WORLD, pass: 'p' };
  assert.deepEqual(visit.effects.slice(-2), [{ do: 'connect', server: SERVER, request }, { do: 'sayTurn' }]);
  // A pass that is refused leads to another one.
  visit.take(
    { type: 'opened' },
    { type: 'closed', failure: { sentence: 'late', reason: reason('expired-pass', 'user', 'later') } },
  );
  assert.equal(visit.state.is, 'redirected');
});

test('the place in the line is kept without a connection, after a reload, and until it is given up', () => {
  const visit = asking();
  visit.answer('queue: 5').take({ type: 'disconnected' });
  assert.equal(visit.view.progress?.notes.session, '5 clients are ahead of you');
  visit.take({ type: 'available', now: false });
  assert.deepEqual(visit.effects.at(-1), { do: 'ask', id: 2, world: WORLD });
  visit.answer('queue: 4').take({ type: 'left' });
  assert.deepEqual(visit.effects.slice(-2), [{ do: 'stopWaiting' }, { do: 'clearStopped' }]);
  const reloaded = new Visit().take({ type: 'awaited', world: WORLD });
  assert.equal(reloaded.view.leave, 'Stop waiting');
  reloaded.take({ type: 'available', now: false });
  assert.deepEqual(reloaded.effects.at(-1), { do: 'ask', id: 1, world: WORLD });
});

test('a visit from the start to the end', () => {
  const visit = asking();
  assert.deepEqual(visit.effects.at(-1), { do: 'ask', id: 1, world: WORLD });
  assert.equal(visit.view.progress?.at, 'session');
  visit.answer(SERVER);
  assert.deepEqual(visit.effects.at(-1), { do: 'connect', server: SERVER, request: { world: WORLD } });
  assert.deepEqual([visit.view.progress?.at, visit.view.progress?.notes.server], ['server', `connecting to ${SERVER}`]);
  visit.take({ type: 'opened' }).receive('session: 1', 'queue: 2', 'loading: waiting for a place, 2 clients are ahead');
  assert.deepEqual(
    [visit.view.progress?.at, visit.view.progress?.notes.place],
    ['place', '2 clients are ahead of you'],
  );
  visit.receive(...step('fetch', 'fetching 40 %'));
  assert.deepEqual([visit.view.progress?.at, visit.view.progress?.notes.checkout], ['checkout', 'fetching 40 %']);
  visit.receive(...step('launch', 'webots is starting'));
  assert.equal(visit.view.progress?.at, 'launch');
  visit.receive('shutdownTimeout: 7200');
  assert.deepEqual([visit.view.progress?.at, visit.view.closes], ['launch', 'It will be closed in 2 hours.']);
  visit.receive('kind: w3d', 'webots:ws://one:2001');
  assert.deepEqual(visit.effects.at(-1), {
    do: 'show',
    address: 'ws://one:2001',
    kind: 'w3d',
    server: SERVER,
    isBack: false,
  });
  visit.receive('absence: 60', `resume: ${TOKEN}`);
  assert.deepEqual(visit.effects.at(-1), { do: 'store', kept: KEPT });
  visit.take({ type: 'scene', scene: { is: 'loading', status: 'Parsing nodes', percent: 50 } });
  assert.deepEqual(visit.view.progress?.notes.simulation, 'Parsing nodes 50%');
  visit.take(SHOWN);
  assert.deepEqual([visit.view.progress?.at, visit.view.progress?.is], ['simulation', 'done']);
  visit.did();
  visit.take({ type: 'left' });
  assert.deepEqual([visit.state.is, visit.did()], ['idle', ['leave', 'clearLeft']]);
  assert.deepEqual([visit.view.leave, visit.visit.wakeAt], [undefined, undefined]);
});

test('what a project prints changes nothing', () => {
  const outputs = [
    'No such file or directory',
    'all places on the grid are taken',
    'This simulation server has no Webots that it can run',
    'no simulation server available at the moment. Clients of your address have 3 places, and You have 7 places',
    'loading: Error: draining\nreason: {"code":"draining","blame":"server","retry":"elsewhere"}',
    'this simulation was taken over elsewhere; the session server could not be reached; it has ended',
  ];
  for (const output of outputs) {
    const quiet = running().receive(...error('Webots ended with exit code 1', CRASHED));
    const loud = running().receive(...error('Webots ended with exit code 1', { ...CRASHED, output }));
    assert.deepEqual(loud.did(), quiet.did());
    assert.equal(loud.state.is, 'ended');
    assert.deepEqual(loud.view, { ...quiet.view, problem: { ...quiet.view.problem, output } });
    // A server without reasons has the output in its sentence.
    const python = running().receive(...error(output));
    assert.deepEqual(python.view.problem, { ...python.view.problem, advice: unreasoned().advice, output: undefined });
    assert.equal(python.view.problem?.text.toLowerCase(), output.toLowerCase());
    python.pass(3600);
    assert.equal(python.state.is, 'ended');
    // Nor has a start that fails other consequences.
    for (const start of [connecting(), asking().answer(SERVER).receive('loading: Step 1/9 : x')]) {
      start
        .receive(...error('the image could not be built', reason('build-failed', 'project', 'no', output)))
        .pass(3600);
      assert.equal(start.state.is, 'ended');
    }
  }
});

/** What is shown for a failure without a reason. */
function unreasoned() {
  const { problem } = running().receive(...error('something')).view;
  assert.ok(problem);
  return problem;
}

test('a server without reasons: its sentence, general advice, another server by the close code alone', () => {
  const failure = { sentence: 'no simulation server available' };
  for (const [code, expected] of /** @type {const} */ ([
    [1001, 'redirected'],
    [1013, 'redirected'],
    [1000, 'ended'],
    [1011, 'ended'],
    [undefined, 'ended'],
  ])) {
    assert.equal(connecting().take({ type: 'closed', code, failure }).state.is, expected, String(code));
  }
  assert.equal(running().take({ type: 'closed', code: 1001, failure }).state.is, 'ended');
  const refused = asking().answer('Error: no simulation server available at the moment.');
  assert.deepEqual(refused.view.problem, {
    text: 'No simulation server available at the moment.',
    advice: unreasoned().advice,
    output: undefined,
    sentence: undefined,
  });
});

test('while all are busy it waits, and starts when one is free', () => {
  const reasons = [FULL, reason('queue-full', 'fleet', 'later'), reason('share-used', 'user', 'later')];
  for (const why of reasons) {
    const visit = connecting()
      .take({ type: 'available', now: false })
      .receive(...error('all slots are taken', why));
    assert.equal(visit.state.is, 'waiting', why.code);
    assert.equal(visit.view.leave, 'Stop waiting');
    assert.equal(visit.view.problem, undefined);
    // Others may wait in the line, and no server is free for those who don't.
    visit.pass(14);
    assert.equal(visit.state.is, 'waiting');
    visit.did();
    const begin = visit.now;
    while (visit.state.is === 'waiting' && visit.now < begin + 31_000) {
      visit.pass(0.5);
    }
    assert.deepEqual([visit.state.is, visit.did()], ['asking', ['ask']]);
    visit.answer(`reason: ${JSON.stringify(FULL)}`, 'Error: none');
    visit.take({ type: 'available', now: true }).pass(1.6);
    assert.deepEqual([visit.state.is, visit.did()], ['asking', ['ask']]);
    assert.equal(visit.view.leave, 'Stop waiting', 'the notice stays until a server is chosen');
    assert.ok(visit.view.notice);
    visit.answer(SERVER);
    assert.equal(visit.view.notice, undefined);
  }
  const address = reason('too-many-requests', 'user', 'later');
  assert.equal(connecting().receive(...error('too many', address)).state.is, 'ended');
});

test('while all are busy although one is free, it asks again, less and less often', () => {
  const visit = asking();
  const pauses = [];
  for (let time = 0; time < 6; ++time) {
    visit.answer(`reason: ${JSON.stringify(FULL)}`, 'Error: no simulation server available at the moment.');
    assert.equal(visit.state.is, 'waiting');
    const begin = visit.now;
    while (visit.state.is === 'waiting') {
      visit.pass(0.5);
    }
    pauses.push((visit.now - begin) / 1000);
  }
  assert.deepEqual(pauses, [2, 4, 8, 16, 30, 30]);
  visit.take({ type: 'left' });
  assert.deepEqual(visit.did().slice(-1), ['clearStopped']);
  assert.equal(visit.pass(3600).state.is, 'idle');
});

test('a waiting page survives the loss of the session server', () => {
  const visit = connecting().receive(...error('full', FULL));
  visit.take({ type: 'disconnected' }).pass(60);
  assert.equal(visit.state.is, 'waiting');
  assert.deepEqual(visit.view.availability[0], 'No connection');
  visit.take({ type: 'connected' }, { type: 'available', now: true }).pass(1.6);
  assert.equal(visit.state.is, 'asking');
});

test('another server is asked for three times at most, after growing pauses', () => {
  const visit = connecting();
  const pauses = [];
  for (let attempt = 0; attempt < 3; ++attempt) {
    visit.receive(...error('this server is about to stop', DRAINING));
    assert.equal(visit.state.is, 'redirected');
    assert.equal(visit.view.progress?.notes.session, 'another one is asked for: This server is about to stop');
    const begin = visit.now;
    while (visit.state.is === 'redirected') {
      visit.pass(0.5);
    }
    pauses.push((visit.now - begin) / 1000);
    visit.answer(SERVER);
  }
  assert.deepEqual(pauses, [1, 2, 4]);
  visit.receive(...error('this server is about to stop', DRAINING));
  assert.equal(visit.state.is, 'ended');
  assert.deepEqual(visit.view.progress?.is, 'failed');
  // The next visit counts from the beginning.
  visit
    .take({ type: 'submitted', world: WORLD })
    .answer(SERVER)
    .receive(...error('this server is about to stop', DRAINING));
  assert.equal(visit.state.is, 'redirected');
});

test('a redirection survives the loss of the session server', () => {
  const visit = connecting().receive(...error('this server is about to stop', DRAINING));
  visit.take({ type: 'disconnected' }).pass(60);
  assert.equal(visit.state.is, 'redirected', 'it has no place in the line');
  visit.did();
  visit.take({ type: 'connected' }, { type: 'available', now: true }).pass(1);
  assert.deepEqual([visit.state.is, visit.did()], ['asking', ['ask']]);
  // Nobody who waited in no line is told that it is its turn.
  assert.deepEqual(visit.answer(SERVER).did(), ['connect']);
});

test('after a redirection a refusal that is not final is asked about again', () => {
  const redirected = () =>
    connecting()
      .receive(...error('this server is about to stop', DRAINING))
      .pass(1);
  assert.equal(redirected().answer(`reason: ${JSON.stringify(FULL)}`, 'Error: none').state.is, 'redirected');
  const lost = reason('lost', 'server', 'here');
  assert.equal(
    connecting().receive(...error('the server has lost it', lost)).state.is,
    'ended',
    'not all faults lead away',
  );
  const final = reason('repository-not-allowed', 'user', 'no');
  assert.equal(redirected().answer(`reason: ${JSON.stringify(final)}`, 'Error: none').state.is, 'ended');
});

test('a connection that breaks', () => {
  const closed = /** @type {const} */ ({ type: 'closed', code: 1006 });
  assert.equal(connecting().take(closed).state.is, 'redirected', 'nothing was granted');
  const broken = connecting().receive('loading: Step 1/9 : fetching').take(closed);
  assert.equal(broken.view.problem?.text, 'The connection to the simulation server broke before the simulation ran.');
  const python = connecting().receive('webots:ws://one:2001').take(SHOWN, closed);
  assert.equal(python.view.problem?.text, 'The connection to the simulation server broke: the simulation has ended.');
  assert.equal(running().take(closed).state.is, 'lost', 'its simulation waits');
});

test('a session server that is silent, away, or back', () => {
  /** @param {Visit} visit */
  const problem = (visit) => visit.view.problem?.text;
  const silent = asking().pass(10);
  assert.equal(problem(silent), 'The session server does not answer.');
  assert.deepEqual(silent.view.progress, { at: 'session', is: 'failed', notes: silent.view.progress?.notes });
  // The late answer is nobody's, not even that of the next request.
  silent.take(
    { type: 'submitted', world: WORLD },
    { type: 'answered', id: 1, answer: { failure: { sentence: 'late' } } },
  );
  assert.equal(silent.state.is, 'asking');
  silent.answer(SERVER);
  assert.equal(silent.state.is, 'connecting');
  const away = asking().take({ type: 'disconnected' });
  assert.equal(problem(away), 'The session server could not be reached.');
  away.take({ type: 'available', now: true });
  assert.equal(problem(away), undefined);
  const other = asking().answer('Error: the session server does not answer').take({ type: 'available', now: true });
  assert.equal(problem(other), 'The session server does not answer', 'a sentence decides nothing');
  const early = new Visit().take({ type: 'submitted', world: WORLD });
  assert.equal(problem(early), undefined, 'it is asked for when the session server is there');
  assert.deepEqual(early.did(), ['clear']);
  assert.deepEqual(early.take({ type: 'connected' }, { type: 'available', now: false }).did(), ['ask']);
  const never = new Visit().take({ type: 'submitted', world: WORLD }, { type: 'disconnected' });
  assert.equal(problem(never), 'The session server could not be reached.');
});

test('a lost connection is shown after two seconds, and found again', () => {
  /** @param {Visit} visit */
  const notice = (visit) => visit.view.notice;
  const visit = running();
  visit.did();
  visit.take({ type: 'closed', code: 1006 });
  assert.deepEqual(visit.did(), ['freeze'], 'a browser that leaves the page may close its connections first');
  assert.deepEqual(visit.pass(0.5).did(), ['connect']);
  assert.equal(notice(visit), undefined);
  visit.take({ type: 'closed', code: 1006 }).pass(3);
  assert.match(notice(visit)?.text ?? '', /^No connection for [34] seconds\.$/);
  assert.equal(notice(visit)?.advice, 'Your simulation waits up to another 57 seconds.');
  assert.equal(visit.view.progress?.is, 'done', 'its scene is still shown');
  assert.ok(visit.did().includes('sayLost'));
  visit.receive('session: 1');
  assert.equal(notice(visit), undefined);
  visit.receive('shutdownTimeout: 60', 'webots:ws://one:2001');
  assert.deepEqual(visit.effects.at(-2), {
    do: 'show',
    address: 'ws://one:2001',
    kind: undefined,
    server: SERVER,
    isBack: true,
  });
  assert.deepEqual(visit.effects.at(-1), { do: 'sayFound' });
  visit.receive('absence: 60', 'resume: other');
  assert.deepEqual(visit.effects.at(-1), { do: 'store', kept: { ...KEPT, token: 'other' } });
});

/** The texts with which a server lets a client come back from the first moment. */
const EARLY = ['session: 1', 'absence: 300', `resume: ${TOKEN}`];
const EARLY_KEPT = { server: SERVER, world: WORLD, token: TOKEN, absence: 300, hasRun: false };

test('a page that is loaded again while it waits or starts goes on', () => {
  const texts = { queued: ['queue: 2'], starting: ['loading: Step 2/9 : 10 %'], launching: ['shutdownTimeout: 60'] };
  for (const [name, now] of Object.entries(texts)) {
    const before = connecting().receive(...EARLY);
    assert.deepEqual(before.effects.at(-1), { do: 'store', kept: EARLY_KEPT }, name);
    before.receive(...now).did();
    assert.deepEqual(before.take({ type: 'hidden' }).did(), ['detach'], name);

    const after = new Visit().take({ type: 'restored', kept: EARLY_KEPT });
    assert.deepEqual(after.effects, [{ do: 'connect', server: SERVER, request: { resume: TOKEN } }]);
    assert.equal(after.view.progress?.at, 'server');
    after.receive('session: 1', 'absence: 300', 'resume: next', ...now);
    assert.deepEqual(after.effects.at(-1), { do: 'store', kept: { ...EARLY_KEPT, token: 'next' } }, name);
    assert.equal(after.state.is, name === 'queued' ? 'connecting' : 'starting');
    after.receive('webots:ws://one:2001', 'absence: 300', 'resume: next').take(SHOWN);
    assert.equal(after.state.is, 'running');
    assert.ok('isBack' in (after.effects.find((effect) => effect.do === 'show') ?? {}));
    assert.deepEqual(after.effects.at(-1), { do: 'store', kept: { ...EARLY_KEPT, token: 'next', hasRun: true } });
    assert.equal(after.effects.find((effect) => effect.do === 'show')?.isBack, false, 'nobody has seen it before');
  }
});

test('a start whose connection breaks is found again, and one that has failed goes elsewhere', () => {
  const broken = connecting().receive(...EARLY, 'loading: Step 2/9 : 10 %');
  broken.did();
  assert.deepEqual(broken.take({ type: 'closed', code: 1006 }).did(), ['freeze']);
  assert.deepEqual(broken.pass(0.5).did(), ['connect']);
  assert.equal(broken.state.is, 'lost');
  broken.receive('session: 1', 'absence: 300', 'resume: next', 'loading: Step 3/9 : 5 %');
  assert.equal(broken.state.is, 'starting');
  const failed = new Visit().take({ type: 'restored', kept: EARLY_KEPT });
  failed.take({ type: 'available', now: true }).receive(...error('this simulation has ended: no disk', DRAINING));
  assert.equal(failed.state.is, 'redirected');
  const gone = connecting()
    .receive(...EARLY)
    .take({ type: 'closed', code: 1006 });
  for (let attempt = 0; attempt < 4; ++attempt) {
    gone.take({ type: 'closed', code: 1006 }, { type: 'probed', answers: true }).pass(1);
  }
  assert.ok(['redirected', 'asking'].includes(gone.state.is), gone.state.is);
  const none = connecting().take({ type: 'closed', code: 1006 });
  assert.equal(none.state.is, 'redirected', 'a server without such tokens');
});

test('a server that refuses the site is not asked again, nor is another', () => {
  const visit = asking().answer(SERVER).take({ type: 'closed', code: 1006, isForbidden: true });
  assert.equal(visit.state.is, 'ended');
  assert.match(visit.view.problem?.text ?? '', /starts nothing for pages of this site/);
  assert.match(visit.view.problem?.advice ?? '', /allowedOrigins/);
});

test('a server that hangs is noticed by its silence, and one attempt is under way at a time', () => {
  const visit = running();
  visit.did();
  visit.pass(7);
  assert.equal(visit.state.is, 'running');
  visit.take({ type: 'heard' }).pass(7);
  assert.equal(visit.state.is, 'running', 'the stream is a sign of life');
  visit.pass(1);
  assert.deepEqual([visit.state.is, visit.did()], ['lost', ['freeze', 'connect']]);
  visit.pass(14);
  assert.deepEqual(visit.did(), ['sayLost']);
  visit.pass(2);
  assert.deepEqual(visit.did(), ['connect']);
  visit.take({ type: 'online' }).pass(1);
  assert.deepEqual(visit.did(), ['connect'], 'it has not asked yet');
  visit.take({ type: 'opened' }, { type: 'online' }).pass(1);
  assert.deepEqual(visit.did(), [], 'its answer may be on the way');
  visit.take({ type: 'closed', code: 1006 }, { type: 'online' }).pass(1);
  assert.deepEqual(visit.did(), ['probe', 'connect']);
});

test('a start whose server falls silent is found again, and one that is never accepted goes elsewhere', () => {
  const starts = { queued: ['queue: 3', 'loading: waiting'], fetching: ['loading: Step 2/9 : 10 %'], neither: [] };
  for (const [name, texts] of Object.entries(starts)) {
    const visit = connecting().receive(...EARLY, ...texts);
    for (let time = 0; time < 20; ++time) {
      visit.pass(4).receive('absence: 300');
    }
    const { is } = visit.state;
    visit.did();
    visit.pass(7);
    assert.equal(visit.state.is, is, name);
    visit.pass(2);
    assert.deepEqual([visit.state.is, visit.did()], ['lost', ['freeze', 'connect', 'sayLost']], name);
    assert.ok(visit.view.notice, 'the visitor is told');
    visit.receive('session: 1', 'absence: 300', 'resume: next', 'queue: 1');
    assert.deepEqual([visit.state.is, visit.view.progress?.notes.place], ['connecting', '1 client is ahead of you']);
    // It may fall silent again.
    visit.pass(9);
    assert.equal(visit.state.is, 'lost');
  }
  const opening = asking().answer(SERVER).pass(14);
  opening.did();
  assert.equal(opening.state.is, 'connecting');
  opening.pass(1);
  assert.deepEqual([opening.state.is, opening.did()], ['redirected', ['leave']]);
});

test('a start on a server without signs of life may be silent for as long as it takes', () => {
  assert.equal(connecting().pass(3600).state.is, 'connecting', 'one in Python clones before it says anything');
  assert.equal(connecting().receive('loading: Step 2/9 : 10 %').pass(3600).state.is, 'starting');
  assert.equal(connecting().receive('queue: 2').pass(3600).state.is, 'connecting');
});

test('a start in a page that was blocked is not taken for a silent one', () => {
  const visit = connecting().receive(...EARLY, 'loading: Step 2/9 : 10 %');
  visit.now += 20_000;
  visit.take({ type: 'tick' });
  assert.equal(visit.state.is, 'starting');
  visit.receive('absence: 300').pass(1);
  assert.equal(visit.state.is, 'starting');
});

test('a silent line is asked again for the same place', () => {
  const visit = asking().answer('ticket: t', 'queue: 3');
  visit.pass(30).answer('ticket: t2').pass(30).answer('ticket: t3');
  visit.did();
  visit.pass(44);
  assert.deepEqual(visit.did(), []);
  visit.pass(3);
  assert.deepEqual(visit.did(), ['reconnect']);
  visit.take({ type: 'disconnected' }).pass(2);
  assert.equal(visit.view.progress?.notes.session, '3 clients are ahead of you');
  visit.take({ type: 'connected' }, { type: 'available', now: false });
  assert.deepEqual(visit.effects.at(-1), { do: 'ask', id: 2, world: WORLD });
  // Also if it falls silent before the first ticket comes again.
  visit.answer('ticket: t4', 'queue: 3').did();
  assert.deepEqual(visit.pass(60).did(), ['reconnect']);

  const old = asking().answer('queue: 3');
  old.did();
  assert.deepEqual(old.pass(3600).did(), [], 'without tickets the place would be lost');

  const blocked = asking().answer('ticket: t', 'queue: 3');
  blocked.did();
  blocked.now += 90_000;
  blocked.take({ type: 'tick' }).answer('ticket: t2').pass(10);
  assert.deepEqual(blocked.did(), [], 'the ticket came while the page was blocked');
});

test('a page that was blocked does not take that for the silence of its server', () => {
  const visit = running().take({ type: 'scene', scene: { is: 'framed' } });
  for (let time = 0; time < 3; ++time) {
    // The tick comes late, and before the messages that have come meanwhile.
    visit.now += 20_000;
    visit.take({ type: 'tick' });
    assert.equal(visit.state.is, 'running');
    visit.receive('absence: 60', '.').pass(1);
  }
  visit.now += 20_000;
  visit.take({ type: 'tick' });
  assert.equal(visit.state.is, 'running');
  visit.pass(1);
  assert.equal(visit.state.is, 'lost', 'nothing came meanwhile');
});

test('a page whose ticks are rare notices a silent server while its simulation waits', () => {
  for (const period of [1, 2, 25, 60]) {
    const visit = running();
    const begin = visit.now;
    while (visit.state.is === 'running') {
      visit.now += 1000 * period;
      visit.take({ type: 'tick' });
    }
    assert.ok(visit.now - begin <= Math.max(10_000, 2000 * period), `${visit.now - begin} ms`);
    assert.deepEqual(visit.effects.at(-1), { do: 'connect', server: SERVER, request: { resume: TOKEN } });
  }
});

test('who is away for too long, or comes back to nothing, is told', () => {
  const offline = running().take({ type: 'closed', code: 1006 });
  for (let second = 0; second < 125; ++second) {
    offline.pass(1).take({ type: 'closed', code: 1006 });
  }
  assert.match(
    offline.view.problem?.text ?? '',
    /^There was no connection for 2 minutes, \d seconds?: the simulation has ended\.$/,
  );
  const late = running().take({ type: 'closed', code: 1006 }).pass(70);
  const { now } = late;
  late.receive(...error('this simulation has ended', reason('ended', 'user', 'here')));
  assert.equal(late.now, now);
  assert.match(late.view.problem?.text ?? '', /^There was no connection for 1 minute, 10 seconds/);
  const reloaded = new Visit().take({ type: 'restored', kept: KEPT });
  assert.deepEqual(reloaded.effects, [{ do: 'connect', server: SERVER, request: { resume: TOKEN } }]);
  reloaded.receive(...error('this simulation has ended', reason('ended', 'user', 'here')));
  assert.equal(reloaded.view.problem?.text, 'This simulation has ended');
  assert.ok(reloaded.did().includes('leave'));
});

test('a server that refuses all attempts while the session server answers is gone', () => {
  const visit = running().take({ type: 'closed', code: 1006 });
  for (let attempt = 0; attempt < 4; ++attempt) {
    visit.take({ type: 'closed', code: 1006 });
    assert.deepEqual(visit.did().slice(-1), ['probe']);
    visit.take({ type: 'probed', answers: true }).pass(1);
  }
  assert.equal(visit.view.problem?.text, 'The server was lost. Your simulation is over; start it again.');
  const offline = running().take({ type: 'closed', code: 1006 });
  for (let attempt = 0; attempt < 4; ++attempt) {
    offline.take({ type: 'closed', code: 1006 }).pass(1);
  }
  assert.equal(offline.state.is, 'lost', 'without an answer of the session server, the network may be down');
  const flapping = running().take({ type: 'closed', code: 1006 });
  for (const answers of [true, false, false, true, false, true]) {
    flapping.take({ type: 'closed', code: 1006 }, { type: 'probed', answers }).pass(2);
  }
  assert.equal(flapping.state.is, 'lost', 'it was not refused all the time');
});

test('a page that is hidden leaves what can be resumed', () => {
  const visit = running();
  visit.did();
  assert.deepEqual(visit.take({ type: 'hidden' }).did(), ['detach']);
  assert.equal(visit.state.is, 'idle');
  const early = connecting();
  early.did();
  assert.deepEqual(early.take({ type: 'hidden' }).did(), ['leave']);
  const lost = running().take({ type: 'closed', code: 1006 });
  lost.did();
  assert.deepEqual(lost.take({ type: 'hidden' }).did(), ['detach']);
});

test('a paused simulation is told, and kept by a button or because it runs', () => {
  const visit = running().receive('idle: 120');
  assert.equal(visit.view.idle, 'The simulation is paused, and ends in 2 minutes.');
  visit.did();
  visit.pass(3);
  assert.deepEqual([visit.did(), visit.view.idle], [[], 'The simulation is paused, and ends in 1 minute, 57 seconds.']);
  visit.take({ type: 'keep' });
  assert.deepEqual(visit.effects, [{ do: 'send', message: { keep: true } }]);
  visit.did();
  visit.take({ type: 'mode', runs: true }).pass(1);
  assert.deepEqual(visit.did(), ['send'], 'a controller has started it');
  visit.receive('idle: never').pass(1);
  assert.deepEqual([visit.did(), visit.view.idle], [[], undefined]);
});

test('a stream that closes: its server reports the end, or the page returns', () => {
  const closed = /** @type {const} */ ({ type: 'sceneClosed' });
  const ended = running().take(closed);
  assert.equal(ended.view.progress?.is, 'failed');
  assert.equal(ended.receive(...error('Webots ended', CRASHED)).state.is, 'ended');
  assert.equal(running().take(closed).pass(3).state.is, 'lost');
  const { problem } = connecting().receive('webots:ws://one:2001').take(closed).view;
  assert.equal(problem?.text, 'The simulator could not be reached at ws://one:2001.');
  assert.ok(problem?.advice.startsWith('A firewall'));
});

test('an administrator who watches is told to the visitor, also after a return', () => {
  const visit = running().receive('watched: 1');
  assert.equal(visit.view.isWatched, true);
  assert.equal(visit.receive('watched: 0').view.isWatched, false);
});

test('the visitor is told how slow a simulation is, until it is not slow any more', () => {
  const visit = running().receive('realTime: 0.6');
  assert.equal(visit.view.slow, 'This simulation runs at 0.6 of real time.');
  assert.equal(visit.receive('realTime: 1').view.slow, undefined);
});

test('each way out of a connected state closes the connection once', () => {
  /** @type {VisitEvent[]} */
  const ways = [
    { type: 'left' },
    { type: 'hidden' },
    { type: 'submitted', world: WORLD },
    { type: 'closed', failure: { sentence: 'over' } },
  ];
  const states = [
    connecting,
    () => connecting().receive('loading: x'),
    running,
    () => running().take({ type: 'closed' }),
  ];
  for (const way of ways) {
    for (const state of states) {
      const visit = state();
      const from = visit.state.is;
      visit.did();
      visit.take(way);
      assert.equal(
        visit.did().filter((name) => name === 'leave' || name === 'detach').length,
        1,
        `${from}, ${way.type}`,
      );
    }
  }
  const visit = running();
  visit.did();
  assert.deepEqual(visit.take({ type: 'sceneFailed', why: 'no-webgl' }).did(), ['leave']);
});

test('who leaves or starts another one while the connection is lost ends the simulation that waits, and nobody else does', () => {
  for (const [way, ends] of /** @type {[VisitEvent, boolean][]} */ ([
    [{ type: 'left' }, true],
    [{ type: 'submitted', world: WORLD }, true],
    [{ type: 'hidden' }, false],
  ])) {
    for (const [state, isLost] of /** @type {[() => Visit, boolean][]} */ ([
      [() => running().take({ type: 'closed' }), true],
      [running, false],
    ])) {
      const visit = state();
      const token = visit.state.is === 'lost' ? visit.state.resumption.token : undefined;
      assert.equal(token !== undefined, isLost);
      visit.did();
      visit.take(way);
      const ended = visit.effects.filter((effect) => effect.do === 'endAway');
      const expected = ends && isLost ? [{ do: 'endAway', server: SERVER, token }] : [];
      assert.deepEqual(ended, expected, way.type);
    }
  }
});
