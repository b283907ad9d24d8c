// The languages: each has words for all codes, and the pages and modules have no others.

import assert from 'node:assert/strict';
import { readdirSync, readFileSync } from 'node:fs';
import { test } from 'node:test';

import { words as english } from '../../templates/assets/english.js';
import { formats } from '../../templates/assets/intl.js';
import { firstOf, LANGUAGES } from '../../templates/assets/language.js';
import { STEPS } from '../../templates/assets/page_view.js';
import { ADVICE } from '../../templates/assets/reasons.js';

const TEMPLATES = new URL('../../templates/', import.meta.url);
const STEP_SOURCE = new URL('../../src/simulation/progress.rs', import.meta.url);
const translations = Object.entries(LANGUAGES).filter(([language]) => language !== 'en');

/** @param {string} path */
const read = (path) => readFileSync(new URL(path, TEMPLATES), 'utf8');

/** The steps of a start that the servers send, as their source lists them. */
function steps() {
  const [, list = ''] = /^pub enum Step \{\n(.*?)^\}/ms.exec(readFileSync(STEP_SOURCE, 'utf8')) ?? [];
  const names = [...list.matchAll(/^ +([A-Z]\w*),$/gm)].map(([, name = '']) => name);
  assert.ok(names.length > 5, `${names}`);
  return names.map((name) => name.replace(/\B[A-Z]/g, '-$&').toLowerCase());
}

/**
 * All texts by their names; functions have been called.
 * @param {unknown} value
 * @param {string} name
 * @returns {[string, string][]}
 */
function texts(value, name = '') {
  if (typeof value === 'string') {
    return [[name, value]];
  }
  if (typeof value === 'function') {
    const argument =
      { absent: { since: 5 }, 'simulator-unreachable': { address: 'x' }, 'no-scene': { why: 'no-webgl' } }[
        name.split('.').at(-1) ?? ''
      ] ?? 5;
    return [[name, value(argument, 40)]];
  }
  return Object.entries(value ?? {}).flatMap(([key, part]) => texts(part, `${name}.${key}`));
}

