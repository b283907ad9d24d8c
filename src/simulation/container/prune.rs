//! Removes images of this server that were not used for long, or are too many.

use std::collections::HashMap;
use std::time::{Duration, SystemTime};

use bytesize::ByteSize;

use super::docker::{DockerError, SHORT};
use super::dockerfile::LABEL;
use super::image::Images;
use crate::shared::run::read_timestamp;

/// An image that this server has built.
#[derive(Debug)]
struct Own {
    name: String,
    /// Bytes.
    size: u64,
    used: SystemTime,
}

impl Images {
    /// Removes the images that this server has built and that nobody has used for so long, or that are too many for this
    /// many bytes; and what builds that failed have left. Those in `kept` stay.
    pub async fn prune(&self, age: Duration, size: u64, kept: &[String]) {
        if let Err(error) = self.prune_now(age, size, kept).await {
            log::warn!("images that nobody needs are not removed: {error}");
        }
    }

    async fn prune_now(&self, age: Duration, size: u64, kept: &[String]) -> Result<(), DockerError> {
        // What a build that is under way makes is younger.
        let (mine, left) = (format!("label={LABEL}={}", self.owner.name()), "until=1h");
        self.docker.run(&["image", "prune", "--force", "--filter", &mine, "--filter", left], SHORT).await?;
        for name in removable(self.own().await?, kept, age, size) {
            log::info!("the image {name} is removed: nobody needs it");
            // One that a container uses stays.
            if let Err(error) = self.docker.run(&["image", "rm", &name], SHORT).await {
                log::debug!("{error}");
            }
        }
        Ok(())
    }

    /// The images that this server has built. What they share with others does not count for their size.
    async fn own(&self) -> Result<Vec<Own>, DockerError> {
        let repository = self.repository();
        let names =
            self.docker.run(&["image", "ls", "--format", "{{.Repository}}:{{.Tag}}", &repository], SHORT).await?;
        let names: Vec<&str> = names.lines().collect();
        if names.is_empty() {
            return Ok(Vec::new());
        }
        let format = "{{range .Images}}{{.Repository}}:{{.Tag}} {{.UniqueSize}}{{println}}{{end}}";
        let sizes = self.docker.run(&["system", "df", "--verbose", "--format", format], SHORT).await?;
        let sizes: HashMap<&str, &str> = sizes.lines().filter_map(|line| line.trim().split_once(' ')).collect();
        let mut own = Vec::new();
        for name in names {
            let format = "{{json .Metadata.LastTagTime}}";
            let used = self.docker.run(&["image", "inspect", "--format", format, name], SHORT).await?;
            let used = read_timestamp(used.trim().trim_matches('"'));
            let size: Option<ByteSize> = sizes.get(name).and_then(|size| size.parse().ok());
            let size = size.map_or(0, |size| size.as_u64());
            own.push(Own { name: name.to_owned(), size, used: used.unwrap_or_else(SystemTime::now) });
        }
        Ok(own)
    }
}

/// Those images that can go, the longest unused first.
fn removable(mut own: Vec<Own>, kept: &[String], age: Duration, most: u64) -> Vec<String> {
    own.retain(|image| !kept.contains(&image.name));
    own.sort_by_key(|image| std::cmp::Reverse(image.used));
    let oldest = SystemTime::now().checked_sub(age).unwrap_or(SystemTime::UNIX_EPOCH);
    let mut total = 0_u64;
    let too_many = own.into_iter().filter(|image| {
        total = total.saturating_add(image.size);
        image.used < oldest || total > most
    });
    let mut names: Vec<String> = too_many.map(|image| image.name).collect();
    names.reverse();
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_unused_images_go_first_and_those_that_are_to_be_kept_stay() {
        let hours = |hours| SystemTime::now().checked_sub(Duration::from_hours(hours)).unwrap();
        let own = |name: &str, size, used| Own { name: name.to_owned(), size, used: hours(used) };
        let all = || vec![own("old", 1, 100), own("new", 5, 1), own("middle", 5, 2), own("kept", 50, 200)];
        let kept = ["kept".to_owned()];
        let days = Duration::from_hours(48);
        assert_eq!(removable(all(), &kept, days, 100), ["old"]);
        assert_eq!(removable(all(), &kept, days, 9), ["old", "middle"]);
        assert!(removable(all(), &kept, Duration::from_hours(1000), 100).is_empty());
    }
}
