// The way from a world's URL to a running simulation: the simulation server's WebSocket, which holds the lease.

/** Prefix of a step, for the progress bar of Webots' page. */
const STEP_FOR_WEBOTS = /^Step \d\/\d : /;
const CHECKOUT_IS_OVER = /^webots\b/i;
/** Close codes after which another simulation server may accept the client: going away, try again later. */
const TRY_ANOTHER = [1001, 1013];
/** Time to wait for the close of a connection after the reason for it was received, in milliseconds. */
const CLOSING = 1000;

/** What the user can do about a failure, as text. */
export function advice(text) {
  const table = [
    [/Docker not enabled|not one of the repositories|no simulation server accepts|blocked repository|does not allow/i,
      'Only worlds of allowed repositories run here: the monitor page of each simulation server lists them.'],
    [/idle time/i, 'Worlds of others run here only while the servers have little to do. Try again later.'],
    [/wrong .*URL|\bno URL\b/i, 'Copy the address of the world’s page on its forge, such as https://github.com/USER/REPOSITORY/blob/main/worlds/NAME.wbt.'],
    [/does not exist|not public|has no |no branch|not found|no such/i,
      'Look whether the repository, the branch and the file exist, and whether everybody may read them.'],
    [/larger than|longer than/i, 'Try a smaller project, or ask the administrator for a higher limit.'],
    [/Webots is installed|no Webots at/, 'The administrator of this simulation server has to set where Webots is.'],
    [/taken over/i, 'Another tab, or another window, shows it now. Connect here for a simulation of this tab’s own.'],
    [/teacher has stopped/i, 'Ask your teacher before you connect again.'],
    [/waited longest|did not come back/i, 'Connect again for another simulation.'],
    [/time limit|was paused for/i, 'Connect again for another simulation.'],
    [/simulator could not be reached/, 'A firewall may be in the way: the ports above the simulation server’s own have to be open, or forwarded.'],
    [/takes no new clients/i, 'Connect again in a moment: the session server chooses another simulation server as soon as there is one.'],
  ];
  const found = table.find(([pattern]) => pattern.test(text));
  return found ? found[1] : 'Connect again. If that fails too, tell the administrator what is written here.';
}

/**
 * The connection of one simulation. Events: `step` ({step, state, text}), `left` (seconds until it is closed), `ready`
 * (the simulator's address), `token` (it resumes the simulation within `absence` seconds), `idle` (seconds until it
 * ends because it is paused, or null: it does not), `heard` (a sign of life), `failed` (text: it is over), `elsewhere`
 * (text: this server can't accept the client, another may), `broken` (the client may return).
 */
export class Simulation extends EventTarget {
  #socket;
  #granted = false;
  #launched = false;
  #ended = false;
  #why;
  /** The token that resumes the simulation, once there is one. */
  #token;
  /** Time for which the simulation then waits, in seconds. */
  absence = 0;

  /** Requests a world under a name, or the simulation of a token, from a simulation server (a WebSocket address). */
  constructor(server, { world, name, token }) {
    super();
    this.#token = token;
    this.#step('server', 'doing', `connecting to ${server}`);
    this.#socket = new WebSocket(`${server}/client`);
    this.#socket.addEventListener('open', () => {
      this.#step('server', 'done', server);
      this.#step('place', 'doing', token ? 'asking for the one that was left' : 'asking for one');
      this.#socket.send(JSON.stringify(token ? { resume: token } : { start: { url: world, resumable: true, name } }));
    });
    this.#socket.addEventListener('message', ({ data }) => {
      if (this.#ended)
        return;
      // A refusal is not a sign of life.
      if (!/^(loading: Error|error):/.test(data))
        this.#tell('heard');
      this.#understand(data);
    });
    this.#socket.addEventListener('close', ({ code }) => this.#closed(code));
  }

  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }

  #step(step, state, text) {
    this.#tell('step', { step, state, text });
  }

  #understand(text) {
    const rest = (prefix) => text.slice(prefix.length).trim();
    if (text.startsWith('webots:')) {
      this.#launched = true;
      this.#step('launch', 'done', 'the simulator is ready');
      this.#tell('ready', rest('webots:'));
    } else if (text.startsWith('watched:'))
      this.#tell('watched', rest('watched:') === '1');
    else if (text.startsWith('absence:'))
      this.absence = Number(rest('absence:'));
    else if (text.startsWith('resume:')) {
      this.#token = rest('resume:');
      this.#tell('token', this.#token);
    } else if (text.startsWith('loading: Error:'))
      this.#refused(rest('loading: Error:'));
    else if (text.startsWith('error:'))
      this.#refused(rest('error:'));
    else if (text.startsWith('loading:'))
      this.#loading(rest('loading:'));
    else if (text.startsWith('queue:')) {
      const ahead = Number(rest('queue:'));
      const clients = ahead === 1 ? 'one client is' : `${ahead} clients are`;
      this.#step('place', 'doing', ahead === 0 ? 'you are next' : `${clients} ahead of you`);
    } else if (text.startsWith('idle:')) {
      const seconds = Number(rest('idle:'));
      this.#tell('idle', Number.isNaN(seconds) ? null : seconds);
    } else if (text.startsWith('shutdownTimeout:')) {
      this.#step('place', 'done', 'taken');
      this.#step('checkout', 'done', '');
      this.#tell('left', Number(rest('shutdownTimeout:')));
    }
  }

  #loading(text) {
    // `queue:` says the same, for programs.
    if (text.startsWith('waiting for a place'))
      return;
    this.#granted = true;
    this.#step('place', 'done', 'taken');
    text = text.replace(STEP_FOR_WEBOTS, '');
    if (this.#launched)
      this.#step('simulation', 'doing', text);
    else if (CHECKOUT_IS_OVER.test(text)) {
      this.#step('checkout', 'done', '');
      this.#step('launch', 'doing', text);
    } else
      this.#step('checkout', 'doing', text);
  }

  /** The reason comes first; the close code then shows whether another server may accept the client. */
  #refused(text) {
    this.#why = text;
    setTimeout(() => this.#closed(), CLOSING);
  }

  #closed(code) {
    if (this.#ended)
      return;
    this.#ended = true;
    if (this.#why)
      this.#tell(TRY_ANOTHER.includes(code) && !this.#launched ? 'elsewhere' : 'failed', this.#why);
    else if (this.#token)
      this.#tell('broken');
    else if (this.#launched)
      this.#tell('failed', 'The connection to the simulation server broke: the simulation has ended.');
    else if (this.#granted)
      this.#tell('failed', 'The connection to the simulation server broke before the simulation ran.');
    else
      this.#tell('elsewhere', 'The simulation server could not be reached, or has closed the connection.');
  }

  /** Asks the server not to end the simulation although it is paused. */
  keep() {
    this.#socket.send(JSON.stringify({ keep: true }));
  }

  /** Closes the connection, and lets the simulation wait if it can. */
  detach() {
    this.#ended = true;
    this.#socket.close();
  }

  /** Leaves: the simulation ends. */
  close() {
    this.#ended = true;
    this.#socket.close(1000);
  }
}
