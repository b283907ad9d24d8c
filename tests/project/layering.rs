//! The rules for the structure of the source. Each test names all offenders.

use std::collections::{BTreeMap, BTreeSet};

use regex_lite::Regex;

use super::copy::{root, walk};

/// The layers of each part of the library, from bottom to top: files and folders. Each may import from itself and from
/// layers before it; those of `session` and `simulation` also from all of `shared`, but never from each other.
const ROOMS: [(&str, &str); 3] = [
    ("shared", "text config domain run http"),
    ("session", "placement line config mail class fleet state web app"),
    (
        "simulation",
        "client_identity run_id simulated_time simulation_id snapshot ends attachment slots spare_wishes relay progress protocol process machine config checkout \
         isolation container readiness preflight announcer webots handover state upgrade client web app",
    ),
];

/// All files below `src`: the path, the text, and the text without comments and inline tests.
fn sources() -> Vec<(String, String, String)> {
    let tests = Regex::new(r"(?s)#\[cfg\(test\)\]\nmod tests \{.*?\n\}\n|(?m-s:^ *//.*\n)").unwrap();
    let files = walk(&root().join("src"))
        .into_iter()
        .filter(|path| path.extension().is_some_and(|end| end == "rs"));
    files
        .map(|file| {
            let text = std::fs::read_to_string(&file).unwrap();
            let path = file.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
            let shipped = tests.replace_all(&text, "").into_owned();
            (path, text, shipped)
        })
        .collect()
}

/// The modules that each module imports, such as `simulation::webots` or, of a program, `bin::rehearse::visit`.
fn imports() -> BTreeMap<String, BTreeSet<String>> {
    let module = |path: &str| {
        let inside = path.strip_prefix("src/")?.strip_suffix(".rs")?;
        let inside = inside.strip_suffix("/mod").unwrap_or(inside);
        (inside != "lib").then(|| inside.replace('/', "::"))
    };
    let all: BTreeMap<String, String> = sources()
        .into_iter()
        .filter_map(|(path, _, shipped)| Some((module(&path)?, shipped)))
        .collect();
    // A path, and the names in braces at its end.
    let paths = Regex::new(r"\b(crate|super)((?:::\w+)*)(?:::\{([^{}]*)\})?").unwrap();
    let named = |(name, shipped): (&String, &String)| {
        assert!(
            !shipped.contains("super::super"),
            "{name}: longer ways begin with crate"
        );
        let parent = name.rsplit_once("::").map_or("", |(parent, _)| parent);
        let root = if name.starts_with("bin::") { parent } else { "" };
        let named = paths.captures_iter(shipped).flat_map(|found| {
            let text = |group| found.get(group).map_or("", |text| text.as_str());
            let begin = if text(1) == "super" { parent } else { root };
            let path = format!("{begin}{}", text(2)).trim_start_matches("::").to_owned();
            text(3)
                .split(',')
                .map(|last| format!("{path}::{}", last.trim()))
                .collect::<Vec<_>>()
        });
        let longest = |path: String| {
            let ends = path.match_indices("::").map(|(end, _)| end).chain([path.len()]);
            ends.map(|end| &path[..end])
                .filter(|module| all.contains_key(*module))
                .last()
                .map(str::to_owned)
        };
        (
            name.clone(),
            named.filter_map(longest).filter(|module| module != name).collect(),
        )
    };
    let imports: BTreeMap<_, BTreeSet<String>> = all.iter().map(named).collect();
    assert!(
        imports["simulation::ends::ends"].contains("simulation::ends::csv"),
        "imports are found"
    );
    assert!(
        imports["session::web::status"].contains("session::fleet"),
        "imports are found"
    );
    assert!(
        imports["bin::rehearse::browser"].contains("bin::rehearse::connection"),
        "imports are found"
    );
    imports
}

/// The part and the layer number of a module; `None` for a part as a whole.
fn room(module: &str) -> Option<(&'static str, usize)> {
    let (part, inside) = module.split_once("::")?;
    let (part, rooms) = ROOMS.iter().find(|(name, _)| *name == part)?;
    let floor = rooms
        .split(' ')
        .position(|room| Some(room) == inside.split("::").next())?;
    Some((part, floor))
}

fn may_name(from: (&str, usize), to: (&str, usize)) -> bool {
    if from.0 == to.0 {
        from.1 >= to.1
    } else {
        to.0 == "shared"
    }
}

#[test]
fn imports_point_down_only() {
    let imports = imports();
    let homeless: Vec<_> = imports
        .keys()
        .filter(|name| name.contains("::") && !name.starts_with("bin::") && room(name).is_none())
        .collect();
    assert!(homeless.is_empty(), "in no room: {homeless:#?}");
    let edges = imports
        .iter()
        .flat_map(|(from, all)| all.iter().map(move |to| (from, to)));
    let is_bad =
        |(from, to): &(&String, &String)| room(from).zip(room(to)).is_some_and(|(from, to)| !may_name(from, to));
    let bad: Vec<_> = edges.filter(is_bad).collect();
    assert!(
        bad.is_empty(),
        "these name what is above them, or another server: {bad:#?}"
    );
}

#[test]
fn no_modules_name_each_other() {
    let mut imports = imports();
    // Modules that import none of the remaining ones can't be part of a cycle.
    while let Some(free) = imports
        .iter()
        .find(|(_, names)| names.is_empty())
        .map(|(name, _)| name.clone())
    {
        imports.remove(&free);
        imports
            .values_mut()
            .for_each(|names| names.retain(|name| *name != free));
    }
    assert!(
        imports.is_empty(),
        "these are in a circle, or name one: {:#?}",
        imports.keys()
    );
}

#[test]
fn no_file_has_what_its_place_forbids() {
    let impure = r"tokio|std::fs|std::net::Tcp|std::process|Instant::now\(|SystemTime::now\(";
    // A pattern of files, by their path or a line of their `//!`, and a pattern that their code must not contain.
    let rules = [
        ("^src/bin/demo_simulator/", "webots_fleet"),
        ("^src/(bin/[^d]|lib|shared|session|simulation)", "(?i)demo"),
        ("^//!.*Pure", impure),
        ("^src/session/placement/", &format!("actix|{impure}")),
        (r"\.rs$", "(?s)impl Actor for.*impl Actor for"),
        // A front page, without code.
        (
            r"(/mod|^src/lib)\.rs$",
            r"(?m)\*|^ *(pub(\([a-z]+\))? )?((async|unsafe|const) )*(fn|struct|enum|trait|impl|const|static|type|macro_rules)\b|!\(",
        ),
    ];
    for (files, forbidden) in rules {
        let files = Regex::new(files).unwrap();
        let forbidden = Regex::new(forbidden).unwrap();
        for (path, text, shipped) in sources() {
            let head = text.lines().take_while(|line| line.starts_with("//!"));
            let is_meant = head.chain([path.as_str()]).any(|line| files.is_match(line));
            let found = forbidden.find(&shipped).filter(|_| is_meant);
            assert!(found.is_none(), "{path} has {found:?}");
        }
    }
}
