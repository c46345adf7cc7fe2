//! Where other programs read a run: `metrics`, `view.foxglove`.

use std::net::{Ipv4Addr, SocketAddr};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

use crate::blueprint::resolve::Checker;
use dimos_yaml::{Diag, Located, quote};

/// Metrics of the run in the format OpenMetrics, at `http://ADDRESS/metrics`. See `docs/service.md`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MetricsConfig {
    /// IP address and port that they are served at. With another address than that of this computer only, all who reach
    /// the computer can read them.
    #[serde(deserialize_with = "address")]
    pub listen: SocketAddr,
}

impl Default for MetricsConfig {
    fn default() -> Self {
        Self { listen: (Ipv4Addr::LOCALHOST, 9464).into() }
    }
}

fn address<'de, D: Deserializer<'de>>(from: D) -> Result<SocketAddr, D::Error> {
    let text = String::deserialize(from)?;
    let hint = "write an IP address and a port: 127.0.0.1:9464";
    text.parse().map_err(|_| D::Error::custom(format!("{} is no address\nhint: {hint}", quote(&text))))
}

/// Foxglove's WebSocket, which the live view serves: joint states, transforms, obstacles, events, to read only. `dimos
/// view --foxglove` prints its URL. See `docs/view.md`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FoxgloveConfig {
    /// Sites whose pages may connect besides those of this computer: `https://app.foxglove.dev`.
    pub origins: Vec<WebOrigin>,
}

/// The origin of web pages, as browsers send it: `https://app.foxglove.dev`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct WebOrigin(String);

impl WebOrigin {
    /// Returns it as browsers send it.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for WebOrigin {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '.' | '-' | ':' | '[' | ']');
        let rest = text.split_once("://").filter(|(scheme, _)| !scheme.is_empty() && scheme.chars().all(good));
        match rest {
            Some((_, host)) if host.chars().all(good) => Ok(Self(text)),
            _ => Err(format!(
                "{} is no origin of web pages\nhint: write its scheme and host in small letters, without a path: \
                https://app.foxglove.dev",
                quote(&text)
            )),
        }
    }
}

impl From<WebOrigin> for String {
    fn from(origin: WebOrigin) -> Self {
        origin.0
    }
}

impl JsonSchema for WebOrigin {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "WebOrigin".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "pattern": r"^[a-z0-9.:-]+://[a-z0-9.:\[\]-]*$" })
    }
}

/// Warns of metrics that others can read.
pub(super) fn check(checker: &mut Checker<'_>, metrics: Option<&Located<MetricsConfig>>) {
    if let Some(metrics) = metrics.filter(|metrics| !metrics.listen.ip().is_loopback()) {
        let diag = Diag::warning(format!("the metrics are open to the network at {}", metrics.listen));
        checker.error(metrics.at, diag.hint("metrics.listen: 127.0.0.1:9464 serves them to this computer only"));
    }
}
