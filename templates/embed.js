// What pages of other sites import: the element `<webots-simulation>`. `embed.d.ts` describes it.

export { WebotsSimulation } from './assets/embed.js';

// What that imports in turn, so that browsers request all of it at once.
import './assets/dom.js';
import './assets/intl.js';
import './assets/kept.js';
import './assets/language.js';
import './assets/messages.js';
import './assets/page_view.js';
import './assets/panel.js';
import './assets/reasons.js';
import './assets/session_server.js';
import './assets/simulation_link.js';
import './assets/stage.js';
import './assets/styles.js';
import './assets/turn.js';
import './assets/visit.js';
import './assets/visit_runner.js';
