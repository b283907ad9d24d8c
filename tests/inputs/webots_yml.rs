//! `webots.yml` of a project.

use std::path::Component;

use webots_fleet::simulation::container::{ProjectKind, WebotsYml};

#[test]
fn a_project_asks_for_nothing_outside_of_itself_whatever_is_in_its_webots_yml() {
    super::try_many(include_str!("seeds/webots_yml.txt"), |input| {
        // Each example is a line of its file.
        let text = String::from_utf8_lossy(input).replace("\\n", "\n").replace("\\r", "\r");
        let found = WebotsYml::parse(&text);
        assert!(found.warnings.iter().all(|warning| super::is_one_line(warning)), "{:?}", found.warnings);
        if let Some(message) = &found.project_type {
            let line = message.strip_suffix('\n').unwrap();
            assert!(super::is_one_line(line) && line.starts_with("type:") && line.len() <= 200, "{message:?}");
        }
        if found.kind != ProjectKind::Default {
            let folder = &found.folder;
            assert!(folder.starts_with("webots-project") && super::is_one_line(folder), "{folder:?}");
            assert!(!folder.contains([':', '$', '\\', '"', '\'', '`', '#']), "{folder:?}");
            let inside = found.folder_in_project();
            assert!(inside.components().all(|part| matches!(part, Component::Normal(_))), "{inside:?}");
        }
    });
}
