// It is the visitor's turn: a sound, and another title while the page is in the background.

const TITLE = document.title;
/** Frequencies of the sound in hertz, and the length of each tone in seconds. */
const TONES = [660, 880];
const LENGTH = 0.18;

/**
 * Draws attention to the page. The title is back when the page is seen.
 * @param {string} text
 */
export function ring(text) {
  play();
  if (!document.hidden) {
    return;
  }
  document.title = `${text} ${TITLE}`;
  document.addEventListener('visibilitychange', restoreTitle);
}

function restoreTitle() {
  if (!document.hidden) {
    document.title = TITLE;
    document.removeEventListener('visibilitychange', restoreTitle);
  }
}

/** A browser that has no sound, or allows none without a click, stays silent. */
function play() {
  try {
    const audio = new AudioContext();
    TONES.forEach((frequency, index) => {
      const tone = new OscillatorNode(audio, { frequency });
      const volume = new GainNode(audio, { gain: 0.1 });
      tone.connect(volume).connect(audio.destination);
      tone.start(audio.currentTime + index * LENGTH);
      tone.stop(audio.currentTime + (index + 1) * LENGTH);
      tone.addEventListener('ended', () => index === TONES.length - 1 && audio.close());
    });
  } catch {
    // No sound.
  }
}
