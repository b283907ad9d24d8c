// The element <webots-simulation> of /embed.js: a simulation in any page.
//
// What is written here stays: later versions add to it, and a page that uses it goes on working. Anything else, such as
// the content of the shadow root apart from the named parts, may change.

/**
 * Where a simulation is: `waiting` for a free server, `starting`, `running` (it is shown), `lost` (the connection is, and
 * the element tries to return), `ended` by itself or by a failure. `idle` before the first start and after `stop()`.
 */
export type SimulationState = 'idle' | 'waiting' | 'starting' | 'running' | 'lost' | 'ended';

/** `ahead`: how many others wait before this visitor, if that is known. */
export interface StateDetail {
  state: SimulationState;
  world: string | undefined;
  ahead: number | undefined;
}

/**
 * How a simulation has ended. `code`: a reason of the servers (docs/protocol.md, "Reasons"), or of the element itself:
 * `session-unreachable`, `session-silent`, `server-unreachable`, `server-lost`, `broken-before`, `broken`, `absent`,
 * `simulator-unreachable`, `no-scene`, `origin-refused`, `left` (it was stopped), `unknown` (the server has told a sentence
 * without a code). Later versions may add codes. `message` is for people, in the element's language. `blame`, `retry` and
 * `output` come with reasons of the servers.
 */
export interface EndedDetail {
  code: string;
  message: string;
  blame?: string;
  retry?: string;
  output?: string;
}

/** `time`: of the simulation, in seconds. */
export interface TimeDetail {
  time: number;
}

export interface SimulationEvents {
  /** `state`, `world` or `ahead` has changed. */
  state: CustomEvent<StateDetail>;
  /** The simulation is shown, and can be steered. */
  ready: CustomEvent<object>;
  /** It is the visitor's turn in the line. */
  turn: CustomEvent<object>;
  /** The simulation has ended, or did not start. */
  ended: CustomEvent<EndedDetail>;
  /** The time of the simulation has changed. Not with Webots' own viewer. */
  time: CustomEvent<TimeDetail>;
}

/**
 * The attributes, for JSX and the like; docs/embedding.md, "TypeScript", shows how React takes them. `lang` and `autostart`
 * are read only when the element comes into its page, `world` and `autoplay` at each start, `viewer` and `viewer-script` when
 * a scene is shown.
 */
export interface SimulationAttributes {
  /** The world: the address of its page on its forge. */
  world?: string | undefined;
  /** Starts by itself. It counts if it is there, whatever its value is. */
  autostart?: boolean | '' | undefined;
  /** Lets the time of the simulation run once it is ready. It counts if it is there, whatever its value is. */
  autoplay?: boolean | '' | undefined;
  /** The visitor's name, for administrators. */
  name?: string | undefined;
  /** Which viewer shows it; without it, the one that fits. */
  viewer?: 'small' | 'webots' | undefined;
  /** URL of Webots' own viewer, for servers that don't have it. */
  'viewer-script'?: string | undefined;
  /** `en`, `de`, `fr`, `es`, `zh` or `ja`; without it, the first of the browser's languages that there is. */
  lang?: string | undefined;
}

/** All events of the element by their names, also those that each element has. */
export type SimulationEventMap = Omit<HTMLElementEventMap, keyof SimulationEvents> & SimulationEvents;

/**
 * CSS parts: `availability`, `announcement`, `start`, `leave`, `full-screen`, `notice`, `problem`, `steps`, `stage`.
 */
export declare class WebotsSimulation extends HTMLElement {
  /** The attribute `world`. */
  world: string;
  readonly state: SimulationState;
  /** Starts a world, that of the attribute if none is named; a simulation that runs ends. */
  start(world?: string): void;
  /** Ends the simulation, or waits no longer. */
  stop(): void;
  /** Lets the time of the simulation run; of one that is not ready, once it is. */
  play(): void;
  /** Lets the time of the simulation stand. */
  pause(): void;
  /** Sets the simulation back to its beginning. */
  reset(): void;
  addEventListener<Type extends keyof SimulationEventMap>(
    type: Type,
    listener: (this: WebotsSimulation, event: SimulationEventMap[Type]) => void,
    options?: boolean | AddEventListenerOptions,
  ): void;
  addEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | AddEventListenerOptions,
  ): void;
  removeEventListener<Type extends keyof SimulationEventMap>(
    type: Type,
    listener: (this: WebotsSimulation, event: SimulationEventMap[Type]) => void,
    options?: boolean | EventListenerOptions,
  ): void;
  removeEventListener(
    type: string,
    listener: EventListenerOrEventListenerObject,
    options?: boolean | EventListenerOptions,
  ): void;
}

declare global {
  interface HTMLElementTagNameMap {
    'webots-simulation': WebotsSimulation;
  }
}
