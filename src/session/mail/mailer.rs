//! Task: sends notices to the administrator on one channel, by mail or by webhook.
//!
//! Started by the registry for each channel that is configured; after a panic it begins again. It receives [`Notice`]s.
//! [`Outbox`] decides what is sent, and when. One batch is sent at a time; nothing waits for it.

use std::pin::pin;
use std::time::Instant;

use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::time::sleep_until;

use super::channel::Channel;
use super::notice_text::{notice_text, signature, summary};
use super::outbox::{MailEntry, Notice, Outbox};
use crate::session::config::SessionConfig;
use crate::shared::run::permanent;

/// Starts a mailer for each channel that is configured. Returns where their notices go.
pub fn start(config: &SessionConfig) -> Vec<UnboundedSender<Notice>> {
    let mail = Channel::mail(config).inspect_err(|why| log::info!("{why}"));
    let (signature, outbox) = (signature(config), Outbox::new(&config.timing));
    let start = |channel: Channel| {
        let (sender, mut notices) = unbounded_channel();
        let (signature, outbox) = (signature.clone(), outbox.clone());
        actix_rt::spawn(async move {
            let name = format!("mailer of notices by {}", channel.name);
            let send = async || send_all(&channel, &signature, outbox.clone(), &mut notices).await;
            permanent::restarted(&name, send).await;
        });
        sender
    };
    mail.into_iter().chain(Channel::webhook(config)).map(start).collect()
}

/// Sends what comes, until the server ends.
async fn send_all(channel: &Channel, signature: &str, mut outbox: Outbox, notices: &mut UnboundedReceiver<Notice>) {
    loop {
        // A new notice, or the end of the last e-mail, may change when the next one is due.
        let due = outbox.due();
        tokio::select! {
            notice = notices.recv() => match notice {
                Some(notice) => outbox.add(notice, Instant::now()),
                None => return,
            },
            () = sleep_until(due.unwrap_or_else(Instant::now).into()), if due.is_some() => {
                let batch = outbox.take(Instant::now());
                let text = notice_text(&batch, signature);
                let mut delivery = pin!(channel.deliver(&text));
                let sent = loop {
                    tokio::select! {
                        sent = &mut delivery => break sent,
                        Some(notice) = notices.recv() => outbox.add(notice, Instant::now()),
                    }
                };
                handle_outcome(channel, &mut outbox, batch, sent);
            }
        }
    }
}

/// Reports the outcome of sending a batch to the outbox and the log.
fn handle_outcome(channel: &Channel, outbox: &mut Outbox, batch: Vec<MailEntry>, sent: Result<String, String>) {
    let (now, subject, name) = (Instant::now(), summary(&batch), channel.name);
    let error = match sent {
        Ok(answer) => {
            log::info!("{name} sent by {} ({subject}): {answer}", channel.server);
            return outbox.succeeded(&batch, now);
        }
        Err(error) => error,
    };
    let lost = outbox.failed(batch, now);
    if !lost.is_empty() {
        log::error!("{name} given up ({}): {error}", summary(&lost));
    } else if let Some(next) = outbox.due() {
        let wait = next.saturating_duration_since(now).as_secs_f64();
        log::warn!("{name} not sent, next try in {wait:.0} s ({subject}): {error}");
    }
}
