//! A small part of `cargo bench --bench placement`, so that a change that worsens the policy fails the tests.

#[path = "../benches/placement/compare.rs"]
mod compare;
#[path = "../benches/placement/dispatch.rs"]
mod dispatch;
#[path = "../benches/placement/scenario.rs"]
mod scenario;
#[path = "../benches/placement/world.rs"]
mod world;

#[test]
fn a_black_hole_takes_few_clients() {
    for fails_after in [0.5, 40.0] {
        for scenario in compare::hole_scenarios(&[5], fails_after) {
            let [with, without] = compare::share_that_fails(&scenario);
            println!(
                "{:?}, failing after {fails_after} s: {with:.1} % fail, {without:.1} % without ejection",
                scenario.arrivals
            );
            assert!(
                with < without / 2.0,
                "{scenario:?}: {with:.1} % fail with ejection, {without:.1} % without"
            );
        }
    }
}

#[test]
fn no_rival_is_better_in_a_small_fleet() {
    let mut level = compare::scenarios(&[5], &[3.0]);
    level.retain(|one| one.sizes == scenario::Sizes::Equal && one.sessions == scenario::Sessions::Exponential);
    for scenario in level.into_iter().chain(compare::foreign_scenarios(&[5])) {
        let row = compare::compare(&scenario);
        for (policy, name) in compare::POLICIES.iter().enumerate().take(compare::FIRST_RIVAL) {
            // The policy that knows only loads assumes equal servers and no other programs on them.
            if policy == 0 || scenario.foreign == scenario::Foreign::None {
                assert_eq!(
                    compare::better_rivals(&row, policy),
                    Vec::<String>::new(),
                    "{name}: {scenario:?}"
                );
            }
        }
    }
}
