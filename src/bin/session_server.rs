//! The session server's program: arguments, configuration, log, then the server.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use webots_fleet::session::app;
use webots_fleet::session::config::SessionConfig;
use webots_fleet::session::mail::mailer;
use webots_fleet::shared::run::start;

/// The one door to a fleet of simulation servers.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Configuration file
    #[arg(default_value = "config/session/local.json")]
    config: PathBuf,
    /// Print the effective configuration and end
    #[arg(long, conflicts_with = "test_mail")]
    check: bool,
    /// Send one mail to the administrator, say how it went, and end
    #[arg(long)]
    test_mail: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let loaded = match start::read::<SessionConfig>(&arguments.config) {
        Ok(loaded) => loaded,
        Err(code) => return code,
    };
    if arguments.check {
        return start::check(&loaded);
    }
    if arguments.test_mail {
        return test_mail(&loaded.config);
    }
    let log = loaded.config.log_dir.0.join("session/output.log");
    let server = app::run(loaded.config.clone(), arguments.config);
    start::serve(&log, loaded.config.debug, &loaded.warnings, server)
}

/// Sends one mail to the administrator and says how that went.
fn test_mail(config: &SessionConfig) -> ExitCode {
    match actix_rt::System::new().block_on(mailer::test_mail(config)) {
        Ok(how) => {
            // Nobody may be listening any more.
            writeln!(std::io::stdout(), "{how}").ok();
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(start::FAILED)
        }
    }
}
