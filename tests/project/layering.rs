//! The rules that the source keeps, so that a reader who knows them finds the way. Each test names all offenders.

use std::collections::{BTreeMap, BTreeSet};

use super::source::{Source, sources};

/// The rooms of the library from the bottom to the top: files and folders. Each may name those before it, and what is in
/// it. `session` and `simulation` don't see each other.
const SHARED: [&str; 5] = ["shared::text", "shared::config", "shared::domain", "shared::run", "shared::http"];
const SESSION: [&str; 8] = [
    "session::mail_address",
    "session::placement",
    "session::config",
    "session::mail",
    "session::fleet",
    "session::state",
    "session::web",
    "session::app",
];
const SIMULATION: [&str; 23] = [
    "simulation::simulation_id",
    "simulation::ends",
    "simulation::snapshot",
    "simulation::failed_starts",
    "simulation::places",
    "simulation::sessions",
    "simulation::streams",
    "simulation::relay",
    "simulation::protocol",
    "simulation::process",
    "simulation::machine",
    "simulation::checkout",
    "simulation::config",
    "simulation::isolation",
    "simulation::container",
    "simulation::preflight",
    "simulation::announcer",
    "simulation::webots",
    "simulation::readiness",
    "simulation::state",
    "simulation::client",
    "simulation::web",
    "simulation::app",
];

/// The room of a module, none for `session`, `simulation` and `shared` as a whole.
fn room(module: &str) -> Option<&'static str> {
    let rooms = SHARED.into_iter().chain(SESSION).chain(SIMULATION);
    rooms
        .into_iter()
        .find(|room| module == *room || module.strip_prefix(room).is_some_and(|rest| rest.starts_with("::")))
}

/// Whether what is in one room may name what is in another.
fn may_name(from: &str, to: &str) -> bool {
    let is_below = |tower: &[&str]| {
        let floor = |room| tower.iter().position(|one| *one == room);
        floor(from).zip(floor(to)).is_some_and(|(from, to)| from > to)
    };
    let lands_on_shared = !from.starts_with("shared::") && to.starts_with("shared::");
    from == to || lands_on_shared || is_below(&SHARED) || is_below(&SESSION) || is_below(&SIMULATION)
}

/// What each module of the library names.
struct Map {
    sources: BTreeMap<String, Source>,
    imports: BTreeMap<String, BTreeSet<String>>,
}

impl Map {
    fn draw() -> Self {
        let sources: BTreeMap<String, Source> =
            sources().into_iter().filter_map(|source| Some((source.module()?, source))).collect();
        let modules = sources.keys().cloned().collect();
        let imports = sources.iter().map(|(name, source)| (name.clone(), source.imports(&modules))).collect();
        Self { sources, imports }
    }

    fn edges(&self) -> impl Iterator<Item = (&str, &str)> {
        self.imports.iter().flat_map(|(from, all)| all.iter().map(move |to| (from.as_str(), to.as_str())))
    }

    /// Whether one module names another, be it through others.
    fn leads(&self, from: &str, to: &str, seen: &mut BTreeSet<String>) -> bool {
        self.imports[from].iter().any(|next| next == to || (seen.insert(next.clone()) && self.leads(next, to, seen)))
    }
}

fn none(what: &str, offenders: Vec<String>) {
    assert!(offenders.is_empty(), "{what}:\n  {}\n", offenders.join("\n  "));
}

#[test]
fn imports_are_found_at_all() {
    let map = Map::draw();
    for (from, to) in [
        ("session::app", "session::web"),
        ("session::web::routes", "session::fleet"),
        ("simulation::client::start", "simulation::webots"),
        ("simulation::webots::webots", "simulation::webots::output"),
        ("simulation::config::simulation_config", "shared::config"),
    ] {
        assert!(map.imports[from].contains(to), "{from} names {to}, but only {:?} was found", map.imports[from]);
    }
}

