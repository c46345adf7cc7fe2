//! The Robot API of PolyScope X: what the dashboard does, by HTTP.

use super::controller::Controller;
use crate::ur::robot_api::{ORDERS, ROOT, request};
use dimos_hardware::transport::Scan;

/// The first software with the API.
const SINCE: [u8; 3] = [10, 11, 0];

impl Controller {
    /// Returns whether it runs PolyScope X, which has no dashboard.
    pub(super) fn is_polyscope_x(&self) -> bool {
        self.software.first().is_some_and(|major| *major >= 10)
    }

    /// Answers a request to the API.
    pub(super) fn robot_api(&mut self, bytes: &[u8], answer: &mut Vec<u8>) -> Scan<()> {
        request(bytes).map(|(method, path, body)| {
            let (status, text) = match method.as_str() {
                "PUT" => self.put(&path, &body),
                _ => (404, r#"{"message":"Not Found","details":""}"#.to_owned()),
            };
            answer.extend(
                format!(
                    "HTTP/1.1 {status} -\r\nContent-Type: application/json\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{text}",
                    text.len()
                )
                .bytes(),
            );
        })
    }

    fn put(&mut self, path: &str, body: &[u8]) -> (u16, String) {
        let action = serde_json::from_slice::<serde_json::Value>(body).ok();
        let action = action.and_then(|body| Some(body.get("action")?.as_str()?.to_owned()));
        let path = path.strip_prefix(ROOT).map(|path| path.trim_matches('/')).filter(|_| self.software >= SINCE);
        let known = |(_, own, name): &&(&str, &str, &str)| path == Some(*own) && action.as_deref() == Some(*name);
        let Some((request, ..)) = ORDERS.iter().find(known) else {
            return match path {
                Some(path) if ORDERS.iter().any(|(_, own, _)| *own == path) => {
                    (400, r#"{"message":"Bad Request","details":"unknown action"}"#.to_owned())
                }
                _ => (404, r#"{"message":"Not Found","details":""}"#.to_owned()),
            };
        };
        if !self.remote {
            let details = "Not authorized to perform this operation under the current robot control mode.";
            return (403, format!(r#"{{"message":"Forbidden","details":"{details}"}}"#));
        }
        let said = self.dashboard(request);
        match said.starts_with("Failed") || said.starts_with("Cannot") {
            true => (409, format!(r#"{{"message":"Conflict","details":"{said}"}}"#)),
            false => (200, format!(r#"{{"message":"{said}"}}"#)),
        }
    }
}
