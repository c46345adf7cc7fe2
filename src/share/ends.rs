//! Requests that end motion, each over its own connection: a stop waits behind no other request, needs no place among
//! the clients, and is repeated until the run answers it.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};

use serde_json::{Value, json};
use zenoh::Wait;
use zenoh::query::Query;

use super::remote::refuse;
use dimos_core::sync::lock;
use dimos_rpc::api::{Cancel, Method, Stop, read_params};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::{Code, RpcError};

/// Requests of a user and a method that may be under way; more are refused. Cancels so take no place of stops.
const MAX_UNDER_WAY: usize = 16;

/// Number of requests under way, by user and method.
type UnderWay = Arc<Mutex<BTreeMap<(String, String), usize>>>;

/// The requests under way.
#[derive(Debug, Default)]
pub(super) struct Ends(UnderWay);

/// A place among the requests under way, until dropped.
struct Place(UnderWay, (String, String));

impl Ends {
    /// Begins to ask the run on a thread, which answers the query. Returns a query that is refused, and why. Never
    /// waits.
    pub fn begin(
        &self,
        query: Query,
        (user, method, params): (&str, String, Value),
        (run, socket): (&str, &Path),
    ) -> Option<(Query, RpcError)> {
        let place = match self.place(user, &method) {
            Ok(place) => place,
            Err(error) => return Some((query, error)),
        };
        let (run, socket, asked) = (run.to_owned(), socket.to_owned(), query.clone());
        let asking = move || {
            let result = ask(&method, params, || Client::connect(&run, &socket));
            drop(place);
            match result {
                Ok(result) => drop(asked.reply(asked.key_expr().clone(), result.to_string()).express(true).wait()),
                Err(error) => refuse(&asked, &error),
            }
        };
        let started = std::thread::Builder::new().name("client-stop".into()).spawn(asking);
        started.err().map(|e| (query, RpcError::new(Code::Internal, format!("no thread for a request: {e}"))))
    }

    /// Returns whether none is under way.
    pub fn is_empty(&self) -> bool {
        lock(&self.0).is_empty()
    }

    fn place(&self, user: &str, method: &str) -> Result<Place, RpcError> {
        let key = (user.to_owned(), method.to_owned());
        let mut under_way = lock(&self.0);
        let count = under_way.entry(key.clone()).or_default();
        if *count >= MAX_UNDER_WAY {
            let error = RpcError::new(Code::TooManyRequests, format!("{MAX_UNDER_WAY} requests `{method}` wait"));
            return Err(error.hint("the run does not answer them: use the arm's own stop"));
        }
        *count += 1;
        Ok(Place(self.0.clone(), key))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut under_way = lock(&self.0);
        if let Some(count) = under_way.get_mut(&self.1) {
            *count -= 1;
        }
        under_way.retain(|_, count| *count > 0);
    }
}

/// Asks until the run answers. Says what is known where it does not.
fn ask(method: &str, params: Value, connect: impl Fn() -> Result<Client, ClientError>) -> Result<Value, RpcError> {
    let reply = match method {
        Stop::NAME => Client::urgent(None, connect, &read_params::<Stop>(params)?).map(|(_, reply)| json!(reply)),
        Cancel::NAME => Client::urgent(None, connect, &read_params::<Cancel>(params)?).map(|(_, reply)| json!(reply)),
        other => return Err(RpcError::unknown(Code::UnknownMethod, "method", other, &[Stop::NAME, Cancel::NAME])),
    };
    reply.map_err(|error| match error {
        ClientError::Refused(refusal) => refusal,
        other => {
            let hint = "it may still take effect; use the arm's own stop, and ask for `status`";
            RpcError::new(Code::Lost, format!("the run has not answered: {other}")).hint(hint)
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_for_each_user_and_method_and_come_back() {
        let ends = Ends::default();
        let stops: Vec<Place> = (0..MAX_UNDER_WAY).map(|_| ends.place("-", "stop").unwrap()).collect();
        assert_eq!(ends.place("-", "stop").err().unwrap().code, Code::TooManyRequests);
        drop((ends.place("-", "cancel").unwrap(), ends.place("alice", "stop").unwrap()));
        drop(stops);
        assert!(ends.is_empty() && ends.place("-", "stop").is_ok());
    }
}
