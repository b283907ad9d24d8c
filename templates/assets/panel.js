// What an element shows of its visit: the availability, the steps, the scene, and what there is to say. Drawn from a
// `PageView`, in the element's shadow root.

import { make, setText } from './dom.js';
import { STEPS, timeLeft, view, waitingNotice } from './page_view.js';
import { Stage } from './stage.js';

/** @typedef {import('./page_view.js').Progress} Progress */
/** @typedef {import('./visit.js').Event} VisitEvent */
/** @typedef {import('./visit.js').State} State */
/** @typedef {import('./visit.js').Visit} Visit */

/**
 * A part of the panel, which pages may style by its name.
 * @template {HTMLElement} T
 * @param {string} name
 * @param {T} element
 */
function part(name, element) {
  element.part.add(name);
  return element;
}

/** An element that is shown only with a text. @param {Partial<HTMLParagraphElement>} [properties] */
const hidden = (properties) => make('p', { hidden: true, ...properties });

export class Panel {
  words;
  /** What is in the shadow root. */
  element;
  stage;
  #parts;
  #begin;
  #take;
  /** What was last said of the steps. */
  #said = '';

  /**
   * @param {import('./language.js').Words} words
   * @param {string} base the URL of the session server
   * @param {{ begin: () => void, take: (event: VisitEvent) => void, time: (milliseconds: number) => void }} owner
   */
  constructor(words, base, { begin, take, time }) {
    this.words = words;
    this.#begin = begin;
    this.#take = take;
    this.#parts = { ...this.#top(), ...this.#notices(), ...this.#steps() };
    const stage = part('stage', make('div', { id: 'stage', className: 'sheet stage', role: 'group' }));
    stage.setAttribute('aria-label', words.page.simulation);
    this.stage = new Stage(stage, { words, base, tell: take, time });
    this.stage.clear(words.stage.clear);
    this.#parts.workbench.append(stage);
    const { announcement, bar, visitor, notice, idle, problem, workbench, spoken } = this.#parts;
    this.element = make(
      'div',
      { className: 'simulation', lang: words.language },
      announcement,
      bar,
      visitor,
      notice,
      idle,
      problem,
      workbench,
      spoken,
    );
    this.element.addEventListener('fullscreenchange', () => this.#drawFullScreen());
  }

  /* building */

  #top() {
    const { page, buttons } = this.words;
    const word = make('strong', { id: 'availability-word', textContent: page.connecting });
    const about = make('span', { id: 'availability-text', textContent: page['to-session-server'] });
    const lamp = make('span', { className: 'lamp' });
    lamp.setAttribute('aria-hidden', 'true');
    const availability = part(
      'availability',
      make('p', { id: 'availability', className: 'availability', role: 'status' }, lamp, ' ', word, ' ', about),
    );
    const start = part(
      'start',
      this.#button(page.connect, 'main', () => this.#begin()),
    );
    const leave = part(
      'leave',
      this.#button(buttons.leave, '', () => this.#take({ type: 'left' })),
    );
    leave.hidden = true;
    const full = part(
      'full-screen',
      this.#button(buttons.fullScreen, '', () => this.#toggleFullScreen()),
    );
    full.hidden = true;
    const bar = make('div', { className: 'bar' }, availability, start, leave, full);
    const announcement = part(
      'announcement',
      hidden({ id: 'announcement', className: 'announcement', role: 'status' }),
    );
    const visitor = hidden({ id: 'visitor', className: 'none' });
    const spoken = make('p', { id: 'spoken', className: 'spoken', role: 'status' });
    return { word, about, availability, start, leave, full, bar, announcement, visitor, spoken };
  }

