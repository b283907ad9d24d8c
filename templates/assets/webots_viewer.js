// Loads Webots' own viewer, the component `webots-view`, and connects it to a simulator.
//
// That component comes with Webots and names some of its own files by the address of another site, and it makes a
// script in the page to say where its data is. Both are turned here to where the component itself comes from: a
// simulation server that has Webots has all of these files, and this page runs nothing that stands in a page.

const HOME = /^https:\/\/cyberbotics\.com\/wwi\/[^/]+\//;
const wanted = new URLSearchParams(location.hash.slice(1));
const script = wanted.get('script') ?? '';
const base = script.slice(0, script.lastIndexOf('/') + 1);

function problem(text) {
  document.getElementById('problem').textContent = text;
}

function redirected(node) {
  for (const key of ['src', 'href']) {
    if (typeof node[key] === 'string' && HOME.test(node[key]))
      node[key] = node[key].replace(HOME, base);
  }
  return node;
}

/** This page keeps nothing: a component that wants to keep something may think that it does. */
function forgetful() {
  const kept = new Map();
  return {
    getItem: (key) => kept.get(String(key)) ?? null,
    setItem: (key, value) => kept.set(String(key), String(value)),
    removeItem: (key) => kept.delete(String(key)),
    clear: () => kept.clear(),
  };
}

for (const name of ['localStorage', 'sessionStorage'])
  Object.defineProperty(window, name, { value: forgetful() });

window.Module = [];
window.Module.locateFile = (path, prefix) => (path.endsWith('.data') ? base : prefix) + path;

const append = document.head.appendChild.bind(document.head);
document.head.appendChild = (node) => {
  const isText = node.tagName === 'SCRIPT' && !node.src;
  return isText ? node : append(redirected(node));
};

try {
  // Anybody could send a link with a script to a page that is not embedded.
  if (window === top || !script)
    throw new Error('no viewer is named');
  await import(script);
  const view = document.createElement('webots-view');
  document.getElementById('main').append(view);
  // The kind of stream is left to the component: its name has changed over the versions of Webots.
  view.connect(wanted.get('stream'), undefined, wanted.has('watch'), matchMedia('(pointer: coarse)').matches, -1);
} catch (error) {
  problem(`Webots’ viewer can’t be loaded: ${error.message}. Choose the small viewer and connect again.`);
}
