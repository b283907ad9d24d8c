// The simulation server's page besides its live tables: charts, the time left, the output on demand, and for
// administrators a way to stop a simulation.

import { Charts } from './charts.js';
import { find } from './dom.js';
import { onSample } from './live.js';
import { duration } from './times.js';

const charts = new Charts(find('charts', HTMLElement));
const dialog = find('output', HTMLDialogElement);
const text = find('output-text', HTMLElement);

async function loadHistory() {
  const answer = await fetch('history');
  charts.begin(await answer.json());
}

/** If the page may have missed samples, it requests all of them again. */
onSample((sample, fresh) => {
  if (fresh) {
    loadHistory().catch(() => charts.add(sample));
  } else {
    charts.add(sample);
  }
});

setInterval(() => {
  for (const element of document.querySelectorAll('[data-ends]')) {
    const left = Number(element.getAttribute('data-ends')) - Date.now() / 1000;
    element.textContent = duration(left);
    element.classList.toggle('bad', left < 300);
  }
  for (const element of document.querySelectorAll('[data-away]')) {
    element.textContent = `away, ${duration(Number(element.getAttribute('data-away')) - Date.now() / 1000)} left`;
  }
}, 1000);

/** @param {HTMLAnchorElement} link */
async function showOutput(link) {
  find('output-title', HTMLElement).textContent = `Output of ${link.dataset.output}`;
  text.textContent = 'Loading …';
  dialog.showModal();
  try {
    const answer = await fetch(link.href, { headers: { 'X-Requested-With': 'page' } });
    text.textContent = (await answer.text()) || 'It has printed nothing yet.';
  } catch {
    text.textContent = 'The server does not answer.';
  }
  text.scrollTop = text.scrollHeight;
}

/* Only administrators have this dialog, and the buttons that open it. */

/** The elements of the dialog. */
const stopDialog = () => ({
  dialog: find('stop', HTMLDialogElement),
  problem: find('stop-problem', HTMLElement),
  reason: find('stop-reason', HTMLInputElement),
});
/** The id of the simulation to stop. @type {string | undefined} */
let chosen;

/** @param {HTMLElement} button */
function askToStop({ dataset: { stop, world, who } }) {
  const { dialog: stopping, problem, reason } = stopDialog();
  chosen = stop;
  find('stop-what', HTMLElement).textContent = who ? `${world} of ${who} (${stop})` : `${world} (${stop})`;
  problem.textContent = '';
  reason.value = '';
  stopping.showModal();
  reason.focus();
}

/** @param {Event} event */
async function stopNow(event) {
  event.preventDefault();
  const { dialog: stopping, problem, reason } = stopDialog();
  const order = {
    method: 'POST',
    headers: { 'Content-Type': 'application/json' },
    body: JSON.stringify({ reason: reason.value }),
  };
  const answer = await fetch(`simulations/${chosen}/stop`, order).catch(() => undefined);
  if (answer?.ok) {
    stopping.close();
  } else {
    problem.textContent = answer ? await answer.text() : 'The server does not answer.';
  }
}

document.getElementById('stop-form')?.addEventListener('submit', stopNow);
document.getElementById('stop-cancel')?.addEventListener('click', () => stopDialog().dialog.close());
document.addEventListener('click', (event) => {
  const button = event.target instanceof Element && event.target.closest('button[data-stop]');
  if (button instanceof HTMLElement) {
    askToStop(button);
  }
});

document.addEventListener('click', (event) => {
  const link = event.target instanceof Element && event.target.closest('a[data-output]');
  if (!(link instanceof HTMLAnchorElement) || event.ctrlKey || event.metaKey || event.shiftKey) {
    return;
  }
  event.preventDefault();
  showOutput(link);
});
find('output-close', HTMLButtonElement).addEventListener('click', () => dialog.close());