test('each language has a text for each code and name, without one of English', async () => {
  const own = texts(english).filter(([name]) => name !== '.language');
  assert.ok(own.length > 120, `${own.length}`);
  // Some words are the same.
  const shared = new Set(['.page.version', '.page.pages', '.page.monitor', '.page.simulation', '.viewer.tools']);
  for (const [language, load] of translations) {
    const { words } = await load();
    const all = new Map(texts(words));
    for (const [name, text] of own) {
      const translated = all.get(name) ?? '';
      assert.notEqual(translated, '', `${language} ${name}`);
      if (text.split(' ').length > 2 && !shared.has(name) && !name.endsWith('.time') && !name.endsWith('.loading')) {
        assert.notEqual(translated, text, `${language} ${name}`);
      }
      assert.doesNotMatch(translated, /undefined|NaN|\[object/, `${language} ${name}`);
    }
    assert.deepEqual(Object.keys(words.reasons).sort(), Object.keys(ADVICE).sort(), language);
    assert.deepEqual(Object.keys(words.steps.progress).sort(), steps().sort(), language);
    assert.equal(words.language.split('-')[0], language);
  }
});

test('the pages and the element have the English words that they name, and no others', () => {
  /** @type {Set<string>} */
  const used = new Set();
  for (const path of [
    'page.html',
    'name_field.html',
    'session/viewer.html',
    'session/embedded.html',
    'session/webots_viewer.html',
    'simulation/watch.html',
    'simulation/who.html',
  ]) {
    const html = read(path)
      // The script of that page gives its title and heading the name that its frame has, too.
      .replaceAll(`>${english.stage.webotsViewer}<`, '><')
      .replace(/<noscript>.*?<\/noscript>/gs, '')
      .replace(
        /\{% block title_words %\} data-words="([\w-]+)"\{% endblock %\}\n\{% block title %\}([^{]*)/g,
        '<i data-words="$1">$2</i>',
      )
      .replace(/\{%.*?%\}|\{\{.*?\}\}/gs, '');
    for (const [, label, name] of html.matchAll(/aria-label="([^"]*)"(?: data-label-words="([\w-]+)")?/g)) {
      assert.equal(label, Object.entries(english.page).find(([key]) => key === name)?.[1], `${path}: ${label}`);
      used.add(name ?? '');
    }
    const rest = html.replace(/<(\w+)[^>]* data-words="([\w-]+)"[^>]*>([^<]*)<\/\1>/g, (_, _tag, name, text) => {
      assert.equal(text, Object.entries(english.page).find(([key]) => key === name)?.[1], `${path}: ${name}`);
      used.add(name);
      return '';
    });
    assert.doesNotMatch(rest.replace(/<[^>]*>/gs, ''), /[a-z]/i, path);
  }
  for (const [, name = ''] of read('assets/panel.js').matchAll(/page(?:\.|\[')([\w-]+)/g)) {
    used.add(name);
  }
  for (const step of STEPS) {
    used.add(step).add(`about-${step}`);
  }
  assert.deepEqual([...used].sort(), Object.keys(english.page).sort());
});

test('modules have no words of their own', () => {
  const files = Object.values(LANGUAGES).map((load) => /'\.\/(\w+\.js)'/.exec(String(load))?.[1]);
  assert.ok(files.every(Boolean));
  const administrators = [
    'charts.js',
    'chart.js',
    'live.js',
    'class.js',
    'server_events.js',
    'announce.js',
    'lessons.js',
    'simulation_monitor.js',
    'times.js',
  ];
  const modules = readdirSync(new URL('assets', TEMPLATES)).filter((name) => name.endsWith('.js'));
  for (const name of modules.filter((name) => ![...files, ...administrators].includes(name))) {
    const code = read(`assets/${name}`)
      .replace(/\/\*.*?\*\//gs, '')
      .replace(/^\s*\/\/.*$/gm, '')
      .replace(/throw new Error\(.*/g, '');
    for (const [, text = ''] of code.matchAll(/['`]([^'`\n]*)['`]/g)) {
      assert.doesNotMatch(text.replace(/\$\{[^}]*\}/g, ''), /^[A-Z][a-z]+ [a-z]+|[a-z]\.$/, `${name}: ${text}`);
    }
  }
  // This page shows what it throws.
  assert.doesNotMatch(read('assets/webots_viewer.js'), /Error\(['"`]/);
});

test('the language is the first of the wanted ones that there is', () => {
  assert.equal(firstOf(['', 'ru-RU', 'de-CH', 'fr']), 'de');
  assert.equal(firstOf(['ZH-hant-TW']), 'zh');
  assert.equal(firstOf(['ru', 'toString']), 'en');
  assert.equal(firstOf([]), 'en');
});

test('plural forms, durations and numbers are those of the language', async () => {
  const german = (await LANGUAGES.de()).words;
  assert.equal(german.steps.queued(1), '1 Person ist vor dir');
  assert.equal(german.steps.queued(1200), '1.200 Personen sind vor dir');
  assert.equal(german.closes(3660), 'Sie wird in 1 Stunde, 1 Minute geschlossen.');
  const french = (await LANGUAGES.fr()).words;
  assert.equal(french.steps.queued(1), '1 personne est devant vous');
  assert.equal(english.steps.queued(0), 'you are next');
  assert.equal(english.steps.queued(1), '1 client is ahead of you');
  const { clock, duration } = formats('en');
  assert.deepEqual([0, 1, 59.6, 61, 3600, 7384, -3].map(duration), [
    '0 seconds',
    '1 second',
    '1 minute',
    '1 minute, 1 second',
    '1 hour',
    '2 hours, 3 minutes',
    '0 seconds',
  ]);
  assert.deepEqual([0, 61_004.4, 3_600_500].map(clock), ['0:00.000', '1:01.004', '60:00.500']);
  assert.equal(german.viewer.time(1500), '0:01,500');
});

test('an estimate has whole minutes, with the units and forms of the language', async () => {
  const estimates = {
    en: ['about 1 minute', 'about 3 minutes', 'about 1 hour, 30 minutes', 'about 33 hours, 20 minutes'],
    de: ['etwa 1 Minute', 'etwa 3 Minuten', 'etwa 1 Stunde, 30 Minuten', 'etwa 33 Stunden, 20 Minuten'],
    fr: ['environ 1 minute', 'environ 3 minutes', 'environ 1 heure et 30 minutes', 'environ 33 heures et 20 minutes'],
    es: [
      'aproximadamente 1 minuto',
      'aproximadamente 3 minutos',
      'aproximadamente 1 hora y 30 minutos',
      'aproximadamente 33 horas y 20 minutos',
    ],
    zh: ['大约 1分钟', '大约 3分钟', '大约 1小时30分钟', '大约 33小时20分钟'],
    ja: ['約 1 分', '約 3 分', '約 1 時間 30 分', '約 33 時間 20 分'],
  };
  for (const [language, load] of Object.entries(LANGUAGES)) {
    const { line } = (await load()).words;
    const [one, ...more] = Object.entries(estimates).find(([name]) => name === language)?.[1] ?? [];
    // Some spaces don't break lines.
    const text = (/** @type {number} */ seconds) => line.estimated('', seconds).replace(/\s/g, ' ');
    const texts = [0, 89, 200, 5400, 120_000].map((seconds) => text(seconds).replace(/^[,，、] ?/, ''));
    assert.deepEqual(texts, [one, one, ...more], language);
  }
});
