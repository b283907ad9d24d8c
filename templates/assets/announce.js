// The form for announcements, which the page of the class has.

import { find } from './dom.js';

/** @param {{ text?: string }} order without a text, the announcement ends */
async function announce(order) {
  const request = { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(order) };
  const answer = await fetch('announcement', request).catch(() => undefined);
  find('announce-problem', HTMLElement).textContent = answer?.ok
    ? ''
    : ((await answer?.text()) ?? 'The server does not answer.');
}

find('announce', HTMLFormElement).addEventListener('submit', (event) => {
  event.preventDefault();
  announce({ text: find('announce-text', HTMLInputElement).value });
});
find('announce-end', HTMLButtonElement).addEventListener('click', () => announce({}));
