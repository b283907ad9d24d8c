//! Why no simulation server is chosen for a client. Pure.

use super::server_record::{ServerRecord, ServerState};
use crate::shared::domain::{Failure, Load, ProjectUrl, Reason};

/// From the one that may change soonest: the fleet refuses a client for the first that applies to one of its servers.
const PRECEDENCE: [Reason; 4] = [
    Reason::NoServerAvailable,
    Reason::NoIdleTime,
    Reason::RepositoryNotAllowed,
    Reason::RepositoryBlocked,
];

/// Why none of these servers takes a client for this world, if it names one. Each has its effective load, if that is
/// known.
///
/// A server that has never answered does not count, because it may never answer; one that has not been probed yet may
/// accept the world.
pub fn refusal<'record>(
    servers: impl Iterator<Item = (&'record ServerRecord, Option<Load>)>,
    world: Option<&ProjectUrl>,
) -> Failure {
    let Some(world) = world else {
        return failure(Reason::NoServerAvailable, None);
    };
    let reasons: Vec<Reason> = servers
        .filter_map(|(server, load)| match (&server.state, server.state.last_answer()) {
            (_, Some(answer)) => {
                let report = &answer.report;
                let refused = report.check(world, load.unwrap_or(report.load)).err();
                Some(refused.unwrap_or(Reason::NoServerAvailable))
            }
            (ServerState::Unknown, None) => Some(Reason::NoServerAvailable),
            (_, None) => None,
        })
        .collect();
    let first = PRECEDENCE.into_iter().find(|reason| reasons.contains(reason));
    failure(first.unwrap_or(Reason::NoServerAvailable), Some(world))
}

/// The texts are those of the protocol.
fn failure(reason: Reason, world: Option<&ProjectUrl>) -> Failure {
    let repository = world.map(ProjectUrl::repository);
    let message = match (reason, repository) {
        (Reason::RepositoryNotAllowed | Reason::RepositoryBlocked, Some(repository)) => {
            format!("no simulation server accepts {repository}")
        }
        (Reason::NoIdleTime, Some(repository)) => format!(
            "no simulation server available at the moment: those that run worlds of {repository} in idle time are busy"
        ),
        _ => "no simulation server available at the moment".to_owned(),
    };
    Failure::new(reason, message)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::time::{Duration, Instant};

    use super::*;
    use crate::session::fleet::server_record::Answer;
    use crate::shared::domain::ServerReport;

    fn record(report: Option<&str>) -> ServerRecord {
        let mut record = ServerRecord::new("host:2000".parse().unwrap());
        if let Some(report) = report {
            let answer = Answer {
                report: Arc::new(ServerReport::parse(report.as_bytes()).unwrap()),
                at: Instant::now(),
                latency: Duration::ZERO,
            };
            record.answered(answer, 95.0);
        }
        record
    }

    fn down() -> ServerRecord {
        let mut record = record(None);
        record.failed(Failure::new(Reason::NoAnswer, "broken"), Duration::ZERO);
        record
    }

    #[test]
    fn the_reason_is_the_one_that_may_change_soonest() {
        let world = ProjectUrl::parse("https://github.com/lab/arm/blob/main/worlds/a.wbt").unwrap();
        let takes_all = || record(Some(r#"{"load": 99}"#));
        let refuses = || record(Some(r#"{"load": 1, "docker": false}"#));
        let blocks = || {
            record(Some(
                r#"{"load": 1, "blockedRepositories": ["https://github.com/lab"]}"#,
            ))
        };
        let busy = || record(Some(r#"{"load": 60, "docker": true, "shareIdleTime": 50}"#));
        let table = [
            (vec![], Reason::NoServerAvailable),
            (vec![down()], Reason::NoServerAvailable),
            (vec![record(None), refuses()], Reason::NoServerAvailable),
            (vec![refuses(), takes_all()], Reason::NoServerAvailable),
            (vec![down(), refuses(), blocks()], Reason::RepositoryNotAllowed),
            (vec![blocks()], Reason::RepositoryBlocked),
            (vec![refuses(), busy()], Reason::NoIdleTime),
        ];
        for (servers, expected) in table {
            let loads = servers.iter().map(|server| (server, None));
            assert_eq!(refusal(loads, Some(&world)).reason, expected, "{servers:?}");
            let loads = servers.iter().map(|server| (server, None));
            assert_eq!(refusal(loads, None).reason, Reason::NoServerAvailable);
        }
        let idle = record(Some(r#"{"load": 40, "docker": true, "shareIdleTime": 50}"#));
        let burst = std::iter::once((&idle, Some(Load::try_from(51.0).unwrap())));
        assert_eq!(
            refusal(burst, Some(&world)).reason,
            Reason::NoIdleTime,
            "a burst between two reports"
        );
    }
}