#[test]
fn every_module_is_in_a_room() {
    let map = Map::draw();
    let homeless = map.sources.keys().filter(|name| name.contains("::") && room(name).is_none());
    none("These are in no room", homeless.cloned().collect());
}

#[test]
fn imports_point_down_only() {
    let map = Map::draw();
    let bad = map.edges().filter(|(from, to)| room(from).zip(room(to)).is_some_and(|(from, to)| !may_name(from, to)));
    none("These name what is above them, or another server", bad.map(|(from, to)| format!("{from} -> {to}")).collect());
}

#[test]
fn no_modules_name_each_other() {
    let map = Map::draw();
    let circles = map.edges().filter(|(from, to)| map.leads(to, from, &mut BTreeSet::new()));
    none("These are in a circle", circles.map(|(from, to)| format!("{from} -> {to}")).collect());
}

#[test]
fn a_child_does_not_know_its_parent() {
    let map = Map::draw();
    let (child, parent) = ("session::fleet::server_monitor", "session::fleet::registry");
    assert!(!map.leads(child, parent, &mut BTreeSet::new()), "{child} knows {parent}");
}

#[test]
fn the_demo_simulator_and_the_servers_know_nothing_of_each_other() {
    let (mut demo, mut servers) = (Vec::new(), Vec::new());
    for source in sources() {
        if source.path.starts_with("src/bin/demo_simulator/") {
            if source.shipped.contains("webots_fleet") {
                demo.push(source.path);
            }
        } else if source.shipped.to_lowercase().contains("demo") {
            servers.push(source.path);
        }
    }
    none("These of the demo simulator name the servers", demo);
    none("These of the servers name the demo", servers);
}

#[test]
fn what_is_called_pure_is() {
    let impure = ["tokio", "std::fs", "std::net::Tcp", "std::process", "Instant::now(", "SystemTime::now("];
    let mut bad = Vec::new();
    for source in sources() {
        let placement = source.path.starts_with("src/session/placement/");
        let pure = placement || source.purpose().contains("Pure");
        let words = impure.iter().filter(|_| pure).chain(["actix"].iter().filter(|_| placement));
        for word in words.filter(|word| source.shipped.contains(**word)) {
            bad.push(format!("{}: {word}", source.path));
        }
    }
    none("These are called pure", bad);
}

#[test]
fn a_file_has_one_actor_at_most() {
    let crowded = sources().into_iter().filter(|source| source.shipped.matches("impl Actor for").count() > 1);
    none("These have several actors", crowded.map(|source| source.path).collect());
}

#[test]
fn a_mod_rs_is_a_front_page_without_code() {
    let mut bad = Vec::new();
    for source in sources().iter().filter(|source| source.path.ends_with("/mod.rs") || source.path == "src/lib.rs") {
        let statements = source.shipped.lines().filter(|line| !line.starts_with("#![")).collect::<String>();
        for statement in statements.split(';').map(str::trim).filter(|statement| !statement.is_empty()) {
            let listed =
                ["mod ", "pub mod ", "pub use ", "pub(crate) mod "].iter().any(|word| statement.starts_with(word));
            if !listed || statement.contains('*') {
                bad.push(format!("{}: {statement}", source.path));
            }
        }
    }
    none("These are more than a list of modules", bad);
}

#[test]
fn some_words_do_not_occur_in_what_ships() {
    let words = [
        ("</", "pages are in templates"),
        ("cfg!(test", "tests run what ships"),
        (".unwrap()", "nothing that ships panics"),
    ];
    let mut bad = Vec::new();
    for source in sources() {
        for (line, text) in source.shipped.lines().enumerate() {
            for (word, why) in words.iter().filter(|(word, _)| text.contains(word)) {
                bad.push(format!("{} ({} lines in): {word:?}, but {why}", source.path, line + 1));
            }
        }
    }
    none("These have words that they should not", bad);
}
