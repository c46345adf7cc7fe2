//! The clients of a gateway: their places, whom an id belongs to, and what their silence means.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use serde_json::Value;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;
use zenoh::sample::{Sample, SampleKind};

use super::{FORGET_AFTER, MAX_LOST, News, Shared, failed};
use crate::blueprint::share::OnLost;
use crate::share::keys::Who;
use crate::share::remote::{Closed, Remote, Ways, ended};
use dimos_core::sync::lock;
use dimos_rpc::api::Class;
use dimos_rpc::api::{Lease, Method};
use dimos_rpc::error::{Code, RpcError};

impl Shared {
    /// Fails for a commander that was lost, until it takes its lease again.
    pub(super) fn still_commands(&self, who: &Who, method: &str, class: Class) -> Result<(), RpcError> {
        let mut lost = lock(&self.lost);
        if !lost.contains(who) || !matches!(class, Class::Move | Class::Enable) {
            return Ok(());
        }
        if method == Lease::NAME {
            lost.retain(|other| other != who);
            return Ok(());
        }
        let timeout = self.config.client_timeout;
        let text = format!("the lease has ended: this client was silent for more than {timeout} s");
        Err(RpcError::new(Code::Lost, text).hint("take the lease again with `lease`, or start the program again"))
    }

    /// Returns the client of a request. Fails unless the request comes from the program that sent the client's first
    /// one.
    pub(super) fn proved_client(&self, who: &Who, query: &Query) -> Result<Arc<Remote>, RpcError> {
        let (client, proof) = (self.client(who)?, proof(query.attachment()));
        if *client.proof.get_or_init(|| proof.clone()) == proof {
            return Ok(client);
        }
        let text = format!("another program has the id {}", who.id);
        let hint = "use the id of your own zenoh session, and one attachment for all requests";
        Err(RpcError::new(Code::Forbidden, text).hint(hint))
    }

    /// Returns a client; a new one gets its connection.
    fn client(&self, who: &Who) -> Result<Arc<Remote>, RpcError> {
        let mut clients = lock(&self.clients);
        if self.run_ended.load(Ordering::Acquire) {
            return Err(ended(&self.run));
        }
        clients.retain(|_, remote| !remote.is_closed());
        if let Some(remote) = clients.get(who) {
            return Ok(remote.clone());
        }
        let limit = self.config.max_clients;
        // A limit for each user: none can occupy the places of another.
        if clients.keys().filter(|client| client.user == who.user).count() >= limit {
            let text = format!("{limit} clients of {} are connected already", who.title_of_user());
            let hint = "`dimos status` names them; the limit for each user is `share.max_clients`";
            return Err(RpcError::new(Code::TooManyConnections, text).hint(hint));
        }
        let remote = self.start_remote(who.clone())?;
        clients.insert(who.clone(), remote.clone());
        let _ = self.news.send(News::Clients);
        Ok(remote)
    }

    /// Passes on a request that ends motion. Returns one that is refused, and why.
    pub(super) fn end(&self, query: Query, (user, method, params): (&str, String, Value)) -> Option<(Query, RpcError)> {
        if self.run_ended.load(Ordering::Acquire) {
            return Some((query, ended(&self.run)));
        }
        self.ends.begin(query, (user, method, params), (&self.run, &self.socket))
    }

    fn start_remote(&self, who: Who) -> Result<Arc<Remote>, RpcError> {
        let ways = Ways {
            session: &self.session,
            run: &self.run,
            socket: &self.socket,
            cancel_at_end: self.config.on_lost == OnLost::Cancel,
        };
        Remote::start(who, &ways).map_err(|e| failed(format!("no thread for a client: {e}")))
    }

    pub(super) fn see_token(&self, sample: &Sample) {
        let Some(who) = Who::of_token(sample.key_expr().as_str(), &self.run) else { return };
        match sample.kind() {
            SampleKind::Put => {
                if let Ok(remote) = self.client(&who) {
                    remote.has_token.store(true, Ordering::Release);
                    remote.is_alive();
                }
            }
            SampleKind::Delete => self.lose(&who, false),
        }
    }

    pub(super) fn see_beat(&self, sample: &Sample) {
        let Some(who) = Who::of_token(sample.key_expr().as_str(), &self.run) else { return };
        let Some(remote) = lock(&self.clients).get(&who).cloned() else { return };
        // Not of this client: its silence would not be noticed.
        let proof = proof(sample.attachment());
        if remote.proof.get().is_some_and(|of_client| *of_client != proof) {
            return;
        }
        remote.is_alive();
        let name = sample.payload().to_bytes();
        if let Ok(name) = std::str::from_utf8(&name)
            && !name.is_empty()
        {
            let name: String = name.chars().filter(|c| !c.is_control()).take(40).collect();
            if *lock(&remote.name) != name {
                *lock(&remote.name) = name;
                let _ = self.news.send(News::Clients);
            }
        }
    }

    /// Ends the connections of commanders that are silent, and of clients that never had a token.
    pub(super) fn look_after_clients(&self) {
        let timeout = Duration::from_secs_f64(self.config.client_timeout);
        let silent = |remote: &&Arc<Remote>| {
            let silence = remote.silence();
            (remote.commands.load(Ordering::Acquire) && silence > timeout)
                || (!remote.has_token.load(Ordering::Acquire) && silence > FORGET_AFTER)
        };
        let silent: Vec<Who> = lock(&self.clients).values().filter(silent).map(|remote| remote.who.clone()).collect();
        for who in silent {
            self.lose(&who, true);
        }
    }

    /// Closes the connections of a client: the run frees its leases, and cancels its motions if it is to.
    fn lose(&self, who: &Who, silent: bool) {
        let Some(remote) = lock(&self.clients).remove(who) else { return };
        if remote.commands.load(Ordering::Acquire) {
            match silent {
                true => tracing::warn!("share: the commander {} is lost: it has been silent", remote.title()),
                // As every program at its end.
                false => tracing::info!("share: the commander {} has closed its connection", remote.title()),
            }
            let mut lost = lock(&self.lost);
            if lost.len() == MAX_LOST {
                lost.pop_front();
            }
            lost.push_back(who.clone());
        }
        remote.close(Closed::Lost);
        let _ = self.news.send(News::Clients);
    }
}

/// Returns what a program attaches to its requests and beats, so that no other one of its user speaks for it.
fn proof(attachment: Option<&ZBytes>) -> Vec<u8> {
    attachment.map(|bytes| bytes.to_bytes().into_owned()).unwrap_or_default()
}
