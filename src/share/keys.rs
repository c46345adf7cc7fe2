//! The keys of a run on the network.
//!
//! ```text
//! dimos/<run>/alive                                    token of the gateway
//! dimos/<run>/by/<user>/client/<id>[/beat]             token and beat of a client
//! dimos/<run>/by/<user>/<class>/<id>/<method>          request
//! dimos/<run>/to/<user>/<id>/<stream>                  what one client subscribed to, at its rate
//! dimos/<run>/stream/<stream>                          every message, for all who may read
//! dimos/<run>/stream/end                               put once: the run has ended
//! ```

use crate::blueprint::share::ANYONE;
use dimos_rpc::api::Class;

/// First part of all keys.
const ROOT: &str = "dimos";
/// Longest id of a client [bytes].
const MAX_ID: usize = 64;

/// Returns the key of a gateway's token; with `*` as the run, those of all runs.
pub fn alive(run: &str) -> String {
    format!("{ROOT}/{run}/alive")
}

/// Returns the run of a gateway's token.
pub fn run_of_alive(key: &str) -> Option<&str> {
    key.strip_prefix(ROOT)?.strip_prefix('/')?.strip_suffix("/alive").filter(|run| !run.contains('/'))
}

/// Returns the key of a client's token; with `*` as user and id, those of all clients.
pub fn client(run: &str, user: &str, id: &str) -> String {
    format!("{ROOT}/{run}/by/{user}/client/{id}")
}

/// Returns the key of a client's beat.
pub fn beat(run: &str, user: &str, id: &str) -> String {
    format!("{}/beat", client(run, user, id))
}

/// Returns the key of all requests.
pub fn requests(run: &str) -> String {
    format!("{ROOT}/{run}/by/**")
}

/// Returns the key of a request.
pub fn request(run: &str, user: &str, class: Class, id: &str, method: &str) -> String {
    format!("{ROOT}/{run}/by/{user}/{}/{id}/{method}", class.name())
}

/// Returns the key of what a client subscribed to; with `*` as the stream, of all of it.
pub fn to(run: &str, user: &str, id: &str, stream: &str) -> String {
    format!("{ROOT}/{run}/to/{user}/{id}/{stream}")
}

/// Returns the key of a stream that everyone may read.
pub fn stream(run: &str, stream: &str) -> String {
    format!("{ROOT}/{run}/stream/{stream}")
}

/// Returns the key on which a gateway says that its run has ended.
pub fn end(run: &str) -> String {
    stream(run, "end")
}

/// A client, as keys name it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Who {
    /// Name of its certificate; `-` without one.
    pub user: String,
    /// Its id.
    pub id: String,
}

impl Who {
    /// Returns the client of a token or a beat.
    pub fn of_token(key: &str, run: &str) -> Option<Self> {
        match &parts(key, run)?[..] {
            ["by", user, "client", id] | ["by", user, "client", id, "beat"] => Self::of(user, id),
            _ => None,
        }
    }

    /// Returns the client, class and method of a request's key; `None` unless it names exactly one of each.
    pub fn of_request<'k>(key: &'k str, run: &str) -> Option<(Self, Class, &'k str)> {
        match parts(key, run)?[..] {
            ["by", user, class, id, method] => Some((Self::of(user, id)?, Class::of_name(class)?, method)),
            _ => None,
        }
    }

    /// Returns what the client is called until it says its name.
    pub fn short(&self) -> String {
        format!("client {}", self.id.get(..8).unwrap_or(&self.id))
    }

    /// Returns the client as people know it, with its name.
    pub fn title(&self, name: &str) -> String {
        format!("{} ({name})", self.title_of_user())
    }

    /// Returns the user as people know it.
    pub fn title_of_user(&self) -> &str {
        if self.user == ANYONE { "someone" } else { &self.user }
    }

    fn of(user: &str, id: &str) -> Option<Self> {
        let exact = |text: &str| !text.is_empty() && !text.contains(['*', '$', '?', '#']);
        let good = exact(user) && id.len() <= MAX_ID && !id.is_empty() && id.bytes().all(|b| b.is_ascii_alphanumeric());
        good.then(|| Self { user: user.to_owned(), id: id.to_owned() })
    }
}

/// Returns the parts of a key after the run.
fn parts<'k>(key: &'k str, run: &str) -> Option<Vec<&'k str>> {
    let rest = key.strip_prefix(ROOT)?.strip_prefix('/')?.strip_prefix(run)?.strip_prefix('/')?;
    Some(rest.split('/').collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_names_exactly_one_client_class_and_method() {
        let key = request("cell", "alice", Class::Move, "a1b2", "execute_plan");
        let who = Who { user: "alice".into(), id: "a1b2".into() };
        assert_eq!(Who::of_request(&key, "cell"), Some((who.clone(), Class::Move, "execute_plan")));
        for wrong in [
            "dimos/cell/by/*/move/a1b2/move",
            "dimos/cell/by/**/move",
            "dimos/cell/by/alice/move/*/move",
            "dimos/cell/by/al$*/move/a1/move",
            "dimos/cell/by/alice/*/a1b2/move",
            "dimos/cell/by/alice/drive/a1b2/move",
            "dimos/cell/by/alice/move/a1b2/move/more",
            "dimos/cell/by/alice/move/a1b2",
            "dimos/*/by/alice/move/a1b2/move",
            "dimos/cell2/by/alice/move/a1b2/move",
            "dimos/cell/by/alice/client/a1b2",
            "**",
        ] {
            assert_eq!(Who::of_request(wrong, "cell"), None, "{wrong}");
        }
    }

    #[test]
    fn tokens_and_beats_name_their_client() {
        let who = Who { user: "-".into(), id: "77".into() };
        assert_eq!(Who::of_token(&client("cell", "-", "77"), "cell"), Some(who.clone()));
        assert_eq!(Who::of_token(&beat("cell", "-", "77"), "cell"), Some(who));
        assert_eq!(Who::of_token("dimos/cell/by/-/client/*", "cell"), None);
        assert_eq!(run_of_alive("dimos/cell/alive"), Some("cell"));
        assert_eq!(run_of_alive("dimos/cell/by/alive"), None);
    }
}
