// Times on the page: written in UTC by the server, shown in the reader's own time.

const clock = new Intl.DateTimeFormat(undefined, { hour: '2-digit', minute: '2-digit', second: '2-digit' });
const day = new Intl.DateTimeFormat(undefined, { day: 'numeric', month: 'short', hour: '2-digit', minute: '2-digit' });
const whole = new Intl.DateTimeFormat(undefined, { dateStyle: 'medium', timeStyle: 'long' });

/**
 * Shows all times below an element in the reader's time zone.
 * @param {ParentNode} root
 */
export function showTimes(root) {
  const today = new Date().toDateString();
  for (const element of root.querySelectorAll('time')) {
    const time = new Date(element.dateTime);
    if (Number.isNaN(time.getTime())) {
      continue;
    }
    element.textContent = (time.toDateString() === today ? clock : day).format(time);
    element.title = whole.format(time);
  }
}

/**
 * The time of day of a number of seconds since 1970.
 * @param {number} seconds
 */
export function timeOfDay(seconds) {
  return clock.format(new Date(1000 * seconds));
}

/**
 * A number of seconds as text.
 * @param {number} seconds
 */
export function duration(seconds) {
  const rest = Math.max(0, Math.round(seconds));
  const [hours, minutes] = [Math.floor(rest / 3600), Math.floor(rest / 60) % 60];
  if (hours > 0) {
    return `${hours} h ${String(minutes).padStart(2, '0')} min`;
  }
  return minutes > 0 ? `${minutes} min ${String(rest % 60).padStart(2, '0')} s` : `${rest} s`;
}
