// Numbers, durations and plural forms in a language. No DOM.

/**
 * Makes something when it is first used: browsers take milliseconds to make the first of these.
 * @template T
 * @param {() => T} make
 */
function lazy(make) {
  /** @type {T | undefined} */
  let made;
  return () => {
    made ??= make();
    return made;
  };
}

/**
 * The formats of a language.
 * @param {string} language
 */
export function formats(language) {
  const numbers = lazy(() => new Intl.NumberFormat(language));
  const percents = lazy(() => new Intl.NumberFormat(language, { style: 'percent' }));
  const plurals = lazy(() => new Intl.PluralRules(language));
  const parts = lazy(() => new Intl.ListFormat(language, { type: 'unit', style: 'short' }));
  const clock = lazy(() => new Intl.NumberFormat(language, { minimumIntegerDigits: 2, minimumFractionDigits: 3 }));
  /**
   * @param {number} count
   * @param {string} unit
   */
  const amount = (count, unit) =>
    new Intl.NumberFormat(language, { style: 'unit', unit, unitDisplay: 'long' }).format(count);
  const duration = (/** @type {number} */ seconds) => {
    const rest = Math.max(0, Math.round(seconds));
    const hours = Math.floor(rest / 3600);
    const minutes = Math.floor(rest / 60) % 60;
    const all = [
      { count: hours, unit: 'hour' },
      { count: minutes, unit: 'minute' },
      { count: hours > 0 ? 0 : rest % 60, unit: 'second' },
    ];
    const used = all.filter(({ count }) => count > 0).map(({ count, unit }) => amount(count, unit));
    return parts().format(used.length > 0 ? used : [amount(0, 'second')]);
  };
  return {
    /** @param {number} count */
    number: (count) => numbers().format(count),
    /** @param {number} count */
    percent: (count) => percents().format(count / 100),
    /**
     * The form that goes with a number.
     * @param {number} count
     * @param {{ one?: string, other: string }} forms
     */
    plural: (count, forms) => (plurals().select(count) === 'one' ? forms.one : undefined) ?? forms.other,
    duration,
    /**
     * A duration that is only estimated: whole minutes, at least one.
     * @param {number} seconds
     */
    minutes: (seconds) => duration(60 * Math.max(1, Math.round(seconds / 60))),
    /**
     * A time of the simulation.
     * @param {number} time in milliseconds
     */
    clock: (time) => `${Math.floor(time / 60_000)}:${clock().format((Math.round(time) % 60_000) / 1000)}`,
  };
}
