//! Configuration files of both servers.

use std::path::Path;

use webots_fleet::session::config::SessionConfig;
use webots_fleet::shared::config::{Configuration, load};
use webots_fleet::simulation::config::SimulationConfig;

#[test]
fn a_configuration_is_read_or_refused_in_one_line_whatever_is_in_it() {
    let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
    let file = folder.path().join("configuration.json");
    super::try_many(include_str!("seeds/configuration.txt"), |input| {
        std::fs::write(&file, input).unwrap();
        check::<SessionConfig>(&file);
        check::<SimulationConfig>(&file);
    });
}

fn check<C: Configuration>(file: &Path) {
    match load::<C>(file) {
        Ok(loaded) => {
            assert!(loaded.warnings.iter().all(|warning| super::is_one_line(warning)), "{:?}", loaded.warnings)
        }
        Err(told) => {
            assert!(told.contains("configuration.json") && super::is_one_line(&told), "{told}");
        }
    }
}
