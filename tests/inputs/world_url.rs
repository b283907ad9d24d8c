//! The URL of a world: no path outside of the repository, no option of git, nothing that a shell or a page would run.

use webots_fleet::shared::domain::ProjectUrl;

#[test]
fn a_world_is_inside_of_its_repository_whatever_its_url_says() {
    super::try_many(include_str!("seeds/world_url.txt"), |input| {
        let text = String::from_utf8_lossy(input);
        match ProjectUrl::parse(&text) {
            Ok(world) => is_safe(&world),
            Err(wrong) => {
                let told = wrong.to_string();
                assert!(told.starts_with("Wrong Webots simulation URL: "), "{told}");
            }
        }
    });
}

fn is_safe(world: &ProjectUrl) {
    for segment in world.segments() {
        assert!(!segment.is_empty() && segment != "." && segment != "..", "{world:?}");
        assert!(!segment.contains(['/', '\\']) && super::is_one_line(segment), "{world:?}");
    }
    assert!(!world.host().starts_with('-') && !world.host().contains(['/', '@', ' ', '\\']), "{world:?}");
    assert!(world.repository().starts_with("https://"), "{world:?}");
    assert!(world.world().to_ascii_lowercase().ends_with(".wbt"), "{world:?}");
    let inside = world.candidates();
    assert!(!inside.is_empty(), "{world:?}");
    for reading in inside {
        assert!(!reading.folder.starts_with('/') && !reading.folder.split('/').any(|name| name == ".git"), "{world:?}");
    }
}
