// The language of a page: that of `?lang=`, or else the first of the browser's that there is. Each has a file with all
// words, of which a page loads one.

/** The words of a language. @typedef {typeof import('./english.js').words} Words */

/** The languages, with their words. */
export const LANGUAGES = {
  en: () => import('./english.js'),
  de: () => import('./german.js'),
  fr: () => import('./french.js'),
  es: () => import('./spanish.js'),
  zh: () => import('./chinese.js'),
  ja: () => import('./japanese.js'),
};

/**
 * The first of these languages that there is, or English.
 * @param {readonly string[]} wanted language tags, such as `de-CH`
 */
export function firstOf(wanted) {
  const languages = /** @type {(keyof typeof LANGUAGES)[]} */ (Object.keys(LANGUAGES));
  const bases = wanted.map((tag) => tag.toLowerCase().split('-')[0]);
  return bases.map((base) => languages.find((language) => language === base)).find(Boolean) ?? 'en';
}

/**
 * The words of this page, whose language the document gets.
 * @param {string | null} named the language that the page's URL names
 * @returns {Promise<Words>}
 */
export async function wordsOfPage(named) {
  const { words } = await LANGUAGES[firstOf([named ?? '', ...navigator.languages])]();
  document.documentElement.lang = words.language;
  for (const element of document.querySelectorAll('[data-words], [data-label-words]')) {
    translate(/** @type {HTMLElement} */ (element), words.page);
  }
  return words;
}

/**
 * @param {HTMLElement} element
 * @param {Record<string, string>} page
 */
function translate(element, page) {
  const { words, labelWords } = element.dataset;
  if (words !== undefined) {
    element.textContent = page[words] ?? '';
  }
  if (labelWords !== undefined) {
    element.setAttribute('aria-label', page[labelWords] ?? '');
  }
}
