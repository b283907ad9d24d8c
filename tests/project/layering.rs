//! The rules that the source keeps, so that a reader who knows them finds the way. Each test names all offenders.

use std::collections::{BTreeMap, BTreeSet};

use crate::source::{Source, sources};

/// Without inline tests.
const LONGEST_FILE: usize = 300;

/// An actor, or what holds addresses of actors.
fn is_about_actors(source: &Source) -> bool {
    ["impl Actor for", "Addr<", "Recipient<"].iter().any(|sign| source.shipped.contains(sign))
}

/// The floor that a module is on: it may name what is on its own floor or below. The pages of `status` are made of what
/// actors tell.
fn floor(source: &Source) -> usize {
    let module = source.module().unwrap_or_default();
    match module.split_once("::") {
        Some(("shared", _)) => 0,
        Some((_, "app")) => 4,
        Some((_, "routes" | "page_routes")) => 3,
        Some((_, "status" | "pages" | "asking")) => 2,
        _ if is_about_actors(source) => 2,
        _ => 1,
    }
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
        ("session::app", "session::routes"),
        ("session::routes", "session::registry"),
        ("simulation::web_client", "simulation::webots"),
        ("simulation::webots", "simulation::process_group"),
        ("simulation::config", "shared::config"),
    ] {
        assert!(map.imports[from].contains(to), "{from} names {to}, but only {:?} was found", map.imports[from]);
    }
}

#[test]
fn imports_point_down_only() {
    let map = Map::draw();
    let up = map.edges().filter(|(from, to)| floor(&map.sources[*from]) < floor(&map.sources[*to]));
    none("These name what is above them", up.map(|(from, to)| format!("{from} -> {to}")).collect());
}

#[test]
fn no_modules_name_each_other() {
    let map = Map::draw();
    let circles = map.edges().filter(|(from, to)| map.leads(to, from, &mut BTreeSet::new()));
    none("These are in a circle", circles.map(|(from, to)| format!("{from} -> {to}")).collect());
}

#[test]
fn the_servers_do_not_know_each_other_and_what_they_share_knows_neither() {
    let map = Map::draw();
    let room = |name: &str| name.split("::").next().unwrap().to_owned();
    let strangers = map.edges().filter(|(from, to)| room(to) != room(from) && room(to) != "shared");
    none("These look into another room", strangers.map(|(from, to)| format!("{from} -> {to}")).collect());
}

#[test]
fn a_child_does_not_know_its_parent() {
    let map = Map::draw();
    let families = [
        ("simulation::webots", "simulation::web_client"),
        ("simulation::places", "simulation::web_client"),
        ("session::server_monitor", "session::registry"),
        ("session::registry", "session::web_client"),
        ("session::mailer", "session::registry"),
    ];
    let bad = families.iter().filter(|(child, parent)| map.leads(child, parent, &mut BTreeSet::new()));
    none("These know their parent", bad.map(|(child, parent)| format!("{child} -> {parent}")).collect());
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
fn a_file_has_one_actor_at_most_and_is_not_long() {
    let (mut crowded, mut long) = (Vec::new(), Vec::new());
    for source in sources() {
        if source.shipped.matches("impl Actor for").count() > 1 {
            crowded.push(source.path.clone());
        }
        if source.lines > LONGEST_FILE {
            long.push(format!("{}: {} lines", source.path, source.lines));
        }
    }
    none("These have several actors", crowded);
    none(&format!("These have more than {LONGEST_FILE} lines without their tests"), long);
}

#[test]
fn a_mod_rs_is_a_front_page_without_code() {
    let mut bad = Vec::new();
    for source in sources().iter().filter(|source| source.path.ends_with("/mod.rs") || source.path == "src/lib.rs") {
        for statement in source.shipped.split(';').map(str::trim).filter(|statement| !statement.is_empty()) {
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
