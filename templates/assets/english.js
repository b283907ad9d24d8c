// All words of the viewer page, the small viewer and the watch page, in English. The page chooses them by codes: each
// other language is a file with the same names.

import { formats } from './intl.js';

/** @typedef {import('./visit.js').OwnProblem} OwnProblem */
/** @typedef {import('./messages.js').StepCode} StepCode */

const { clock, duration, minutes, number, percent, plural } = formats('en');

export const words = {
  /** The language, as the page names it to browsers and screen readers. */
  language: 'en',
  /** What the pages themselves say, by the names in their HTML. */
  page: {
    skip: 'Skip to the content',
    pages: 'Pages',
    class: 'Class',
    monitor: 'Monitor',
    viewer: 'Viewer',
    simulation: 'Simulation',
    empty: 'The simulation appears here.',
    version: 'Version',
    'session-server': 'Session server',
    'try-title': 'Try a world – session server',
    try: 'Try a world',
    connecting: 'Connecting',
    'to-session-server': 'to the session server …',
    url: 'URL of a world',
    'url-help': 'The page of a .wbt file on its forge: below /blob/, /tree/ or /src/branch/, in a folder worlds.',
    name: 'Your name',
    'name-help': 'The administrator sees it.',
    'shown-by': 'Shown by',
    automatic: 'the viewer that fits',
    webots: 'Webots’ own viewer',
    small: 'the small viewer',
    connect: 'Connect',
    examples: 'Examples',
    keep: 'Keep it',
    printed: 'Printed by the project or the simulator:',
    steps: 'Steps',
    session: 'Session server',
    'about-session': 'chooses a simulation server',
    server: 'Simulation server',
    'about-server': 'takes the world',
    place: 'Place',
    'about-place': 'in the line, if all are taken',
    checkout: 'Checkout',
    'about-checkout': 'of the world’s project',
    launch: 'Launch',
    'about-launch': 'of the simulator',
    'about-simulation': 'runs for you until you leave',
    watched: 'The administrator is watching.',
    'about-tabs':
      'Each tab has a simulation of its own: two tabs are two simulations. A page that is loaded again, or whose connection breaks, finds its simulation again; that ends with “Disconnect”, or some time after its tab was closed.',
    'simulation-server': 'Simulation server',
    'watch-title': 'Watching – simulation server',
    watch: 'Watching a simulation',
    'about-watching': 'You see what its user sees, and change nothing; its user is told that you watch.',
    'watch-small': 'Show it in the small viewer.',
    who: 'Who',
    unverified: 'unverified',
    world: 'World',
    'stop-watching': 'Close this page to stop watching.',
  },
  availability: {
    connecting: ['Connecting', 'to the session server …'],
    free: ['Available', 'A simulation server can take you.'],
    busy: ['Not available', 'All simulation servers are busy or do not answer.'],
    unreachable: ['No connection', 'to the session server. Trying again …'],
    lost: ['No connection', 'It is tried again and again.'],
  },
  buttons: {
    leave: 'Disconnect',
    stop: 'Stop waiting',
    fullScreen: 'Full screen',
    smallScreen: 'Leave full screen',
  },
  ready: 'The simulation is ready.',
  stage: {
    clear: 'The simulation appears here.',
    clearLeft: 'You have left the simulation; it has ended.',
    clearStopped: 'You wait no longer.',
    webotsViewer: 'Webots’ viewer',
    /** @param {unknown} why */
    noWebotsViewer: (why) => `Webots’ viewer can’t be loaded: ${why}. Choose the small viewer and connect again.`,
    onlyInside: 'this page shows it only inside of another one',
    onlySmall: 'Webots’ own viewer is not to be had here; the small viewer shows the simulation.',
  },
  steps: {
    choosing: 'choosing a simulation server',
    choosingAnother: 'choosing another simulation server',
    allBusy: 'all are busy',
    /** @param {string} why */
    redirected: (why) => `another one is asked for: ${why}`,
    chosen: 'has chosen a simulation server',
    notAsked: 'is not asked again',
    /** @param {string} server */
    connecting: (server) => `connecting to ${server}`,
    requesting: 'asking for one',
    /** @param {number} ahead */
    queued: (ahead) => {
      if (ahead === 0) {
        return 'you are next';
      }
      return `${number(ahead)} ${plural(ahead, { one: 'client is', other: 'clients are' })} ahead of you`;
    },
    /** What the server says of its progress is English. @type {Partial<Record<StepCode, string>>} */
    progress: {},
    granted: 'taken',
    launching: 'webots is starting',
    launched: 'the simulator is ready',
    joining: 'connecting to the simulator',
    /**
     * @param {string} status
     * @param {number} done in percent
     */
    loading: (status, done) => `${status} ${percent(done)}`,
    shown: 'is shown',
    framed: 'is shown by Webots’ own viewer',
    closed: 'the simulator has closed its connection',
    returning: 'asking for the one that was left',
  },
  waiting: {
    general: 'All servers are busy.',
    share: 'You have as many simulations as you may.',
    idleTime: 'Worlds of others run here only while the servers have little to do.',
    advice: 'It starts by itself when one is free.',
  },
  line: {
    advice: 'It starts by itself when it is your turn. You keep your place if you load the page again.',
    /**
     * @param {string} position
     * @param {number} seconds
     */
    estimated: (position, seconds) => `${position}, about ${minutes(seconds)}`,
    turn: 'It is your turn.',
  },
  lost: {
    /** @param {number} seconds */
    since: (seconds) => `No connection for ${duration(seconds)}.`,
    /** @param {number} seconds */
    waits: (seconds) =>
      seconds > 0 ? `Your simulation waits up to another ${duration(seconds)}.` : 'Your simulation may have ended.',
    /** @param {number} seconds */
    said: (seconds) => `No connection. ${words.lost.waits(seconds)}`,
    found: 'The connection is there again.',
  },
  /** @param {number} seconds */
  idle: (seconds) => `The simulation is paused, and ends in ${duration(seconds)}.`,
  /** @param {number} seconds */
  closes: (seconds) => `It will be closed in ${duration(seconds)}.`,
  /** @param {number} share */
  slow: (share) => `This simulation runs at ${number(share)} of real time.`,
  /** @param {string} name */
  visitor: (name) => `The administrator sees you as ${name}.`,

  /** What the page itself has found. */
  problems: {
    'session-unreachable': 'The session server could not be reached.',
    'session-silent': 'The session server does not answer.',
    'server-unreachable': 'The simulation server could not be reached, or has closed the connection.',
    'broken-before': 'The connection to the simulation server broke before the simulation ran.',
    'server-lost': 'The server was lost. Your simulation is over; start it again.',
    'origin-refused': 'The simulation server starts nothing for pages of this site.',
    broken: 'The connection to the simulation server broke: the simulation has ended.',
    /** @param {Extract<OwnProblem, { code: 'absent' }>} problem */
    absent: ({ since }) => `There was no connection for ${duration(since)}: the simulation has ended.`,
    /** @param {Extract<OwnProblem, { code: 'simulator-unreachable' }>} problem */
    'simulator-unreachable': ({ address }) => `The simulator could not be reached at ${address}.`,
    /** @param {Extract<OwnProblem, { code: 'no-scene' }>} problem */
    'no-scene': ({ why }) => words.scene[why],
  },
  /** Why a scene can't be shown. */
  scene: {
    'no-frame': 'Webots’ viewer can’t be shown: its server lets no pages of this site frame it (key frameAncestors).',
    'not-loaded': 'The scene can’t be shown: a part of this page could not be loaded. Load the page again.',
    'no-webgl': 'The scene can’t be shown: this browser offers no WebGL, so that nothing can be drawn.',
    unreadable: 'The scene can’t be shown: the simulator has sent a scene that can’t be read.',
  },
  /** What a server says of the reasons is English, and says more. @type {Record<string, string>} */
  reasons: {},
  /** What the visitor can do. */
  advice: {
    general: 'Connect again. If that fails too, tell the administrator what is written here.',
    again: 'Connect again for another simulation.',
    later: 'Try again later.',
    address:
      'Copy the address of the world’s page on its forge, such as https://github.com/USER/REPOSITORY/blob/main/worlds/NAME.wbt.',
    allowed: 'Only worlds of allowed repositories run here: the monitor page of each simulation server lists them.',
    idleTime: 'Worlds of others run here only while the servers have little to do. Try again later.',
    share: 'End one of your simulations, or connect again later.',
    elsewhere:
      'Connect again in a moment: the session server chooses another simulation server as soon as there is one.',
    administrator:
      'It is not the fault of the world. Connect again; if that fails too, tell the administrator what is written here.',
    exists: 'Look whether the repository, the branch and the file exist, and whether everybody may read them.',
    moved: 'Open the repository’s page on its forge, and copy the address of the world from there.',
    smaller: 'Try a smaller project, or ask the administrator for a higher limit.',
    project: 'It comes from the world or its project. Change that, or connect again.',
    takenOver: 'Another tab, or another window, shows it now. Connect here for a simulation of this tab’s own.',
    teacher: 'Ask the administrator before you connect again.',
    origin: 'Its administrator can allow the site (key allowedOrigins).',
    firewall:
      'A firewall may be in the way: the ports above the simulation server’s own have to be open, or forwarded.',
  },

  /** The small viewer. */
  viewer: {
    play: 'Play',
    pause: 'Pause',
    playTitle: 'Run in real time, or pause',
    step: 'Step',
    stepTitle: 'One step of time',
    reset: 'Reset',
    resetTitle: 'Back to the beginning',
    home: 'Home view',
    homeTitle: 'Look from where the world says',
    clock: 'Simulation time',
    /** @param {number} time in milliseconds */
    time: (time) => clock(time),
    tools: 'Simulation',
    help: 'Drag or use the arrow keys to look around; with Shift to move; wheel, pinch, + and − to come closer; Home to go back.',
    console: 'Console',
    /** @param {string} title */
    view: (title) => `View of the scene ${title}`.trim(),
    modes: { loading: 'loading', pause: 'paused', 'real-time': 'real time', fast: 'fast', lost: 'no connection' },
  },
  watching: {
    on: 'Watching',
    over: 'It is over: the simulation has ended, or its server can’t be reached.',
  },
};
