//! Repositories that have moved: redirects are followed within their Git host, and only to repositories that the lists
//! allow.
//!
//! Redirects are off in git. On a redirect, git's trace has the `Location` header, and the world is resolved there, so that
//! the lists, and git's settings for proxies, certificates and passwords, apply to each step. Pure.

use url::Url;

use crate::shared::domain::{AdmissionRules, Failure, Load, ProjectUrl, Reason};
use crate::simulation::config::{Mirrors, Remote};

/// Limit of redirects for a world.
pub const MAX_REDIRECTS: usize = 5;

/// The world in the repository to which its Git host redirects, and the remote of that repository.
///
/// # Errors
/// When the redirect may not be followed.
pub fn follow(
    location: Option<&str>,
    (mirrors, rules): (&Mirrors, &AdmissionRules),
    world: &ProjectUrl,
) -> Result<(ProjectUrl, Remote), Failure> {
    let target = match location {
        Some(location) => target(mirrors, rules, world, location),
        None => Err("to where its Git host does not say".to_owned()),
    };
    let target = target.map_err(|why| {
        let message = format!("{} has moved {why}", world.repository());
        Failure::new(Reason::RepositoryMoved, message)
    })?;
    log::info!("{} is at {}", world.repository(), target.1.location);
    Ok(target)
}

/// The world in the repository at this location, or why the redirect is not followed, as text for the client.
fn target(
    mirrors: &Mirrors,
    rules: &AdmissionRules,
    world: &ProjectUrl,
    location: &str,
) -> Result<(ProjectUrl, Remote), String> {
    let no_url = |_| format!("to {location:?}, which is no URL");
    let remote = mirrors.remote(world).map(|remote| remote.location).unwrap_or_default();
    let remote = Url::parse(&remote).map_err(no_url)?;
    let mut target = remote.join(location).map_err(no_url)?;
    if target.origin() != remote.origin() || !target.username().is_empty() || target.password().is_some() {
        return Err("to another host. Redirects to other hosts are not followed: give its new URL".to_owned());
    }
    target.set_query(None);
    target.set_fragment(None);
    let elsewhere = || format!("to {target}, from where this simulation server takes no worlds");
    // The first path that git requests.
    let repository = target.as_str().strip_suffix("/info/refs").ok_or_else(elsewhere)?;
    let moved = mirrors.moved(world, repository).ok_or_else(elsewhere)?;
    rules
        .admit(&moved, Load::ZERO)
        .map_err(|refusal| format!("to {}. {refusal}", moved.repository()))?;
    Ok((
        moved,
        Remote {
            location: repository.to_owned(),
            protocol: "https",
        },
    ))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::shared::domain::UrlPrefix;

    #[test]
    fn a_forge_is_followed_within_itself_and_where_the_lists_allow() {
        let mirrors = BTreeMap::from([
            ("https://git.lab/".to_owned(), "https://git.lab:8443/".to_owned()),
            (
                "https://git.lab/one".to_owned(),
                "https://git.lab:8443/lab/one.git".to_owned(),
            ),
        ]);
        let mirrors = Mirrors::try_from(mirrors).unwrap();
        let prefixes = |texts: &[&str]| {
            texts
                .iter()
                .map(|text| UrlPrefix::try_from((*text).to_owned()).unwrap())
                .collect()
        };
        let allowed = prefixes(&["https://github.com/lab", "https://git.lab"]);
        let blocked = prefixes(&["https://github.com/lab/secret"]);
        let rules = AdmissionRules {
            allowed,
            blocked,
            docker: false,
            share_idle_time: 0.0,
        };
        let old = "https://github.com/lab/old/blob/main/p/worlds/a.wbt";
        let mirrored = "https://git.lab/g/s/old/-/blob/main/worlds/a.wbt";
        let table = [
            (
                old,
                "https://github.com/lab/new.git/info/refs?service=git-upload-pack",
                Ok("https://github.com/lab/new/blob/main/p/worlds/a.wbt"),
            ),
            (
                old,
                "/lab/new/info/refs",
                Ok("https://github.com/lab/new/blob/main/p/worlds/a.wbt"),
            ),
            (old, "https://github.com/lab/secret.git/info/refs", Err("blocked")),
            (old, "https://github.com/lab/Secret/info/refs", Err("blocked")),
            (old, "https://github.com/lab%2fsecret/info/refs", Err("takes no worlds")),
            (old, "https://github.com/other/new/info/refs", Err("Docker not enabled")),
            (
                old,
                "https://github.com/lab/../other/new/info/refs",
                Err("Docker not enabled"),
            ),
            (old, "https://github.com/login", Err("takes no worlds")),
            (old, "https://gitlab.com/lab/new/info/refs", Err("another host")),
            (old, "http://github.com/lab/new/info/refs", Err("another host")),
            (old, "https://github.com:8443/lab/new/info/refs", Err("another host")),
            (old, "https://me@github.com/lab/new/info/refs", Err("another host")),
            (old, "https://", Err("no URL")),
            (
                mirrored,
                "https://git.lab:8443/g/new/info/refs",
                Ok("https://git.lab/g/new/-/blob/main/worlds/a.wbt"),
            ),
            (
                mirrored,
                "https://git.lab:8443/g/s/old.git/info/refs",
                Ok("https://git.lab/g/s/old/-/blob/main/worlds/a.wbt"),
            ),
            (mirrored, "https://git.lab:8443/one/info/refs", Err("takes no worlds")),
        ];
        for (world, location, expected) in table {
            let found = target(&mirrors, &rules, &ProjectUrl::parse(world).unwrap(), location);
            match (found, expected) {
                (Ok((found, _)), Ok(expected)) => assert_eq!(found.to_string(), expected, "{location}"),
                (Err(why), Err(words)) => assert!(why.contains(words), "{location}: {why}"),
                (found, _) => panic!("{location}: {found:?}"),
            }
        }
    }
}
