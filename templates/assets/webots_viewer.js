// Loads Webots' own viewer, the component `webots-view`, and connects it to a simulator.
//
// The component comes with Webots. It loads some of its own files from another site, and adds an inline script to the
// page to locate its data. Both are redirected to where the component itself comes from: a simulation server that has
// Webots has all of these files, and this page runs no inline scripts.

import { find } from './dom.js';
import { wordsOfPage } from './language.js';

// The page around this one learns that it may be framed there.
parent.postMessage('webots-viewer', '*');

const HOME = /^https:\/\/cyberbotics\.com\/wwi\/[^/]+\//;
const wanted = new URLSearchParams(location.hash.slice(1));
const script = wanted.get('script') ?? '';
const words = await wordsOfPage(wanted.get('lang'));
document.title = words.stage.webotsViewer;
find('heading', HTMLElement).textContent = words.stage.webotsViewer;
const base = script.slice(0, script.lastIndexOf('/') + 1);

/** @param {string} text */
function problem(text) {
  find('problem', HTMLElement).textContent = text;
}

/**
 * Lets an element load from where the component comes from.
 * @param {Node} node
 */
function redirect(node) {
  if (node instanceof HTMLScriptElement && HOME.test(node.src)) {
    node.src = node.src.replace(HOME, base);
  } else if (node instanceof HTMLLinkElement && HOME.test(node.href)) {
    node.href = node.href.replace(HOME, base);
  }
}

/** This page can't store anything: the component gets a store that lasts as long as the page. */
function forgetful() {
  /** @type {Map<string, string>} */
  const kept = new Map();
  return {
    /** @param {unknown} key */
    getItem: (key) => kept.get(String(key)) ?? null,
    /**
     * @param {unknown} key
     * @param {unknown} value
     */
    setItem: (key, value) => kept.set(String(key), String(value)),
    /** @param {unknown} key */
    removeItem: (key) => kept.delete(String(key)),
    clear: () => kept.clear(),
  };
}

for (const name of ['localStorage', 'sessionStorage']) {
  Object.defineProperty(window, name, { value: forgetful() });
}

/** @type {(path: string, prefix: string) => string} */
const locateFile = (path, prefix) => (path.endsWith('.data') ? base : prefix) + path;
Object.assign(window, { Module: Object.assign([], { locateFile }) });

/** @type {(node: Node) => Node} */
const append = document.head.appendChild.bind(document.head);
Object.assign(document.head, {
  /** @param {Node} node */
  appendChild(node) {
    if (node instanceof HTMLScriptElement && !node.src) {
      return node;
    }
    redirect(node);
    return append(node);
  },
});

/** The component, of which only this is used.
 * @typedef {HTMLElement & { connect(url: string | null, mode: undefined, broadcast: boolean, mobile: boolean, timeout: number): void,
 *   sendMessage?(text: string): void, onready?(): void }} WebotsView
 */

try {
  // A page that is not embedded could be opened by a link that names any script.
  if (window === top || !script) {
    throw new Error(words.stage.onlyInside);
  }
  await import(script);
  const view = /** @type {WebotsView} */ (document.createElement('webots-view'));
  find('main', HTMLElement).append(view);
  // What the page around this one wants of the simulation, such as `pause`.
  addEventListener('message', ({ source, data }) => source === parent && view.sendMessage?.(String(data)));
  // The scene is there, for the first time or after a reset.
  view.onready = () => parent.postMessage('webots-viewer-ready', '*');
  // The kind of stream is left to the component: its name has changed over the versions of Webots.
  view.connect(wanted.get('stream'), undefined, wanted.has('watch'), matchMedia('(pointer: coarse)').matches, -1);
} catch (error) {
  problem(words.stage.noWebotsViewer(error instanceof Error ? error.message : error));
}
