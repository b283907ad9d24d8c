// The simulation server's page besides its live tables: charts, the time left, the output on demand, and for
// administrators a way to stop a simulation.

import { Charts } from './charts.js';
import { onSample } from './live.js';
import { duration } from './times.js';

const charts = new Charts(document.getElementById('charts'));
const dialog = document.getElementById('output');
const text = document.getElementById('output-text');

async function loadHistory() {
  const answer = await fetch('history');
  charts.begin(await answer.json());
}

/** If the page may have missed samples, it requests all of them again. */
onSample((sample, fresh) => {
  if (fresh)
    loadHistory().catch(() => charts.add(sample));
  else
    charts.add(sample);
});

setInterval(() => {
  for (const element of document.querySelectorAll('[data-ends]')) {
    const left = Number(element.dataset.ends) - Date.now() / 1000;
    element.textContent = duration(left);
    element.classList.toggle('bad', left < 300);
  }
  for (const element of document.querySelectorAll('[data-away]'))
    element.textContent = `away, ${duration(Number(element.dataset.away) - Date.now() / 1000)} left`;
}, 1000);

async function showOutput(link) {
  document.getElementById('output-title').textContent = `Output of ${link.dataset.output}`;
  text.textContent = 'Loading …';
  dialog.showModal();
  try {
    const answer = await fetch(link.href);
    text.textContent = await answer.text() || 'It has printed nothing yet.';
  } catch {
    text.textContent = 'The server does not answer.';
  }
  text.scrollTop = text.scrollHeight;
}

/* Only administrators have this dialog. */
const stopping = document.getElementById('stop');
const problem = document.getElementById('stop-problem');
const reason = document.getElementById('stop-reason');
let chosen;

function askToStop({ dataset: { stop, world, who } }) {
  chosen = stop;
  document.getElementById('stop-what').textContent = who ? `${world} of ${who} (${stop})` : `${world} (${stop})`;
  problem.textContent = reason.value = '';
  stopping.showModal();
  reason.focus();
}

async function stopNow(event) {
  event.preventDefault();
  const order = { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ reason: reason.value }) };
  const answer = await fetch(`simulations/${chosen}/stop`, order).catch(() => undefined);
  if (answer?.ok)
    stopping.close();
  else
    problem.textContent = answer ? await answer.text() : 'The server does not answer.';
}

document.getElementById('stop-form')?.addEventListener('submit', stopNow);
document.getElementById('stop-cancel')?.addEventListener('click', () => stopping.close());
document.addEventListener('click', (event) => {
  const button = event.target.closest('button[data-stop]');
  if (button)
    askToStop(button);
});

document.addEventListener('click', (event) => {
  const link = event.target.closest('a[data-output]');
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey)
    return;
  event.preventDefault();
  showOutput(link);
});
document.getElementById('output-close').addEventListener('click', () => dialog.close());
