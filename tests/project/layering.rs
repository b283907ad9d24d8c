//! The rules that the source keeps, so that a reader who knows them finds the way. Each test names all offenders.

use std::collections::{BTreeMap, BTreeSet};

use regex::Regex;

use super::copy::{root, walk};

/// The rooms of the library from the bottom to the top: files and folders. Each may name those before it, and what is in
/// it. `session` and `simulation` don't see each other.
const SHARED: [&str; 5] = ["shared::text", "shared::config", "shared::domain", "shared::run", "shared::http"];
const SESSION: [&str; 8] = [
    "session::placement",
    "session::config",
    "session::announcements",
    "session::mail",
    "session::fleet",
    "session::state",
    "session::web",
    "session::app",
];
const SIMULATION: [&str; 23] = [
    "simulation::client_identity",
    "simulation::simulation_id",
    "simulation::snapshot",
    "simulation::ends",
    "simulation::failed_starts",
    "simulation::sessions",
    "simulation::slots",
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

/// A source file.
struct Source {
    /// Path below the project's folder.
    path: String,
    /// The text as it stands, and without comments and inline tests.
    text: String,
    shipped: String,
}

/// All files below `src`.
fn sources() -> Vec<Source> {
    let tests = Regex::new(r"(?s)#\[cfg\(test\)\]\nmod tests \{.*?\n\}\n|(?m-s:^ *//.*\n)").unwrap();
    let files = walk(&root().join("src")).into_iter().filter(|path| path.extension().is_some_and(|end| end == "rs"));
    let source = |file: std::path::PathBuf| {
        let text = std::fs::read_to_string(&file).unwrap();
        let path = file.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
        Source { path, shipped: tests.replace_all(&text, "").into_owned(), text }
    };
    files.map(source).collect()
}

/// What each module of the library names: `simulation::webots` and the like, with programs left out.
fn imports() -> BTreeMap<String, BTreeSet<String>> {
    let module = |source: &Source| {
        let inside = source.path.strip_prefix("src/")?.strip_suffix(".rs")?;
        let inside = inside.strip_suffix("/mod").unwrap_or(inside);
        (!inside.starts_with("bin/") && inside != "lib").then(|| inside.replace('/', "::"))
    };
    let all: BTreeMap<String, Source> =
        sources().into_iter().filter_map(|source| Some((module(&source)?, source))).collect();
    // A path, and the names that it ends in if these are in braces.
    let paths = Regex::new(r"\b(crate|super)((?:::\w+)*)(?:::\{([^{}]*)\})?").unwrap();
    let named = |(name, source): (&String, &Source)| {
        assert!(!source.shipped.contains("super::super"), "{name}: longer ways begin with crate");
        let parent = name.rsplit_once("::").map_or("", |(parent, _)| parent);
        let named = paths.captures_iter(&source.shipped).flat_map(|found| {
            let text = |group| found.get(group).map_or("", |text| text.as_str());
            let begin = if text(1) == "super" { parent } else { "" };
            let path = format!("{begin}{}", text(2)).trim_start_matches("::").to_owned();
            text(3).split(',').map(|last| format!("{path}::{}", last.trim())).collect::<Vec<_>>()
        });
        let longest = |path: String| {
            let ends = path.match_indices("::").map(|(end, _)| end).chain([path.len()]);
            ends.map(|end| &path[..end]).filter(|module| all.contains_key(*module)).last().map(str::to_owned)
        };
        (name.clone(), named.filter_map(longest).filter(|module| module != name).collect())
    };
    let imports: BTreeMap<_, BTreeSet<String>> = all.iter().map(named).collect();
    assert!(imports["simulation::ends::ends"].contains("simulation::ends::csv"), "imports are found");
    assert!(imports["session::web::routes"].contains("session::fleet"), "imports are found");
    imports
}

/// The room of a module, none for `session`, `simulation` and `shared` as a whole.
fn room(module: &str) -> Option<&'static str> {
    let mut rooms = SHARED.into_iter().chain(SESSION).chain(SIMULATION);
    rooms.find(|room| module == *room || module.strip_prefix(room).is_some_and(|rest| rest.starts_with("::")))
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

fn none(what: &str, offenders: Vec<String>) {
    assert!(offenders.is_empty(), "{what}:\n  {}\n", offenders.join("\n  "));
}

#[test]
fn imports_point_down_only() {
    let imports = imports();
    let homeless = imports.keys().filter(|name| name.contains("::") && room(name).is_none());
    none("These are in no room", homeless.cloned().collect());
    let edges = imports.iter().flat_map(|(from, all)| all.iter().map(move |to| (from, to)));
    let bad = edges.filter(|(from, to)| room(from).zip(room(to)).is_some_and(|(from, to)| !may_name(from, to)));
    none("These name what is above them, or another server", bad.map(|(from, to)| format!("{from} -> {to}")).collect());
}

#[test]
fn no_modules_name_each_other() {
    let mut imports = imports();
    // Those that name nothing that is left can be in no circle.
    while let Some(free) = imports.iter().find(|(_, names)| names.is_empty()).map(|(name, _)| name.clone()) {
        imports.remove(&free);
        for names in imports.values_mut() {
            names.remove(&free);
        }
    }
    none("These are in a circle, or name one", imports.into_keys().collect());
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
        let pure = placement || source.text.lines().any(|line| line.starts_with("//!") && line.contains("Pure"));
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
