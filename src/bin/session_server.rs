//! The program `session-server`: reads its arguments and its configuration, then runs the server.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use webots_fleet::session::app;
use webots_fleet::session::config::SessionConfig;
use webots_fleet::session::mail::Channel;
use webots_fleet::shared::run::start;

/// The entry point of a fleet of simulation servers.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Configuration file
    #[arg(default_value = "config/session/local.json")]
    config: PathBuf,
    #[command(flatten)]
    options: start::CommonArgs,
    /// Send a test mail to the administrator, and a test to the webhook if one is configured; print the results, and exit
    #[arg(long, conflicts_with = "check")]
    test_mail: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if arguments.options.schema {
        return start::print_schema::<SessionConfig>();
    }
    let loaded = start::read::<SessionConfig>(&arguments.config);
    if arguments.options.check {
        start::print(&loaded);
        return start::conclude(&loaded);
    }
    if arguments.test_mail {
        return test_mail(&loaded.config);
    }
    let log = loaded.config.log_dir.0.join("session/output.log");
    let log = (!loaded.config.debug).then_some(log.as_path());
    let server = app::run(loaded.config.clone(), arguments.config);
    // It is held until the end of the process.
    let _pid_file = match start::claim_pid_file(&arguments.options) {
        Ok(file) => file,
        Err(code) => return code,
    };
    start::serve(log, &loaded.remarks(), server)
}

/// Sends one mail to the administrator and a test to the webhook, if they are configured, and prints the outcomes.
fn test_mail(config: &SessionConfig) -> ExitCode {
    let system = actix_rt::System::new();
    let webhook = Channel::webhook(config).map(Ok);
    let has_mail = config.administrator.is_some() || webhook.is_none();
    let mail = has_mail.then(|| Channel::mail(config));
    let mut code = ExitCode::SUCCESS;
    for channel in [mail, webhook].into_iter().flatten() {
        match channel.and_then(|channel| system.block_on(channel.test(config))) {
            // The reader may have closed the pipe.
            Ok(result) => drop(writeln!(std::io::stdout(), "{result}")),
            Err(error) => {
                eprintln!("error: {error}");
                code = ExitCode::from(start::FAILED);
            }
        }
    }
    code
}
