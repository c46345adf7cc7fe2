//! The node: its session, and the publishers and services that other nodes see.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::SyncSender;

use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{Query, Queryable};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig};

use super::attachment::{Sender, is_of_request};
use super::names::{Names, Part, Qos};
use super::types::Type;
use crate::blueprint::share::RosConfig;
use dimos_core::clock::wall_now;
use dimos_core::sync::lock;
use dimos_log::cdr::{CdrError, Decoder, Encoder};
use dimos_log::wire::Field;

/// The node in a session. Its parts end with it.
pub struct Node {
    /// The session.
    pub session: Session,
    names: Names,
    zid: [u8; 16],
    entities: AtomicU32,
    tokens: Mutex<Vec<LivelinessToken>>,
    services: Mutex<Vec<Queryable<()>>>,
}

/// A topic.
pub struct Topic {
    publisher: Publisher<'static>,
    sender: Sender,
}

/// A topic whose newest message is also delivered to who subscribes later.
pub struct Latched {
    publisher: AdvancedPublisher<'static>,
    sender: Sender,
}

/// A request of a service.
pub struct Request<K> {
    /// Which service.
    pub of: K,
    query: Query,
}

impl Node {
    /// Creates a node without parts.
    pub fn new(session: Session, config: &RosConfig) -> zenoh::Result<Self> {
        let zid = session.zid();
        let names = Names { domain: config.domain, namespace: config.namespace.clone(), zid: zid.to_string() };
        let token = session.liveliness().declare_token(names.node()).wait()?;
        let zid = zid.to_le_bytes();
        Ok(Self {
            session,
            names,
            zid,
            entities: AtomicU32::new(1),
            tokens: Mutex::new(vec![token]),
            services: Mutex::default(),
        })
    }

    /// Declares the token of a part. Returns the part's number.
    fn declare(&self, part: Part, name: &str, of: Type) -> zenoh::Result<u32> {
        let entity = self.entities.fetch_add(1, Ordering::Relaxed);
        let token = self.session.liveliness().declare_token(self.names.part(entity, part, name, of)).wait()?;
        lock(&self.tokens).push(token);
        Ok(entity)
    }

    /// Returns a publisher. `name`: below the namespace.
    pub fn topic(&self, name: &str, of: Type) -> zenoh::Result<Topic> {
        // Dropped for a subscriber that is congested: with `Block` one frozen subscriber stops all others.
        let publisher = self.session.declare_publisher(self.names.data(name, of));
        let publisher = publisher.congestion_control(CongestionControl::Drop).express(true).wait()?;
        let entity = self.declare(Part::Publisher(Qos::Ordinary), name, of)?;
        Ok(Topic { publisher, sender: Sender::new(self.zid, entity) })
    }

    /// Returns a publisher of what changes rarely.
    pub fn latched(&self, name: &str, of: Type) -> zenoh::Result<Latched> {
        let publisher = self.session.declare_publisher(self.names.data(name, of));
        let publisher = publisher.congestion_control(CongestionControl::Drop).priority(Priority::Data);
        let publisher = publisher.cache(CacheConfig::default().max_samples(1)).publisher_detection().wait()?;
        let entity = self.declare(Part::Publisher(Qos::Latched), name, of)?;
        Ok(Latched { publisher, sender: Sender::new(self.zid, entity) })
    }

    /// Serves a service: its requests go to the queue; those that do not fit get no reply.
    pub fn serve<K: Copy + Send + Sync + 'static>(
        &self,
        name: &str,
        of: Type,
        kind: K,
        queue: SyncSender<Request<K>>,
    ) -> zenoh::Result<()> {
        let key = self.names.data(name, of);
        // Clients of ROS ask all that are complete.
        let queryable = self.session.declare_queryable(key.clone()).complete(true).callback(move |query| {
            // One with wildcards, or without what a reply returns, is none of a node.
            let attachment = query.attachment().map(|attachment| attachment.to_bytes());
            if query.key_expr().as_str() == key && attachment.is_some_and(|bytes| is_of_request(&bytes)) {
                let _ = queue.try_send(Request { of: kind, query });
            }
        });
        let queryable = queryable.wait()?;
        self.declare(Part::Service, name, of)?;
        lock(&self.services).push(queryable);
        Ok(())
    }

    /// Ends all parts, and the session.
    pub fn close(&self) {
        lock(&self.services).clear();
        lock(&self.tokens).clear();
        let _ = self.session.close().wait();
    }
}

impl Topic {
    /// Publishes a message.
    pub fn publish(&self, message: &impl Field) {
        self.publish_bytes(encoded(message));
    }

    /// Publishes an encoded message.
    pub fn publish_bytes(&self, bytes: Vec<u8>) {
        let put = self.publisher.put(bytes).attachment(self.sender.next(wall_now()));
        log_failure(put.wait());
    }
}

impl Latched {
    /// Publishes a message.
    pub fn publish(&self, message: &impl Field) {
        let put = self.publisher.put(encoded(message)).attachment(self.sender.next(wall_now()));
        log_failure(put.wait());
    }
}

impl<K> Request<K> {
    /// Reads the request.
    pub fn read<M: Field>(&self) -> Result<M, CdrError> {
        let payload = self.query.payload().map(|payload| payload.to_bytes()).unwrap_or_default();
        M::get(&mut Decoder::new(&payload)?)
    }

    /// Answers it.
    pub fn reply(self, message: &impl Field) {
        self.reply_bytes(encoded(message));
    }

    /// Answers it with an encoded message.
    pub fn reply_bytes(self, bytes: Vec<u8>) {
        let reply = self.query.reply(self.query.key_expr().clone(), bytes);
        let attachment = self.query.attachment().cloned();
        log_failure(reply.attachment(attachment).express(true).wait());
    }
}

/// Returns the bytes of a message.
pub fn encoded(message: &impl Field) -> Vec<u8> {
    let mut encoder = Encoder::default();
    message.put(&mut encoder);
    encoder.bytes().to_vec()
}

fn log_failure(result: zenoh::Result<()>) {
    if let Err(error) = result {
        tracing::debug!("share: ros: {error}");
    }
}
