//! What a simulation server answers, or whatever is listed as one.

use webots_fleet::shared::domain::{Load, ProjectUrl, ServerReport};

#[test]
fn a_report_is_a_load_and_short_lines_whatever_a_server_answers() {
    let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap();
    super::try_many(include_str!("seeds/report.txt"), |input| {
        let Ok(report) = ServerReport::parse(input) else {
            return;
        };
        assert!(report.load.percent().is_finite() && report.load.percent() >= 0.0, "{report:?}");
        assert!(super::is_one_line(&report.version), "{report:?}");
        assert!(report.problem.as_deref().is_none_or(super::is_one_line), "{report:?}");
        if let Some(instances) = report.instances {
            assert!(instances.present() >= instances.running, "{report:?}");
        }
        // It answers, whatever the rules are.
        std::hint::black_box(report.accepts(&world));
        let again = serde_json::to_vec(&report).unwrap();
        assert!(ServerReport::parse(&again).is_ok(), "{report:?}");
    });
}

#[test]
fn a_load_is_a_number_from_0_whatever_a_server_answers() {
    super::try_many(include_str!("seeds/load.txt"), |input| {
        if let Ok(load) = Load::parse(input) {
            assert!(load.percent().is_finite() && load.percent() >= 0.0, "{load:?}");
        }
    });
}
