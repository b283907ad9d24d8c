// The server's events on a page that is kept up to date: receives them while the page is visible, and shows whether it is
// connected.

import { find, setText } from './dom.js';
import { timeOfDay } from './times.js';

/** The server sends something every 15 seconds. In milliseconds. */
const SILENCE = 40_000;
/** Interval between two checks for that, in milliseconds. */
const CHECK = 5000;
/** Pause before a new connection after a refusal, in milliseconds. */
const RECONNECT = 3000;

/**
 * Calls `take` with the content of each event. A page of another version of the server is loaded again.
 * @template Update
 * @param {string} url
 * @param {(update: Update) => void} take
 * @param {{ opened?: () => void, closed?: () => void }} [also] called when there is a new connection, before which events
 *   may have been missed; and when the server has refused one
 */
export function follow(url, take, { opened, closed } = {}) {
  const lamp = find('live', HTMLElement);
  /** @type {EventSource | undefined} */
  let source;
  let heard = Date.now();

  /**
   * @param {string} text
   * @param {boolean} lost
   */
  const say = (text, lost) => {
    setText(lamp, text);
    lamp.classList.toggle('lost', lost);
  };
  const lose = () => {
    if (!lamp.classList.contains('lost')) {
      say(`No connection since ${timeOfDay(heard / 1000)}: what you see is old. Trying again …`, true);
    }
  };
  const rest = () => {
    source?.close();
    source = undefined;
  };
  /** A hidden tab does not listen: browsers allow few connections to one server. */
  const listen = () => {
    if (document.hidden || source) {
      return;
    }
    heard = Date.now();
    source = new EventSource(url);
    source.addEventListener('open', () => {
      heard = Date.now();
      say('Live', false);
      opened?.();
    });
    source.addEventListener('message', ({ data }) => {
      heard = Date.now();
      const { version, ...update } = JSON.parse(data);
      if (version && version !== document.documentElement.dataset.version) {
        location.reload();
      } else {
        take(update);
      }
    });
    source.addEventListener('error', () => {
      lose();
      if (source?.readyState === EventSource.CLOSED) {
        rest();
        closed?.();
        setTimeout(listen, RECONNECT);
      }
    });
  };

  // A server that hangs, or a network that drops everything, does not close the connection.
  setInterval(() => {
    if (source && Date.now() - heard > SILENCE) {
      lose();
      rest();
      listen();
    }
  }, CHECK);
  document.addEventListener('visibilitychange', () => (document.hidden ? rest() : listen()));
  addEventListener('pagehide', rest);
  addEventListener('pageshow', listen);
  listen();
}
