// The place of the scene on the viewer page: chooses between Webots' own viewer and the small one, and shows it.

import { SceneError } from './scene.js';
import { SmallViewer } from './small_viewer.js';
import { isDemonstration } from './stream.js';

/** Least time between two signs of life that are passed on, in milliseconds. */
const HEARD = 500;

/** @typedef {import('./visit.js').Event} VisitEvent */
/** @typedef {Extract<import('./visit.js').Effect, { do: 'show' }>} Show */

export class Stage {
  #element;
  #words;
  #tell;
  /** @type {SmallViewer | { close(): void, freeze?: undefined } | undefined} */
  #viewer;
  /** Number of simulations that were shown: later ones replace what earlier ones have not finished. */
  #shows = 0;
  #heardAt = 0;

  /**
   * @param {HTMLElement} element
   * @param {import('./language.js').Words} words
   * @param {(event: VisitEvent) => void} tell
   */
  constructor(element, words, tell) {
    this.#element = element;
    this.#words = words;
    this.#tell = tell;
  }

  /**
   * Shows a simulation.
   * @param {Show} simulation
   * @param {{ choice: string, script: string | undefined, say: (text: string) => void }} options which viewer was chosen,
   *   and the configured URL of Webots' own
   */
  async show({ address, kind, server, isBack }, { choice, script, say }) {
    this.#shows += 1;
    const show = this.#shows;
    const webots = choice === 'small' ? undefined : ((await ownViewer(server)) ?? script);
    const isSmall = !webots || (choice === 'automatic' && (await isDemonstration(address, kind)));
    if (show !== this.#shows) {
      return;
    }
    this.#viewer?.close();
    if (isSmall) {
      this.#showSmall(address, kind, isBack);
    } else {
      this.#showWebots(address, webots);
    }
    if (isSmall && choice === 'webots') {
      say(this.#words.stage.onlySmall);
    }
  }

  /**
   * @param {string} address
   * @param {string | undefined} kind
   * @param {boolean} isBack
   */
  #showSmall(address, kind, isBack) {
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
              tell({ type: 'scene', scene: { is: 'shown', title: event.title, runs: false } });
              // On a phone the scene would be out of sight, below the steps.
              return this.#element.scrollIntoView({ block: 'nearest' });
            case 'mode':
              return tell({ type: 'mode', runs: event.mode !== 'pause' });
            case 'heard':
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
    frame.src = `webots-viewer#${new URLSearchParams({ script, stream: address, lang: this.#words.language })}`;
    this.#element.replaceChildren(frame);
    this.#viewer = { close: () => frame.remove() };
    this.#tell({ type: 'scene', scene: { is: 'framed' } });
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
 * The URL of Webots' own viewer on a simulation server, if it has it.
 * @param {string} server
 * @returns {Promise<string | undefined>}
 */
async function ownViewer(server) {
  const base = server.startsWith('ws') ? `http${server.slice('ws'.length)}` : server;
  try {
    const { viewer } = await (await fetch(`${base}/status`)).json();
    return viewer ? `${base}/${viewer}` : undefined;
  } catch {
    // Another kind of server, without a viewer.
    return undefined;
  }
}
