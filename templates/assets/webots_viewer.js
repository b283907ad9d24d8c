// Loads Webots' own viewer, the component `webots-view`, and connects it to a simulator.
//
// The component comes with Webots. It loads some of its own files from another site, and adds an inline script to the
// page to locate its data. Both are redirected to where the component itself comes from: a simulation server that has
// Webots has all of these files, and this page runs no inline scripts.

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

/** This page can't store anything: the component gets a store that lasts as long as the page. */
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
  // A page that is not embedded could be opened by a link that names any script.
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
