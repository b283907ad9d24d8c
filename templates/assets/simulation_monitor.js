// What the simulation server's page has beside its live tables: charts, the time left, the output on demand.

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

/** The page may have missed samples: it asks for all of them again. */
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

document.addEventListener('click', (event) => {
  const link = event.target.closest('a[data-output]');
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey)
    return;
  event.preventDefault();
  showOutput(link);
});
document.getElementById('output-close').addEventListener('click', () => dialog.close());
