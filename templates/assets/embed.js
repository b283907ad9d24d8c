// The element `<webots-simulation>`, which runs a world of this server's fleet in any page. `embed.d.ts` describes it.

import { Store } from './kept.js';
import { firstOf, LANGUAGES } from './language.js';
import { problemText } from './page_view.js';
import { Panel } from './panel.js';
import { styles } from './styles.js';
import { isConnected, lineOf, reasonOf } from './visit.js';
import { VisitRunner } from './visit_runner.js';

/** @typedef {import('./visit.js').Event} VisitEvent */
/** @typedef {import('./visit.js').State} State */

/** @typedef {import('../embed.js').SimulationState} PublicState */
/** @typedef {import('../embed.js').StateDetail} StateDetail */
/** What a page is told. @typedef {import('../embed.js').SimulationEvents} SimulationEvents */

/** Pause before the words are loaded again, in milliseconds. */
const RELOAD = 5000;
/** The URL of the session server, which sends this module as its `embed.js`, with all that it imports. */
const BASE = new URL('.', import.meta.url).href;
const NAME = 'webots-simulation';
/** The looks of all elements. */
const SHEET = new CSSStyleSheet();
/** The names of the stores of the elements that are in this page. @type {Set<string>} */
const storeNames = new Set();

export class WebotsSimulation extends HTMLElement {
  static observedAttributes = ['name'];

  /** @type {Panel | undefined} */
  #panel;
  /** @type {VisitRunner | undefined} */
  #runner;
  /** The name of its store. */
  #storeName = '';
  /** What is called before the element is ready. @type {{ call: () => void, isStart: boolean }[]} */
  #calls = [];
  #isOpening = false;
  /** Opens the element again after a failure. @type {ReturnType<typeof setTimeout> | undefined} */
  #reopening;
  /** @type {StateDetail} */
  #told = { state: 'idle', world: undefined, ahead: undefined };
  /** The world that was started last. */
  #wanted = '';
  /** Whether the time is to run once the scene is shown. */
  #plays = false;
  /** Whether the scene was shown since the start. */
  #isReady = false;
  /** @type {AbortController | undefined} */
  #listening;

  /* what a page uses */

  /** Where the visit is. */
  get state() {
    return this.#told.state;
  }

  /** The world: the URL of its page on its forge. */
  get world() {
    return this.getAttribute('world')?.trim() ?? '';
  }

  set world(world) {
    this.setAttribute('world', world);
  }

  /**
   * Starts a world; a simulation that runs ends.
   * @param {string} [world] instead of that of the attribute
   */
  start(world = this.world || this.#wanted) {
    this.#wanted = world;
    this.#isReady = false;
    const begin = () => {
      this.#plays = this.hasAttribute('autoplay');
      this.#runner?.take({ type: 'submitted', world });
    };
    this.#call(begin, true);
  }

  /** Ends the simulation, or waits no longer. */
  stop() {
    this.#call(() => this.#runner?.take({ type: 'left' }));
  }

