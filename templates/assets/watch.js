// The page on which an administrator watches a simulation: a read-only viewer.

import { SmallViewer } from './small_viewer.js';

const stage = document.getElementById('stage');

function tell(text) {
  document.getElementById('state').textContent = text;
}

function address() {
  const url = new URL(stage.dataset.stream, location.href);
  url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
  return url.href;
}

function showSmall() {
  const viewer = new SmallViewer(stage, address(), 'watches');
  viewer.addEventListener('loading', ({ detail }) => tell(detail));
  viewer.addEventListener('ready', () => tell('Watching'));
  viewer.addEventListener('lost', ({ detail }) => {
    viewer.stale();
    tell(detail ? `The scene can’t be shown: ${detail}.` : 'It is over: the simulation has ended, or its server can’t be reached.');
  });
}

function showWebots() {
  const frame = document.createElement('iframe');
  frame.title = 'Webots’ viewer';
  frame.allow = 'fullscreen';
  const script = new URL(stage.dataset.script, location.href).href;
  frame.src = `webots-viewer#${new URLSearchParams({ script, stream: address(), watch: '' })}`;
  stage.replaceChildren(frame);
  tell('Watching');
}

if (stage.dataset.script)
  showWebots();
else
  showSmall();