  /**
   * @param {string} text
   * @param {string} className
   * @param {() => void} action
   */
  #button(text, className, action) {
    const button = make('button', { type: 'button', className, textContent: text });
    button.addEventListener('click', action);
    return button;
  }

  #notices() {
    const { page } = this.words;
    const noticeText = make('strong', { id: 'notice-text' });
    const noticeAdvice = make('span', { id: 'notice-advice' });
    const notice = part('notice', make('div', { id: 'notice', className: 'notice' }, noticeText, ' ', noticeAdvice));
    const idleText = make('strong', { id: 'idle-text' });
    const keep = this.#button(page.keep, '', () => this.#take({ type: 'keep' }));
    const idle = part('notice', make('div', { id: 'idle', className: 'notice' }, idleText, ' ', keep));
    const problemText = make('strong', { id: 'problem-text' });
    const problemAdvice = make('span', { id: 'problem-advice' });
    const sentence = hidden({ id: 'problem-sentence', lang: 'en' });
    const outputText = make('pre', { id: 'problem-output-text', tabIndex: 0 });
    const output = make(
      'figure',
      { id: 'problem-output', hidden: true },
      make('figcaption', { textContent: page.printed }),
      outputText,
    );
    const problem = part(
      'problem',
      make(
        'div',
        { id: 'problem', className: 'alert', role: 'alert' },
        problemText,
        ' ',
        problemAdvice,
        sentence,
        output,
      ),
    );
    for (const one of [notice, idle, problem]) {
      one.hidden = true;
    }
    return {
      notice,
      noticeText,
      noticeAdvice,
      idle,
      idleText,
      problem,
      problemText,
      problemAdvice,
      sentence,
      output,
      outputText,
    };
  }

  #steps() {
    const { page } = this.words;
    const steps = STEPS.map((name) => {
      const note = make('small', { textContent: page[`about-${name}`] });
      const item = make('li', { id: `step-${name}` }, make('b', { textContent: page[name] }), note);
      item.dataset.step = name;
      return { name, item, note };
    });
    const list = make('ol', { id: 'steps' }, ...steps.map(({ item }) => item));
    const left = hidden({ id: 'left', className: 'none' });
    const watched = hidden({ id: 'watched', role: 'status', textContent: page.watched });
    const slow = hidden({ id: 'slow', role: 'status' });
    const title = make('h2', { id: 'steps-title', textContent: page.steps });
    const group = part(
      'steps',
      make('div', { className: 'sheet steps', role: 'group' }, title, list, left, slow, watched),
    );
    // No landmark: a page may have several elements, and each landmark needs a name of its own.
    group.setAttribute('aria-labelledby', title.id);
    return { steps, left, slow, watched, workbench: make('div', { className: 'workbench' }, group) };
  }

  /* drawing */

  /**
   * @param {Visit} visit
   * @param {State} before the state that was drawn last
   */
  draw(visit, before) {
    const { words } = this;
    const shown = view(visit, Date.now(), words);
    const parts = this.#parts;
    this.element.dataset.is = visit.state.is;
    this.#drawAvailability(shown.lamp, shown.availability);
    this.#drawProgress(shown.progress);
    drawNotice(parts.notice, parts.noticeText, parts.noticeAdvice, shown.notice);
    drawNotice(parts.problem, parts.problemText, parts.problemAdvice, shown.problem);
    show(parts.sentence, shown.problem?.sentence);
    show(parts.output, shown.problem?.output, parts.outputText);
    this.#drawIdle(shown.idle);
    show(parts.left, shown.closes);
    show(parts.slow, shown.slow);
    parts.watched.hidden = !shown.isWatched;
    this.#drawButtons(shown.leave);
    const waits = waitingNotice(visit.state, words);
    if (waits && !waitingNotice(before, words)) {
      this.say(`${this.#said}. ${waits.text} ${waits.advice}`);
    }
  }

  /** @param {string | undefined} leave the label of the button that leaves */
  #drawButtons(leave) {
    const { start, leave: button, full } = this.#parts;
    const isLeft = leave === undefined && button.matches(':focus');
    setText(button, leave ?? this.words.buttons.leave);
    start.hidden = leave !== undefined;
    button.hidden = leave === undefined;
    full.hidden = !document.fullscreenEnabled || leave === undefined;
    if (isLeft) {
      start.focus();
    }
  }

  /**
   * @param {'on' | 'off' | undefined} lamp
   * @param {string[]} texts
   */
  #drawAvailability(lamp, [word = '', text = '']) {
    const { availability } = this.#parts;
    for (const name of ['on', 'off']) {
      availability.classList.toggle(name, name === lamp);
    }
    setText(this.#parts.word, word);
    setText(this.#parts.about, text);
  }

  /** @param {string | undefined} text */
  #drawIdle(text) {
    const { idle, idleText } = this.#parts;
    const isNew = idle.hidden && text !== undefined;
    show(idle, text, idleText);
    if (isNew) {
      this.say(text);
    }
  }

  /** @param {Progress | undefined} progress */
  #drawProgress(progress) {
    const at = progress ? STEPS.indexOf(progress.at) : -1;
    this.#parts.steps.forEach(({ name, item, note }, index) => {
      const state = index < at ? 'done' : index === at ? progress?.is : undefined;
      for (const one of ['doing', 'done', 'failed']) {
        item.classList.toggle(one, one === state);
      }
      if (state === 'doing') {
        item.setAttribute('aria-current', 'step');
      } else {
        item.removeAttribute('aria-current');
      }
      // What the step is, as long as there is nothing to say of it.
      setText(note, progress?.notes[name] || this.words.page[`about-${name}`]);
      if (state === 'doing') {
        this.#sayStep(`${this.words.page[name]}: ${note.textContent}`);
      }
    });
    if (!progress) {
      this.#said = '';
    }
  }

  /* what is said, to screen readers too */

  /**
   * Tells screen readers something.
   * @param {string} text
   */
  say(text) {
    this.#parts.spoken.textContent = text;
  }

  /** @param {string} text */
  #sayStep(text) {
    if (text === this.#said) {
      return;
    }
    this.#said = text;
    this.say(text);
  }

  /** @param {State} state */
  sayLost(state) {
    if (state.is === 'lost') {
      this.say(this.words.lost.said(timeLeft(state, Date.now())));
    }
  }

  /**
   * Shows the administrator's announcement; without a text, hides it.
   * @param {string} text
   */
  announce(text) {
    show(this.#parts.announcement, text || undefined);
  }

  /**
   * Shows as whom administrators see the visitor.
   * @param {string | undefined} name
   */
  nameVisitor(name) {
    show(this.#parts.visitor, name && this.words.visitor(name));
  }

  /* full screen */

  #isFullScreen() {
    return this.element.matches(':fullscreen');
  }

  #toggleFullScreen() {
    const change = this.#isFullScreen() ? document.exitFullscreen() : this.element.requestFullscreen();
    // A frame that may not: its page has not allowed it.
    change.catch(() => undefined);
  }

  #drawFullScreen() {
    const { buttons } = this.words;
    setText(this.#parts.full, this.#isFullScreen() ? buttons.smallScreen : buttons.fullScreen);
  }
}

/**
 * Shows a text in an element, or hides the element without one.
 * @param {HTMLElement} element
 * @param {string | undefined} text
 * @param {HTMLElement} place where the text is
 */
function show(element, text, place = element) {
  if (text !== undefined) {
    setText(place, text);
  }
  element.hidden = text === undefined;
}

/**
 * @param {HTMLElement} element
 * @param {HTMLElement} text
 * @param {HTMLElement} advice
 * @param {import('./page_view.js').Notice | undefined} notice
 */
function drawNotice(element, text, advice, notice) {
  setText(text, notice?.text ?? '');
  setText(advice, notice?.advice ?? '');
  element.hidden = !notice;
}
