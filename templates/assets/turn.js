// The sound that calls visitors when it is their turn.

/** Frequencies of the sound in hertz, and the length of each tone in seconds. */
const TONES = [660, 880];
const LENGTH = 0.18;

/** A browser that has no sound, or allows none without a click, stays silent. */
export function ring() {
  // It would write a warning to the console.
  if (navigator.userActivation?.hasBeenActive === false) {
    return;
  }
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