  /** Lets the time of the simulation run; of one that is not ready, once it is. */
  play() {
    this.#call(() => {
      this.#plays = this.state !== 'running';
      this.#panel?.stage.play();
    });
  }

  /** Lets the time of the simulation stand. */
  pause() {
    this.#call(() => {
      this.#plays = false;
      this.#panel?.stage.pause();
    });
  }

  /** Sets the simulation back to its beginning. */
  reset() {
    this.#call(() => this.#panel?.stage.reset());
  }

  /* the life of the element */

  connectedCallback() {
    this.#open();
  }

  disconnectedCallback() {
    // Who moves the element in the page removes it for a moment.
    queueMicrotask(() => {
      if (!this.isConnected) {
        this.#close();
      }
    });
  }

  attributeChangedCallback() {
    this.#panel?.nameVisitor(this.#name);
  }

  get #name() {
    return this.getAttribute('name')?.trim() || undefined;
  }

  /**
   * @param {() => void} call
   * @param {boolean} [isStart]
   */
  #call(call, isStart = false) {
    if (this.#runner) {
      call();
    } else {
      this.#calls.push({ call, isStart });
      this.#open();
    }
  }

  async #open() {
    if (this.#runner || this.#isOpening || !this.isConnected) {
      return;
    }
    this.#isOpening = true;
    this.#storeName = this.#nameStore();
    const root = this.shadowRoot ?? this.attachShadow({ mode: 'open' });
    root.adoptedStyleSheets = [SHEET];
    root.replaceChildren();
    const load = LANGUAGES[firstOf([this.getAttribute('lang') ?? '', ...navigator.languages])];
    const words = await load().then(
      (language) => language.words,
      () => undefined,
    );
    this.#isOpening = false;
    // It may be gone again.
    if (!this.isConnected || !words) {
      storeNames.delete(this.#storeName);
      if (!words) {
        this.#openLater();
      }
      return;
    }
    const take = (/** @type {VisitEvent} */ event) => this.#runner?.take(event);
    const panel = new Panel(words, BASE, {
      begin: () => this.start(),
      take,
      time: (milliseconds) => this.#dispatch('time', { time: milliseconds / 1000 }),
    });
    panel.nameVisitor(this.#name);
    root.append(panel.element);
    this.#panel = panel;
    this.#runner = new VisitRunner(
      BASE,
      new Store(this.#storeName),
      panel,
      () => this.#choices(),
      this.#changed.bind(this),
    );
    this.#listen();
    this.#begin();
  }

  /** The session server has not sent the words: what was started has failed, and the element tries again. */
  #openLater() {
    clearTimeout(this.#reopening);
    this.#reopening = setTimeout(() => this.#open(), RELOAD);
    const starts = this.#calls.filter(({ isStart }) => isStart);
    this.#calls = [];
    for (const _ of starts) {
      this.#end({ code: 'session-unreachable' });
    }
  }

  /** A name that no other element of the page has: elements with the same id, or without one, are numbered. */
  #nameStore() {
    const name = `${NAME} ${location.pathname} ${this.id}`;
    let free = name;
    for (let number = 2; storeNames.has(free); number += 1) {
      free = `${name} ${number}`;
    }
    storeNames.add(free);
    return free;
  }

  #choices() {
    return {
      named: this.world,
      name: this.#name,
      viewer: this.getAttribute('viewer') ?? 'automatic',
      script: this.getAttribute('viewer-script') ?? undefined,
    };
  }

  #listen() {
    this.#listening = new AbortController();
    const { signal } = this.#listening;
    addEventListener('online', () => this.#runner?.take({ type: 'online' }), { signal });
    // The page is left, perhaps only for a moment: a simulation that can be resumed waits.
    addEventListener('pagehide', () => this.#runner?.take({ type: 'hidden' }), { signal });
    // The browser shows the page from its back/forward cache.
    addEventListener('pageshow', ({ persisted }) => persisted && this.#runner?.restore(), { signal });
  }

  /** Goes on with what this tab has kept, or starts by itself. */
  #begin() {
    const calls = this.#calls.splice(0);
    const wish = this.#runner?.restore();
    if (wish) {
      // Nobody has seen it run yet.
      this.#plays = this.hasAttribute('autoplay') && !wish.simulation?.hasRun;
    } else if (this.hasAttribute('autostart') && !calls.some(({ isStart }) => isStart)) {
      this.start();
    }
    for (const { call } of calls) {
      call();
    }
  }

  #close() {
    this.#listening?.abort();
    if (this.#runner) {
      this.#runner.close();
      storeNames.delete(this.#storeName);
    }
    this.#runner = undefined;
    this.#panel = undefined;
    this.#calls = [];
  }

  /* events */

  /**
   * @template {keyof SimulationEvents} Type
   * @param {Type} type
   * @param {SimulationEvents[Type]['detail']} detail
   */
  #dispatch(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  /**
   * @param {State} before
   * @param {State} state
   * @param {VisitEvent} event
   */
  #changed(before, state, event) {
    const wasGoing = before.is !== 'idle' && before.is !== 'ended';
    if (wasGoing && event.type === 'submitted') {
      this.#endLeft(before);
    }
    const last = this.#told;
    const told = { state: this.#publicState(state), world: worldOf(state), ahead: ahead(state) };
    this.#told = told;
    this.#wanted = told.world ?? this.#wanted;
    // A start may fail at once, from one end to the next.
    const hasEnded = state.is === 'ended' && state !== before;
    if (hasEnded || told.state !== last.state || told.ahead !== last.ahead || told.world !== last.world) {
      this.#dispatch('state', told);
    }
    if (lineOf(before) && state.is === 'connecting') {
      this.#dispatch('turn', {});
    }
    if (isShown(state) && !this.#isReady) {
      this.#ready();
    }
    if (hasEnded) {
      this.#end(state.problem);
    } else if (wasGoing && event.type === 'left') {
      this.#endLeft(before);
    }
  }

  /**
   * @param {State} state
   * @returns {PublicState}
   */
  #publicState(state) {
    switch (state.is) {
      case 'idle':
      case 'lost':
      case 'ended':
      case 'waiting':
        return state.is;
      case 'asking':
        return lineOf(state) || state.waitsFor ? 'waiting' : 'starting';
      case 'connecting':
        return state.place.is === 'queued' ? 'waiting' : 'starting';
      case 'running':
        return isShown(state) || this.#isReady ? 'running' : 'starting';
      default:
        return 'starting';
    }
  }

  #ready() {
    this.#isReady = true;
    this.#panel?.say(this.#panel.words.ready);
    this.#dispatch('ready', {});
    if (this.#plays) {
      this.play();
    }
  }

  /**
   * The visitor has left this state, or has started something else.
   * @param {State} before
   */
  #endLeft(before) {
    const words = this.#panel?.words.stage;
    this.#isReady = false;
    const message = isConnected(before) ? words?.clearLeft : words?.clearStopped;
    this.#dispatch('ended', { code: 'left', message: message ?? '' });
  }

  /** @param {import('./visit.js').Problem} problem */
  #end(problem) {
    this.#isReady = false;
    const words = this.#panel?.words;
    const reason = reasonOf(problem);
    const code = 'code' in problem ? problem.code : (reason?.code ?? 'unknown');
    const message = words ? problemText(problem, words) : code;
    if (code === 'origin-refused' || ('why' in problem && problem.why === 'no-frame')) {
      // biome-ignore lint/suspicious/noConsole: who writes the page looks there first.
      console.error(`${NAME}: ${message} (${location.origin})`);
    }
    this.#dispatch('ended', { ...reason, code, message });
  }
}

/** @param {State} state */
function isShown(state) {
  return state.is === 'running' && (state.scene.is === 'shown' || state.scene.is === 'framed');
}

/** @param {State} state */
function ahead(state) {
  if (state.is === 'asking') {
    return lineOf(state)?.ahead;
  }
  return state.is === 'connecting' && state.place.is === 'queued' ? state.place.ahead : undefined;
}

/** @param {State} state */
function worldOf(state) {
  const going = state.is === 'ended' ? state.from : state;
  return going.is === 'idle' ? undefined : going.goal.world;
}

SHEET.replaceSync(styles);
customElements.get(NAME) ?? customElements.define(NAME, WebotsSimulation);
