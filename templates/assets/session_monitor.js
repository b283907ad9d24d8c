// The session server's page besides its live tables: announcements, which need the password.

import './live.js';

const form = document.getElementById('announce');
const text = document.getElementById('announce-text');
const problem = document.getElementById('announce-problem');

async function announce(order) {
  const request = { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(order) };
  // The browser asks for the password.
  const answer = await fetch('announcement', request).catch(() => undefined);
  if (answer?.ok)
    problem.textContent = '';
  else
    problem.textContent = answer ? await answer.text() : 'The server does not answer.';
}

form?.addEventListener('submit', (event) => {
  event.preventDefault();
  announce({ text: text.value });
});
document.getElementById('announce-end')?.addEventListener('click', () => announce({}));
