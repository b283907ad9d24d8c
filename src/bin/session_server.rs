//! The program `session-server`: reads its arguments and its configuration, then runs the server.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use webots_fleet::session::app;
use webots_fleet::session::config::SessionConfig;
use webots_fleet::session::mail;
use webots_fleet::shared::run::{LogTarget, start};

/// The one door to a fleet of simulation servers.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Configuration file
    #[arg(default_value = "config/session/local.json")]
    config: PathBuf,
    #[command(flatten)]
    options: start::Options,
    /// Send one mail to the administrator, say how it went, and end
    #[arg(long, conflicts_with = "check")]
    test_mail: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let loaded = match start::read::<SessionConfig>(&arguments.config) {
        Ok(loaded) => loaded,
        Err(code) => return code,
    };
    if arguments.options.check {
        return start::check(&loaded);
    }
    if arguments.test_mail {
        return test_mail(&loaded.config);
    }
    let log = loaded.config.log_dir.0.join("session/output.log");
    let target = LogTarget::new(loaded.config.debug, &log);
    let server = app::run(loaded.config.clone(), arguments.config);
    start::serve(target, &arguments.options, &loaded.warnings, server)
}

/// Sends one mail to the administrator and says how that went.
fn test_mail(config: &SessionConfig) -> ExitCode {
    match actix_rt::System::new().block_on(mail::test_mail(config)) {
        Ok(how) => {
            // The reader may have gone.
            writeln!(std::io::stdout(), "{how}").ok();
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(start::FAILED)
        }
    }
}
