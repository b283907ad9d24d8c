// The page on which an administrator watches a simulation: a read-only viewer.

import { find } from './dom.js';
import { wordsOfPage } from './language.js';
import { SceneError } from './scene.js';
import { SmallViewer } from './small_viewer.js';

const search = new URLSearchParams(location.search);
const words = await wordsOfPage(search.get('lang'));
const stage = find('stage', HTMLElement);

/** @param {string} text */
function tell(text) {
  find('state', HTMLElement).textContent = text;
}

function address() {
  const url = new URL(stage.dataset.stream ?? '', location.href);
  url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
  return url.href;
}

/** @param {import('./small_viewer.js').ViewerEvent} event */
function take(event) {
  switch (event.is) {
    case 'loading':
      return tell(words.steps.loading(event.status, event.percent));
    case 'shown':
      return tell(words.watching.on);
    case 'failed':
      viewer?.markStale();
      return tell(words.scene[event.why]);
    case 'closed':
      viewer?.markStale();
      return tell(words.watching.over);
  }
}

function openSmall() {
  const options = { words, kind: stage.dataset.kind || undefined, isOnlooker: true, isReadOnly: true };
  try {
    return new SmallViewer(stage, address(), options, take);
  } catch (error) {
    if (!(error instanceof SceneError)) {
      throw error;
    }
    tell(words.scene[error.code]);
    return undefined;
  }
}

/** @param {string} path of Webots' own viewer */
function showWebots(path) {
  const frame = document.createElement('iframe');
  frame.title = words.stage.webotsViewer;
  frame.allow = 'fullscreen';
  const script = new URL(path, location.href).href;
  frame.src = `webots-viewer#${new URLSearchParams({ script, stream: address(), watch: '', lang: words.language })}`;
  stage.replaceChildren(frame);
  tell(words.watching.on);
}

const { script } = stage.dataset;
if (script) {
  showWebots(script);
}
const viewer = script ? undefined : openSmall();
