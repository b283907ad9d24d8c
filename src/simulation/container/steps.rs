//! Docker's output while it creates an image, as text for a client. Pure.
//!
//! Webots' page moves its progress bar by texts such as `Step 3/9 : ...`, in which each number has one digit, by
//! `Creating network`, and by one that ends in `done`.

/// The largest number of steps that the page understands.
const STEPS: u64 = 9;

/// The step in which the network is joined and the containers are created.
pub const CREATING: &str = "Creating network and containers";

/// The step of a pull, with Docker's output line.
pub fn pulling(image: &str, line: &str) -> String {
    format!("Step 1/9 : fetching {image}: {line}")
}

/// Lines of a build that are not shown.
const NOISE: [&str; 6] = [
    " --->",
    "Removing intermediate container",
    "Sending build context",
    "DEPRECATED: The legacy builder",
    "            BuildKit is currently disabled",
    "            environment-variable",
];

/// The step of a build, from Docker's output line; `None` if it is not shown. The page supports nine steps.
pub fn building(line: &str) -> Option<String> {
    if NOISE.iter().any(|beginning| line.starts_with(beginning)) {
        return None;
    }
    let scaled = || {
        let (numbers, instruction) = line.strip_prefix("Step ")?.split_once(" : ")?;
        let (step, of) = numbers.split_once('/')?;
        let (step, of): (u64, u64) = (step.parse().ok()?, of.parse().ok()?);
        let step = if of > STEPS { (step.saturating_mul(STEPS) / of).max(1) } else { step };
        Some(format!("Step {step}/{} : {instruction}", of.min(STEPS)))
    };
    Some(scaled().unwrap_or_else(|| line.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_have_one_digit() {
        for (said, told) in [
            ("Step 2/4 : RUN make", "Step 2/4 : RUN make"),
            ("Step 10/20 : COPY . /x", "Step 4/9 : COPY . /x"),
            ("Step 1/20 : FROM a", "Step 1/9 : FROM a"),
            ("Step into the light", "Step into the light"),
        ] {
            assert_eq!(building(said).as_deref(), Some(told));
        }
        assert_eq!(building(" ---> Running in 0123"), None);
    }
}
