// The session server's page besides its live tables: announcements, which need the password.

import { find } from './dom.js';
import './live.js';

/** Only with a password the page has this form. */
const form = document.getElementById('announce');

/** @param {{ text?: string }} order without a text, the announcement ends */
async function announce(order) {
  const request = { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(order) };
  const problem = find('announce-problem', HTMLElement);
  const answer = await fetch('announcement', request).catch(() => undefined);
  if (answer?.ok) {
    problem.textContent = '';
  } else if (answer?.status === 401) {
    location.assign('sign-in?to=monitor');
  } else {
    problem.textContent = answer ? await answer.text() : 'The server does not answer.';
  }
}

form?.addEventListener('submit', (event) => {
  event.preventDefault();
  announce({ text: find('announce-text', HTMLInputElement).value });
});
document.getElementById('announce-end')?.addEventListener('click', () => announce({}));
