// The place of the scene: chooses between Webots' own viewer and the small one, and shows it.

/** The small viewer is loaded once there is something to show: the first picture of the page comes sooner. */
const small = () => import('./small_viewer.js');

/** Time in which the page of Webots' own viewer reports after its frame has loaded, in milliseconds. */
const FRAME_REPORT = 2000;
/** What that page reports: that it may be framed, and that its viewer shows the scene and takes orders. */
const HERE = 'webots-viewer';
const READY = 'webots-viewer-ready';
/** Least time between two signs of life that are passed on, in milliseconds. */
const HEARD = 500;
/** The program whose scenes are for the small viewer. */
const DEMO = 'demo-simulator';
/** How long a simulation server may take to say whether Webots' viewer fits, in milliseconds. */
const STATUS_LIMIT = 3000;

/** @typedef {import('./visit.js').Event} VisitEvent */
/** @typedef {Extract<import('./visit.js').Effect, { do: 'show' }>} Show */

/** `base`: the URL of the session server; `time`: told the time of the simulation, in milliseconds.
 * @typedef {{ words: import('./language.js').Words, base: string, tell: (event: VisitEvent) => void,
 *   time: (milliseconds: number) => void }} StageOptions
 */

/** A viewer that shows a simulation. Webots' own freezes by itself.
 * @typedef {{ play(): void, pause(): void, reset(): void, close(): void, freeze?(): void }} Viewer
 */

export class Stage {
  #element;
  #words;
  #base;
  #tell;
  #time;
  /** @type {Viewer | undefined} */
  #viewer;
  /** Number of simulations that were shown: later ones replace what earlier ones have not finished. */
  #shows = 0;
  #heardAt = 0;

  /**
   * @param {HTMLElement} element
   * @param {StageOptions} options
   */
  constructor(element, { words, base, tell, time }) {
    this.#element = element;
    this.#words = words;
    this.#base = base;
    this.#tell = tell;
    this.#time = time;
  }

  /**
   * Shows a simulation.
   * @param {Show} simulation
   * @param {{ viewer: string, script: string | undefined, say: (text: string) => void }} options which viewer was chosen,
   *   and the configured URL of Webots' own
   */
  async show({ address, kind, server, isBack }, { viewer, script, say }) {
    this.#shows += 1;
    const show = this.#shows;
    const webots = viewer === 'small' ? undefined : await webotsViewer(server, script, viewer === 'webots');
    const viewers = webots ? undefined : await small();
    if (show !== this.#shows) {
      return;
    }
    this.#viewer?.close();
    if (viewers) {
      this.#showSmall(viewers, address, kind, isBack);
    } else if (webots) {
      this.#showWebots(address, webots);
    }
    if (viewers && viewer === 'webots') {
      say(this.#words.stage.onlySmall);
    }
  }

  /**
   * @param {typeof import('./small_viewer.js')} viewers
   * @param {string} address
   * @param {string | undefined} kind
   * @param {boolean} isBack
   */
  #showSmall({ SmallViewer, SceneError }, address, kind, isBack) {
    const show = this.#shows;
    /** @param {VisitEvent} event */
    const tell = (event) => {
      if (show === this.#shows) {
        this.#tell(event);
      }
    };
    try {
      this.#viewer = new SmallViewer(
        this.#element,
        address,
        { words: this.#words, kind, isOnlooker: isBack },
        (event) => {
          switch (event.is) {
            case 'loading':
              return tell({ type: 'scene', scene: event });
            case 'shown':
              return tell({ type: 'scene', scene: { is: 'shown', title: event.title, runs: false } });
            case 'mode':
              return tell({ type: 'mode', runs: event.mode !== 'pause' });
            case 'heard':
              this.#time(event.time);
              return this.#hear(tell);
            case 'failed':
              return tell({ type: 'sceneFailed', why: event.why });
            case 'closed':
              return tell({ type: 'sceneClosed' });
          }
        },
      );
    } catch (error) {
      if (!(error instanceof SceneError)) {
        throw error;
      }
      tell({ type: 'sceneFailed', why: error.code });
    }
  }

  /** @param {(event: VisitEvent) => void} tell */
  #hear(tell) {
    if (Date.now() - this.#heardAt < HEARD) {
      return;
    }
    this.#heardAt = Date.now();
    tell({ type: 'heard' });
  }

  /**
   * @param {string} address
   * @param {string} script
   */
  #showWebots(address, script) {
    const frame = document.createElement('iframe');
    frame.title = this.#words.stage.webotsViewer;
    frame.allow = 'fullscreen';
    const wanted = new URLSearchParams({ script, stream: address, lang: this.#words.language });
    frame.src = new URL(`webots-viewer#${wanted}`, this.#base).href;
    const listening = new AbortController();
    let isHere = false;
    const hear = (/** @type {MessageEvent} */ { source, data }) => {
      if (source !== frame.contentWindow) {
        return;
      }
      if (data === HERE) {
        isHere = true;
      } else if (data === READY) {
        this.#tell({ type: 'scene', scene: { is: 'framed' } });
      }
    };
    addEventListener('message', hear, { signal: listening.signal });
    const show = this.#shows;
    // A page that may not be framed here loads as well, but is not that page.
    const check = () => {
      if (!isHere && show === this.#shows) {
        this.#tell({ type: 'sceneFailed', why: 'no-frame' });
      }
    };
    frame.addEventListener('load', () => setTimeout(check, FRAME_REPORT), { once: true });
    this.#element.replaceChildren(frame);
    /** The frame has no origin. @type {(text: string) => void} */
    const send = (text) => frame.contentWindow?.postMessage(text, '*');
    this.#viewer = {
      play: () => send('real-time:-1'),
      pause: () => send('pause'),
      reset: () => send('reset'),
      close: () => {
        listening.abort();
        frame.remove();
      },
    };
  }

  play() {
    this.#viewer?.play();
  }

  pause() {
    this.#viewer?.pause();
  }

  reset() {
    this.#viewer?.reset();
  }

  /** Keeps what is shown, and closes its stream: its messages are no sign of life of the simulation's server. */
  freeze() {
    this.#shows += 1;
    this.#viewer?.freeze?.();
  }

  /** Closes the viewer; the small one keeps its last picture. */
  close() {
    this.#shows += 1;
    this.#viewer?.close();
    this.#viewer = undefined;
  }

  /**
   * Shows a text instead of a scene.
   * @param {string} text
   */
  clear(text) {
    this.#element.replaceChildren(
      Object.assign(document.createElement('p'), { className: 'none empty', textContent: text }),
    );
  }
}

/**
 * The URL of Webots' own viewer, if it fits: that of the simulation server, or else the configured one. It does not fit
 * the demo simulator, unless somebody has chosen it.
 * @param {string} server
 * @param {string | undefined} script
 * @param {boolean} isChosen
 * @returns {Promise<string | undefined>}
 */
async function webotsViewer(server, script, isChosen) {
  const base = server.startsWith('ws') ? `http${server.slice('ws'.length)}` : server;
  try {
    const { viewer, simulator } = await (
      await fetch(`${base}/status`, { signal: AbortSignal.timeout(STATUS_LIMIT) })
    ).json();
    if (simulator === DEMO && !isChosen) {
      return undefined;
    }
    return viewer ? `${base}/${viewer}` : script;
  } catch {
    // Another kind of server, without a viewer.
    return script;
  }
}
