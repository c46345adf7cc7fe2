//! Log lines about connections that were refused. zenoh decides that, and says so in its own log only: with the reason
//! and without the peer's address where the handshake failed, with the address and the name of the certificate where
//! it did not.

use std::fmt;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

use super::class::role_of;
use crate::blueprint::share::ShareConfig;
use dimos_core::sync::lock;

/// The part of zenoh that accepts connections with certificates.
const TLS: &str = "zenoh_link_tls";
/// Minimum time between two lines; those between are counted.
const PERIOD: Duration = Duration::from_secs(1);

/// Reads zenoh's log for refused connections.
struct Refusals {
    config: ShareConfig,
    said: Mutex<Said>,
}

#[derive(Default)]
struct Said {
    last: Option<Instant>,
    more: u64,
}

/// Returns the layer of the log that reports refused connections. `line` gets the lines.
pub fn layer<S>(config: &ShareConfig, line: impl Fn(String) + Send + Sync + 'static) -> Box<dyn Layer<S> + Send + Sync>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    let refusals = Refusals { config: config.clone(), said: Mutex::default() };
    let layer = Reporting { refusals, line };
    layer.with_filter(Targets::new().with_target(TLS, LevelFilter::DEBUG)).boxed()
}

struct Reporting<F> {
    refusals: Refusals,
    line: F,
}

impl<S: Subscriber, F: Fn(String) + Send + Sync + 'static> Layer<S> for Reporting<F> {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let mut text = Text(String::new());
        event.record(&mut text);
        let refused = self.refusals.line_of(*event.metadata().level(), &text.0);
        if let Some(line) = refused.and_then(|line| self.refusals.throttled(line, Instant::now())) {
            (self.line)(line);
        }
    }
}

impl Refusals {
    /// Returns the line for an event of zenoh.
    fn line_of(&self, level: Level, text: &str) -> Option<String> {
        if level == Level::WARN {
            let reason = text.strip_suffix(" Hint: increase the system open file limit.").unwrap_or(text);
            // Someone looked whether the port is open, as our own clients do.
            let nothing = reason.contains("handshake eof");
            let line = format!("share: a connection was refused: {}", in_our_words(reason.trim_end_matches('.')));
            return (!nothing).then_some(line);
        }
        // Accepted TLS connection on 127.0.0.1:7447: 127.0.0.1:51234. Common Name: carol.
        let accepted = text.strip_prefix("Accepted TLS connection on ")?.split_once(": ")?.1;
        let (peer, name) = accepted.strip_suffix('.')?.split_once(". Common Name: ")?;
        let unknown = role_of(name, &self.config).is_none();
        unknown.then(|| format!("share: {name:?} at {peer} is no user of this run, and gets nothing"))
    }

    /// Returns a line if none was written just before; with the number of those that were not.
    fn throttled(&self, line: String, now: Instant) -> Option<String> {
        let mut said = lock(&self.said);
        if said.last.is_some_and(|last| now.saturating_duration_since(last) < PERIOD) {
            said.more += 1;
            return None;
        }
        said.last = Some(now);
        let more = std::mem::take(&mut said.more);
        Some(if more > 0 { format!("{line} (and {more} more before)") } else { line })
    }
}

/// Returns why a handshake failed.
fn in_our_words(reason: &str) -> String {
    let known = [
        ("peer sent no certificates", "the client showed no certificate"),
        ("Expired", "the client's certificate has expired, or the clocks differ"),
        ("NotValidYet", "the client's certificate is not valid yet, or the clocks differ"),
        ("UnknownIssuer", "another authority signed the client's certificate"),
        ("BadSignature", "another authority signed the client's certificate"),
        ("InvalidContentType", "the client speaks no TLS"),
        ("received fatal alert", "the client refused our certificate"),
    ];
    known.iter().find(|(part, _)| reason.contains(part)).map_or_else(
        || reason.chars().filter(|c| !c.is_control()).take(200).collect(),
        |(_, words)| (*words).to_owned(),
    )
}

/// The message of an event.
struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            self.0 = format!("{value:?}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blueprint::share::Role;

    #[test]
    fn what_zenoh_says_of_a_refused_connection_becomes_a_line() {
        let users = [("alice".to_owned(), Role::Operator)].into();
        let config = ShareConfig { users, ..ShareConfig::default() };
        let refusals = Refusals { config, said: Mutex::default() };
        let failed = "invalid peer certificate: UnknownIssuer. Hint: increase the system open file limit.";
        let line = refusals.line_of(Level::WARN, failed).unwrap();
        assert_eq!(line, "share: a connection was refused: another authority signed the client's certificate");
        let accepted = |name: &str| {
            let text = format!("Accepted TLS connection on 10.0.0.1:7447: 10.0.0.7:51234. Common Name: {name}.");
            refusals.line_of(Level::DEBUG, &text)
        };
        assert_eq!(accepted("alice"), None);
        let unknown = "share: \"carol\" at 10.0.0.7:51234 is no user of this run, and gets nothing";
        assert_eq!(accepted("carol").as_deref(), Some(unknown));
        assert_eq!(refusals.line_of(Level::DEBUG, "Ready to accept"), None);
    }

    #[test]
    fn a_flood_of_refused_connections_is_one_line_per_second() {
        let refusals = Refusals { config: ShareConfig::default(), said: Mutex::default() };
        let began = Instant::now();
        let line = |ms| refusals.throttled("refused".to_owned(), began + Duration::from_millis(ms));
        assert_eq!(line(0).as_deref(), Some("refused"));
        assert!((1..100).all(|ms| line(ms).is_none()));
        assert_eq!(line(1000).as_deref(), Some("refused (and 99 more before)"));
    }
}
