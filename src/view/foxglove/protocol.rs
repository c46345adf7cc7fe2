//! The messages of Foxglove's WebSocket. Its two subprotocols differ in their names only.

use serde::Deserialize;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

use crate::http::Request;

/// The subprotocols.
const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// First byte of binary messages of the server.
const MESSAGE_DATA: u8 = 1;
const FETCH_ASSET_RESPONSE: u8 = 4;
/// First byte of a call of a service by a client; 1 is data that it publishes.
const SERVICE_CALL: u8 = 2;

/// Severity of a status message.
#[derive(Debug, Clone, Copy)]
pub enum Severity {
    Info = 0,
    Warning = 1,
    Error = 2,
}

/// What a client wants.
#[derive(Debug, PartialEq, Eq)]
pub enum Order {
    /// Pairs of a subscription, as the client numbers it, and a channel.
    Subscribe(Vec<(u32, usize)>),
    /// Ends subscriptions.
    Unsubscribe(Vec<u32>),
    /// Wants a file: number of the request, URI.
    FetchAsset(u32, String),
    /// Nothing that is done here, with the reason.
    Refused(String),
}

/// Returns the subprotocol for a client: the first of its own that is known.
pub fn subprotocol(request: &Request) -> Option<&'static str> {
    let mut offered = request.header("sec-websocket-protocol")?.split(',').map(str::trim);
    offered.find_map(|name| SUBPROTOCOLS.into_iter().find(|own| *own == name))
}

/// Reads a message of a client. `None`: nothing that asks for an answer.
pub fn read(message: &Message) -> Option<Order> {
    match message {
        Message::Text(text) => Some(read_text(text.as_str())),
        Message::Binary(bytes) => {
            let what = if bytes.first() == Some(&SERVICE_CALL) { "calls of services" } else { "published data" };
            Some(refusal(what))
        }
        _ => None,
    }
}

fn refusal(what: &str) -> Order {
    Order::Refused(format!("{what}: refused, this server is read-only"))
}

fn read_text(text: &str) -> Order {
    #[derive(Deserialize)]
    #[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
    enum Op {
        Subscribe { subscriptions: Vec<Subscription> },
        Unsubscribe { subscription_ids: Vec<u32> },
        FetchAsset { request_id: u32, uri: String },
    }
    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase")]
    struct Subscription {
        id: u32,
        channel_id: usize,
    }
    let Ok(value) = serde_json::from_str::<Value>(text) else {
        return Order::Refused("this is not JSON".to_owned());
    };
    let op = value["op"].as_str().unwrap_or_default().to_owned();
    match (serde_json::from_value(value), op.as_str()) {
        (Ok(Op::Subscribe { subscriptions }), _) => {
            Order::Subscribe(subscriptions.into_iter().map(|wanted| (wanted.id, wanted.channel_id)).collect())
        }
        (Ok(Op::Unsubscribe { subscription_ids }), _) => Order::Unsubscribe(subscription_ids),
        (Ok(Op::FetchAsset { request_id, uri }), _) => Order::FetchAsset(request_id, uri),
        (Err(error), "subscribe" | "unsubscribe" | "fetchAsset") => Order::Refused(format!("{op}: {error}")),
        (Err(_), "") => Order::Refused("a message has no `op`".to_owned()),
        (Err(_), op) => refusal(op),
    }
}

/// Returns the first message: what the server is. A client that connects again sees by `session` whether it is the same
/// run.
pub fn server_info(run: &str, session: &str, metadata: &Value) -> Message {
    let info = json!({
        "op": "serverInfo",
        "name": format!("dimos: {run}"),
        "capabilities": ["assets"],
        "sessionId": session,
        "metadata": metadata,
    });
    Message::text(info.to_string())
}

/// Returns the message that lists channels: topic, name and text of the schema. A channel's id is its index.
pub fn advertise<'a>(channels: impl Iterator<Item = (&'a str, &'a str, String)>) -> Message {
    let channel = |(id, (topic, name, schema)): (usize, (&str, &str, String))| {
        json!({
            "id": id,
            "topic": topic,
            "encoding": "cdr",
            "schemaName": name,
            "schema": schema,
            "schemaEncoding": "ros2msg",
        })
    };
    let channels: Vec<Value> = channels.enumerate().map(channel).collect();
    Message::text(json!({"op": "advertise", "channels": channels}).to_string())
}

/// Returns a message for people. One with an `id` replaces the one before with the same.
pub fn status(severity: Severity, text: &str, id: Option<&str>) -> Message {
    let mut status = json!({"op": "status", "level": severity as u8, "message": text});
    if let Some(id) = id {
        status["id"] = json!(id);
    }
    Message::text(status.to_string())
}

/// Returns a message of a channel for a subscription. `time`: in Unix time [ns].
pub fn data(subscription: u32, time: u64, payload: &[u8]) -> Message {
    let head = [&[MESSAGE_DATA][..], &subscription.to_le_bytes(), &time.to_le_bytes()];
    Message::binary([&head.concat(), payload].concat())
}

/// Returns a file that a client asked for, or why it gets none.
pub fn asset(request: u32, content: Result<&[u8], &str>) -> Message {
    let (state, length) = content.map_or_else(|why| (1, why.len() as u32), |_| (0, 0));
    let head = [&[FETCH_ASSET_RESPONSE][..], &request.to_le_bytes(), &[state], &length.to_le_bytes()];
    Message::binary([&head.concat(), content.unwrap_or_else(str::as_bytes)].concat())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_client_wants_is_read_and_all_else_is_refused() {
        let read = |text: &str| read(&Message::text(text)).unwrap();
        let subscribe = r#"{"op":"subscribe","subscriptions":[{"id":7,"channelId":1},{"id":8,"channelId":0}]}"#;
        assert_eq!(read(subscribe), Order::Subscribe(vec![(7, 1), (8, 0)]));
        assert_eq!(read(r#"{"op":"unsubscribe","subscriptionIds":[7]}"#), Order::Unsubscribe(vec![7]));
        assert_eq!(read(r#"{"op":"fetchAsset","uri":"a","requestId":3}"#), Order::FetchAsset(3, "a".into()));
        for (text, part) in [
            (r#"{"op":"advertise","channels":[]}"#, "advertise: refused, this server is read-only"),
            (r#"{"op":"setParameters","parameters":[]}"#, "setParameters: refused"),
            (r#"{"op":"subscribe","subscriptions":3}"#, "subscribe: invalid type"),
            (r#"{"op":"subscribe","subscriptions":[{"id":-1,"channelId":0}]}"#, "subscribe: invalid value"),
            ("{}", "no `op`"),
            ("[", "not JSON"),
        ] {
            assert!(matches!(read(text), Order::Refused(why) if why.contains(part)), "{text}");
        }
        let called = super::read(&Message::binary(vec![2, 0, 0, 0, 0]));
        assert!(matches!(called, Some(Order::Refused(why)) if why.starts_with("calls of services: refused")));
        assert_eq!(super::read(&Message::Ping(Vec::new().into())), None);
    }

    #[test]
    fn binary_messages_are_little_endian() {
        assert_eq!(
            data(30, 1234, b"{}").into_data(),
            [&[1, 30, 0, 0, 0, 210, 4, 0, 0, 0, 0, 0, 0][..], b"{}"].concat()
        );
        assert_eq!(asset(1, Ok(b"x")).into_data(), [&[4, 1, 0, 0, 0, 0, 0, 0, 0, 0][..], b"x"].concat());
        assert_eq!(asset(1, Err("no")).into_data(), [&[4, 1, 0, 0, 0, 1, 2, 0, 0, 0][..], b"no"].concat());
    }
}
