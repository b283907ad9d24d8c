//! A fleet for interactive robot simulations in the browser: a session server and simulation servers.
//!
//! They replace two Python servers, which comments call *the original*. This page is the map; `CONTRIBUTING.md`
//! lists which file to open for which change. Each directory is a
//! module: its `mod.rs` says what belongs there and re-exports its public API.
//!
//! | module | contents |
//! |---|---|
//! | [`shared::text`] | untrusted texts, made safe to show |
//! | [`shared::config`] | configuration files: loading, errors, kinds of values, a macro for structs of keys (`keys`) |
//! | [`shared::domain`] | addresses, loads, the forms of world URLs (`project_url`), which repositories a server takes (`admission`), a server's report |
//! | [`shared::run`] | start, readiness, log, stop |
//! | [`shared::http`] | pages, live updates, WebSockets, limits, certificates, metrics |
//! | [`session::placement`] | which server gets the next client: the load of a server and the key that servers are sorted by (`backend`), the choice of the first, of servers that keep the world ready before dedicated ones before others (`load_balancer`), cost |
//! | [`session::line`] | the clients that wait for a slot of the fleet: tickets (`ticket`), the line and its order (`Place` in `waiting_line`), who gets the next slot of which server (`Dispatcher::share`, in `dispatcher`) |
//! | [`session::class`] | all simulations of the fleet and who waits, with the number of each change, and the links to servers for actions (`roster`) |
//! | [`session::mail`] | notices: to whom (`smtp`, one address, from the key `administrator` in `config/session_config`) and how (`channel`), what is in them (`notice_text`), which changes are mailed (`event` in `fleet/server_record`), and how long they wait (`outbox`) |
//! | [`session::fleet`] | the registry and the monitors of simulation servers, and what connects them with the line (`line_keeper`, `slot_link`) |
//! | [`session::web`] | routes, pages, `/status`, Prometheus metrics (gauges in `metrics`, counters and histograms in `app`) and the WebSocket of the session server with its messages (`web_client`: `Request` is what comes in, its handlers and `updates` write what goes out) |
//! | [`simulation::process`] | process trees: how they start and end (`process_group`: SIGTERM, grace period, SIGKILL; leftovers of a dead server: `process_tree`, `guardian`; what has left the group ends with its control group or its containers, see `simulation::isolation` and `simulation::container`); directories of simulations |
//! | [`simulation::machine`] | readings of the machine (`sensors`) and its GPUs (`gpus`), the load that follows from them (`sensors`), its mean and `monitor.csv` (`load_monitor`), what each simulation uses (`usage`); which GPU a simulation gets if they are spread over several (`spread`) |
//! | [`simulation::checkout`] | worlds checked out with git; `timing.checkout` limits a whole checkout (`checkout_service`), each git command, and by a quarter of it a silent remote (`Git::command`, in `git`); `projectSize` limits its size; the simulation server's `config/mirrors` has GitHub's address and the other Git hosts (`gitMirrors`) |
//! | `simulation::isolation` | how a simulation is launched: its level of isolation (`launcher`), the variables that it inherits, limits; the GPUs that a sandbox shows (`devices` in `sandbox`); the control group that ends with it (`cgroup`) |
//! | [`simulation::container`] | simulations in containers: what a project requests, its image, its compose project (`compose_project`, with its GPU and user) |
//! | [`simulation::ends`] | how simulations have ended: counter, table, their logs (`kept_output`); for which reasons an end can be requested (`stop_reason`) |
//! | [`simulation::webots`] | one running Webots: its command line and GPU (`launch_spec`), its log (path and size in `launched`, its lines in `output`), the wait for its end (`launched`) |
//! | [`simulation::client`] | a client's WebSocket (`web_client`), its simulation when it comes back on another one (`resume`), that of a session server that asks for slots (`slot_link`), the session of its simulation, which sends it nearly all messages (`session`; `start`: before Webots runs, with the choice of the GPU) |
//! | `simulation::handover`, [`simulation::upgrade`] | an upgrade: the processes of a server, what they tell and pass each other, and which one a connection is for; the old process' side is `upgrade` |
//! | [`simulation::attachment`] | what a connection and its session send each other, and the tokens by which a client that resumes finds its session |
//! | [`simulation::slots`] | the slots that clients wait for: the slot of a simulation (`slot`), its states and what pages show of them (`simulation_record`), the queue and the shares of addresses and users (`slot_pool`), those that are reserved for the line of session servers (`reservations`), how many run in real time (`real_time_places`), the streams of simulations and the tokens that identify them (`stream`) |
//! | [`simulation::spare_wishes`] | which worlds are kept ready before clients ask for them, and how many; the actor that does it is `spare_keeper` in [`simulation::client`], a spare's slot is in `spare` of [`simulation::slots`] |
//! | `simulation::relay` | a stream between a client and the port of its Webots; what a watcher may send (`watcher`) |
//! | `simulation::web` | routes, pages (also the one on which an administrator watches a simulation: `page_routes`; its stream: see *watcher* below), `/status` and Prometheus metrics of the simulation server (gauges in `metrics`, counters and histograms in `app` and `ends`) |
//!
//! The HTML of pages is in `templates/session` and `templates/simulation` (in each, `monitor.html`: the head of the
//! monitor's table, `row.html`: a row), their styles (`style.css`) and scripts in `templates/assets`. A column of
//! `monitor.csv` appears in the charts (`charts.js` groups them by how their headings begin; the others are drawn in
//! percent); the figures above are in `glance.html`.
//!
//! Each server also has a directory `config` (keys: `session_config`, `simulation_config`; nested ones: the file of their group, such as `timing`;
//! `docs/configuration.md` lists all), its `app` (start and end) and its `state` (what its routes share). Files of
//! `simulation` are the [`protocol`](simulation::protocol) with the texts of messages to clients, which `client/session` sends (except the reason in
//! an error and the [`progress`](simulation::progress) of a start, which their causes define: a checkout's is in
//! `checkout/steps`), the `snapshot` of all simulations, the `simulation_id`, the `run_id` of a
//! process, the `simulated_time`, the `client_identity`, the `announcer` (key `notify`), `preflight`
//! (`--check`) and `readiness` (`/health`). The programs are in `src/bin`. Modules import only from layers below them,
//! in the order that `tests/project/layering.rs` lists. `session` and `simulation` never see each other. A child never
//! names its parent. The parent gives it a `Recipient` for the child's events, which the child's file defines.
//!
//! `tests/session` and `tests/simulation` test the programs as black boxes; the first lines of each file say what it tests.
//!
//! # Words
//!
//! - **session**: the [`simulation::client::Session`] of one simulation. The *session server* is the other program.
//! - **simulation**: what a client requests: a slot, a checkout, a Webots. It has an id.
//! - **slot**: a streaming port for one simulation, or the right to have one. Texts for users, keys and `/status` say *place*.
//! - **queue**: the clients that wait for a slot of one simulation server (its key is `waitingLine`).
//! - **line**: the clients that wait at a session server for a slot of the fleet. Each has a [`session::line::Place`] in
//!   it, which its **ticket** proves; a **pass** entitles it to one slot of one server.
//! - **connection**: a TCP connection or a WebSocket, never a slot (the key `maxConnections` has its name from the original).
//! - **client**: who holds a WebSocket of either server; **viewer**: who shows the stream of a Webots; **watcher**: an
//!   administrator who looks at the simulation of another (`web/page_routes` checks the password, `slots/stream` issues a
//!   token for one connection, `web/stream_routes` redeems it, `relay/watcher` lets it change nothing).
//! - **reason**: why a request was refused, a start has failed or a simulation has ended, as a code
//!   ([`shared::domain::Reason`]); a **failure** ([`shared::domain::Failure`]) has also its sentence and the output of others.
//! - **stage**: the state of a simulation as pages show it ([`shared::domain::Stage`]); `SimulationRecord` in [`simulation::slots`] derives it from its states.
//! - **spare**: a simulation that is kept ready without a client (key `ready`).
//! - **ready**: Webots has its world, so that viewers may connect. Until then it may **listen**.
//!
//! # Who talks to whom
//!
//! ```text
//! session server
//!
//!   routes ----------- Pick, GetStatus ------------> Registry --- Notice --> mailer --> SMTP
//!     | one per WebSocket                             ^  |  | one per simulation server
//!   WebClient ------- Pick, Wait ---------------------'  |  v
//!     |  ^                                               | ServerMonitor -- GET /status, /load --> simulation server
//!     |  '- availability (watch channel) -- Registry     |  |           <- WebSocket /slots --->
//!     |  '- LineEvent -- Registry                        |  '- Ask (Wishes) -- Registry
//!                                                        '-- ProbeResult, LinkEvent --> Registry
//!
//!   Mailers are tasks. The monitors share a thread of their own, so that clients never wait for them.
//!
//! simulation server
//!
//!   routes -- snapshot --> SlotPool <-- instances -- LoadMonitor --> monitor.csv
//!     | one per WebSocket   ^  |                     '-- Readings (watch channel) --> routes
//!   WebClient               |  |
//!     | one per simulation  |  |
//!   Session --- Slot ----------'  |
//!     ^  ^------- SlotEvent --'
//!     |  |--- checkout (clients of a world share the search for its commit; each copy has its own thread) --> git
//!     |  '--- starts ---> Webots (one per simulation) --> Webots' process group, in a sandbox
//!     '------ WebotsEvent ---'
//! ```
//!
//! The [`session::fleet::Registry`] alone decides availability: it receives every report and every pick. A
//! [`simulation::webots::Webots`] holds its process group, its instance directory and its slot in
//! guards. Dropping it frees all three, whatever its state, even after a panic. When the simulation server exits, for
//! whatever reason, its [`simulation::process::guardian`] process ends everything that the server has started.
//! One `simulation::isolation::DiskMonitor` enforces what the kernel does not: how much simulations write. One thread copies
//! all relayed streams except those of watchers.
//!
//! # What ends, and what restarts
//!
//! | actor or task | ends by itself | after a panic |
//! |---|---|---|
//! | Registry, `LoadMonitor`, `SpareKeeper` | never | the server logs it and exits with code 1: the service manager restarts it |
//! | `ServerMonitor` | when its server is removed from the configuration, or no name resolves to that server any more | the registry starts a new one |
//! | mailer | never | it is restarted; the notices that it held are lost |
//! | the tasks that look after slots, times and older processes (`simulation/app.rs`, `keep_up`) | never, or with the last older process | they are restarted |
//! | `WebClient` | with its connection | its connection closes, and it leaves the line, or its session is notified |
//! | `Session` | with its simulation, or its client | its slot is released, and its client is notified |
//! | Webots | with its process tree; it is never restarted, its client is notified | its process tree is killed at once, its directory removed, its slot released |
//!
//! The `SlotPool` is not an actor: a mutex guards it. [`shared::run::permanent::restarted`] restarts the tasks; after
//! more than five panics of one task, or of all monitors together, within a minute the server exits with code 1. So it
//! does after the first panic of a thread that it needs ([`shared::run::permanent::thread`]).
//!
//! # Facts about actix 0.13 that this relies on
//!
//! 1. After a panic in a handler the actor is dropped, not restarted, and every later message fails as 'closed'.
//! 2. When the system ends, an actor is dropped without `stopped`. Only `Drop` always runs.
//! 3. tokio's `kill_on_drop` reaches the direct child only; Webots' launcher has a child of its own.
//! 4. If a WebSocket's peer stops reading, the buffers fill, and from then on the connection's actor is no longer polled.
//!    The connection must be closed before that happens, see [`shared::http::liveness`].

pub mod session;
pub mod shared;
pub mod simulation;
