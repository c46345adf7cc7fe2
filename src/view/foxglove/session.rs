//! One client of Foxglove's WebSocket, and its connection to the run.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::{OnceCell, Semaphore, mpsc, watch};
use tokio::task::spawn_blocking;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_tungstenite::tungstenite::{Error, Message};

use super::assets::{self, Asset};
use super::protocol::{self, Order, Severity};
use super::topics::{Topic, encoded};
use crate::ros_messages::{self, nanoseconds, now, time};
use crate::view::socket::{End, GONE, NO_RUN, SEND_TIMEOUT, Socket, TOO_LARGE, TOO_MANY, close};
use crate::view::subject::Subject;
use dimos_log::display_messages::MarkerArray;
use dimos_log::messages::Text;
use dimos_rpc::api::{DescriptionReport, Method, RobotDescription, Status, Transforms, TransformsReport};
use dimos_rpc::api::{World, WorldObject, WorldReport};
use dimos_rpc::client::reach;
use dimos_rpc::report::StatusReport;
use dimos_rpc::server::streams::{EventReport, JointState, Stream, Subscribe, SubscribeReply, Unsubscribe};

/// Maximum rate of the joint states [Hz].
const JOINT_STATES: f64 = 100.0;
/// Period of the transforms.
const BEAT: Duration = Duration::from_millis(40);
/// Period of the objects of the world, and of the diagnostics, in beats.
const WORLD_BEATS: u64 = 12;
const DIAGNOSTICS_BEATS: u64 = 25;
/// Orders of a client that wait; then it waits.
const MAX_ORDERS: usize = 16;
/// Time limit for the client to take a file.
const ASSET_TIMEOUT: Duration = Duration::from_secs(60);
/// Minimum time between two messages about loss.
const LOSS_PERIOD: Duration = Duration::from_secs(1);

/// What the sessions of a server share.
pub struct Shared {
    /// The robots and objects.
    pub subject: Arc<dyn Subject>,
    /// The meshes that may be fetched, read for the first client that does.
    pub meshes: OnceCell<Arc<Vec<Asset>>>,
    /// Names this server, so that a client that connects again sees whether it is the same.
    pub session: String,
    /// Places for clients.
    pub places: Arc<Semaphore>,
}

/// Serves a client until it or the run ends. `is_known` is set: it has the token.
pub async fn serve(
    mut client: Socket,
    run: &Path,
    shared: &Shared,
    is_known: &AtomicBool,
    mut ended: watch::Receiver<bool>,
) {
    is_known.store(true, Ordering::Relaxed);
    let Ok(_place) = shared.places.try_acquire() else {
        return close(&mut client, TOO_MANY, "too many pages and viewers are open").await;
    };
    let Ok(run) = reach::open(run).and_then(UnixStream::from_std) else {
        return close(&mut client, NO_RUN, "the run is gone").await;
    };
    let ((to, mut from), (from_run, to_run)) = (client.split(), run.into_split());
    let mut session = Session {
        to,
        run: to_run,
        shared,
        name: String::new(),
        described: DescriptionReport::default(),
        subscriptions: BTreeMap::new(),
        streams: BTreeMap::new(),
        asked: HashMap::new(),
        requests: 0,
        world: None,
        lost: (0, None),
    };
    let (orders, ordered) = mpsc::channel(MAX_ORDERS);
    let why = tokio::select! {
        why = read_orders(&mut from, orders) => why,
        stopped = session.pump(BufReader::new(from_run).lines(), ordered) => match stopped {
            Stopped::Client => None,
            Stopped::Run => Some((GONE, "the run has ended")),
        },
        _ = ended.wait_for(|ended| *ended) => Some((GONE, "the run has ended")),
    };
    if let (Some((code, reason)), Ok(mut client)) = (why, session.to.reunite(from)) {
        close(&mut client, code, reason).await;
    }
}

/// Reads what the client wants.
async fn read_orders(from: &mut SplitStream<Socket>, orders: mpsc::Sender<Order>) -> End {
    loop {
        match from.next().await? {
            Ok(message) => {
                if let Some(order) = protocol::read(&message) {
                    orders.send(order).await.ok()?;
                }
            }
            Err(Error::Capacity(_)) => return Some((TOO_LARGE, "the message is larger than 64 kB")),
            Err(_) => return None,
        }
    }
}

/// Who ended a session.
enum Stopped {
    /// The client no longer takes anything.
    Client,
    /// The run closed the connection.
    Run,
}

/// What was asked of the run.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Asked {
    Status,
    Description,
    Transforms,
    World,
    Stream(Stream),
    Nothing,
}

/// A line of the run.
#[derive(serde::Deserialize)]
struct Line {
    id: Option<u64>,
    #[serde(default)]
    result: Value,
    stream: Option<String>,
    #[serde(default)]
    lost: u64,
    #[serde(default)]
    data: Value,
}

struct Session<'s> {
    to: SplitSink<Socket, Message>,
    run: OwnedWriteHalf,
    shared: &'s Shared,
    /// The run's name.
    name: String,
    described: DescriptionReport,
    /// The channel of each of the client's subscriptions.
    subscriptions: BTreeMap<u32, Topic>,
    /// Streams of the run that are subscribed to, with their numbers once these are known.
    streams: BTreeMap<&'static str, Option<u64>>,
    /// Requests to the run without a reply, by number.
    asked: HashMap<u64, Asked>,
    requests: u64,
    /// The objects of the world that the client knows; `None`: it knows nothing yet.
    world: Option<BTreeMap<String, WorldObject>>,
    /// Messages that the client lost, and when it was last informed.
    lost: (u64, Option<Instant>),
}

impl Session<'_> {
    /// Serves the client until one end is gone.
    async fn pump(&mut self, mut lines: Lines<BufReader<OwnedReadHalf>>, mut orders: mpsc::Receiver<Order>) -> Stopped {
        let Err(stopped) = self.serve(&mut lines, &mut orders).await;
        stopped
    }

    async fn serve(
        &mut self,
        lines: &mut Lines<BufReader<OwnedReadHalf>>,
        orders: &mut mpsc::Receiver<Order>,
    ) -> Result<std::convert::Infallible, Stopped> {
        self.ask(Asked::Description, RobotDescription {}).await?;
        self.ask(Asked::Status, Status {}).await?;
        // The first message names the run, and a subscription gets the description at once.
        while !self.asked.is_empty() {
            self.line(next(lines).await?).await?;
        }
        let mut beat = interval(BEAT);
        beat.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut beats = 0;
        loop {
            tokio::select! {
                line = next(lines) => self.line(line?).await?,
                Some(order) = orders.recv() => self.order(order).await?,
                _ = beat.tick() => {
                    self.poll(beats).await?;
                    beats += 1;
                }
            }
        }
    }

    /// Asks the run what it does not stream, unless the reply before has not come yet.
    async fn poll(&mut self, beats: u64) -> Result<(), Stopped> {
        if self.wants(Topic::Tf) {
            self.ask(Asked::Transforms, Transforms {}).await?;
        }
        if self.wants(Topic::Markers) && (beats.is_multiple_of(WORLD_BEATS) || self.world.is_none()) {
            self.ask(Asked::World, World {}).await?;
        }
        if self.wants(Topic::Diagnostics) && beats.is_multiple_of(DIAGNOSTICS_BEATS) {
            self.ask(Asked::Status, Status {}).await?;
        }
        Ok(())
    }

    fn wants(&self, topic: Topic) -> bool {
        self.subscriptions.values().any(|own| *own == topic)
    }

    async fn order(&mut self, order: Order) -> Result<(), Stopped> {
        match order {
            Order::Subscribe(wanted) => {
                for (id, channel) in wanted {
                    self.subscribe(id, channel).await?;
                }
            }
            Order::Unsubscribe(ids) => self.subscriptions.retain(|id, _| !ids.contains(id)),
            Order::FetchAsset(request, uri) => return self.fetch(request, uri).await,
            Order::Refused(why) => return self.send(protocol::status(Severity::Error, &why, None)).await,
        }
        self.settle().await
    }

    /// Adds a subscription, and sends what is latched.
    async fn subscribe(&mut self, id: u32, channel: usize) -> Result<(), Stopped> {
        let why = match Topic::ALL.get(channel).copied() {
            None => format!("channel {channel} does not exist"),
            Some(topic) if self.wants(topic) => format!("channel {channel} is subscribed to already"),
            Some(_) if self.subscriptions.contains_key(&id) => format!("subscription {id} exists already"),
            Some(topic) => {
                self.subscriptions.insert(id, topic);
                return self.latched(topic).await;
            }
        };
        self.send(protocol::status(Severity::Error, &why, None)).await
    }

    async fn latched(&mut self, topic: Topic) -> Result<(), Stopped> {
        let stamp = now();
        match topic {
            Topic::RobotDescription => match self.described.urdf.as_deref().map(assets::fetchable) {
                Some(data) => self.publish(topic, stamp, encoded(&Text { data })).await,
                None => self.send(protocol::status(Severity::Info, "this run has no robot model", None)).await,
            },
            Topic::TfStatic => {
                let fixed = ros_messages::transforms(self.described.fixed.clone(), stamp);
                self.publish(topic, stamp, encoded(&fixed)).await
            }
            Topic::Markers => {
                self.world = None;
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Subscribes to the streams of the run that are wanted, and to no others.
    async fn settle(&mut self) -> Result<(), Stopped> {
        for (stream, topics) in [
            (Stream::CoordinatorJointState, &[Topic::JointStates][..]),
            (Stream::Events, &[Topic::Events, Topic::Rosout]),
        ] {
            let wanted = topics.iter().any(|topic| self.wants(*topic));
            match self.streams.get(stream.name()).copied() {
                None if wanted => {
                    self.streams.insert(stream.name(), None);
                    let rate = (stream == Stream::CoordinatorJointState).then_some(JOINT_STATES);
                    self.ask(Asked::Stream(stream), Subscribe { stream, rate, past: false }).await?;
                }
                Some(Some(subscription)) if !wanted => {
                    self.streams.remove(stream.name());
                    self.ask(Asked::Nothing, Unsubscribe { subscription }).await?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Sends a request to the run, unless the same is on its way.
    async fn ask<M: Method>(&mut self, what: Asked, params: M) -> Result<(), Stopped> {
        if what != Asked::Nothing && self.asked.values().any(|asked| *asked == what) {
            return Ok(());
        }
        self.requests += 1;
        self.asked.insert(self.requests, what);
        let line = format!("{}\n", json!({"id": self.requests, "method": M::NAME, "params": params}));
        self.run.write_all(line.as_bytes()).await.map_err(|_| Stopped::Run)
    }

    /// Takes a line of the run.
    async fn line(&mut self, line: Line) -> Result<(), Stopped> {
        if let Some(stream) = line.stream {
            self.lose(line.lost).await?;
            return match Stream::of_name(&stream) {
                Some(Stream::CoordinatorJointState) => self.joint_state(line.data).await,
                Some(Stream::Events) => self.event(line.data).await,
                None => Ok(()),
            };
        }
        // Without one, the run refuses the connection.
        let asked = self.asked.remove(&line.id.ok_or(Stopped::Run)?).unwrap_or(Asked::Nothing);
        match asked {
            Asked::Description => self.described = read(line.result).unwrap_or_default(),
            Asked::Status => return self.status(line.result).await,
            Asked::Transforms => {
                let Some(TransformsReport { stamp, transforms }) = read(line.result) else { return Ok(()) };
                let message = ros_messages::transforms(transforms, stamp);
                return self.publish(Topic::Tf, stamp, encoded(&message)).await;
            }
            Asked::World => match read::<WorldReport>(line.result) {
                Some(world) => return self.objects(world).await,
                // Without a planner, or while it does not answer, nothing new is known: what is shown stays.
                None => self.world = Some(self.world.take().unwrap_or_default()),
            },
            Asked::Stream(stream) => {
                let number = read::<SubscribeReply>(line.result).map(|reply| reply.subscription);
                self.streams.insert(stream.name(), number);
                return self.settle().await;
            }
            Asked::Nothing => {}
        }
        Ok(())
    }

    /// Sends the condition of the run; the first time, what the server is.
    async fn status(&mut self, result: Value) -> Result<(), Stopped> {
        let Some(status) = read::<StatusReport>(result) else { return Err(Stopped::Run) };
        if !self.name.is_empty() {
            let stamp = now();
            let message = ros_messages::diagnostics(&status, time(stamp));
            return self.publish(Topic::Diagnostics, stamp, encoded(&message)).await;
        }
        let simulated = status.simulated.to_string();
        let metadata = json!({"blueprint": status.blueprint, "version": status.version, "simulated": simulated});
        self.send(protocol::server_info(&status.run, &self.shared.session, &metadata)).await?;
        self.name = status.run;
        self.send(protocol::advertise(Topic::ALL.into_iter().map(Topic::channel))).await
    }

    async fn joint_state(&mut self, data: Value) -> Result<(), Stopped> {
        let Some(state) = read::<JointState>(data) else { return Ok(()) };
        let (stamp, frame_id) = (state.stamp, state.frame_id.clone());
        let message = ros_messages::joint_state(state, frame_id);
        self.publish(Topic::JointStates, stamp, encoded(&message)).await
    }

    async fn event(&mut self, data: Value) -> Result<(), Stopped> {
        let Some(report) = read::<EventReport>(data) else { return Ok(()) };
        let (stamp, line) = (report.stamp, ros_messages::log_line(&self.name, &report));
        self.publish(Topic::Events, stamp, encoded(&ros_messages::event(report))).await?;
        self.publish(Topic::Rosout, stamp, encoded(&line)).await
    }

    /// Sends what has changed in the world.
    async fn objects(&mut self, world: WorldReport) -> Result<(), Stopped> {
        let objects: BTreeMap<_, _> = world.objects.into_iter().map(|o| (o.name.clone(), o)).collect();
        let before = self.world.take().unwrap_or_default();
        let links = self.described.urdf.as_deref().map(links).unwrap_or_default();
        // As in a log: links of several robots have the robot's name before their own.
        let frame = |robot: &str, link: &str| {
            let prefixed = format!("{robot}_{link}");
            links.contains(&*prefixed).then_some(prefixed)
        };
        let (stamp, mut markers) = (now(), ros_messages::changes(&before, &objects, frame));
        for marker in &mut markers {
            assets::make_fetchable(marker);
            marker.header.stamp = time(stamp);
        }
        self.world = Some(objects);
        if markers.is_empty() {
            return Ok(());
        }
        self.publish(Topic::Markers, stamp, encoded(&MarkerArray { markers })).await
    }

    /// Counts messages that the client lost because it was slow, and informs it.
    async fn lose(&mut self, lost: u64) -> Result<(), Stopped> {
        self.lost.0 += lost;
        if lost == 0 || self.lost.1.is_some_and(|last| last.elapsed() < LOSS_PERIOD) {
            return Ok(());
        }
        self.lost.1 = Some(Instant::now());
        let text = format!("this viewer is too slow: {} messages were dropped", self.lost.0);
        self.send(protocol::status(Severity::Warning, &text, Some("lost"))).await
    }

    async fn fetch(&mut self, request: u32, uri: String) -> Result<(), Stopped> {
        let listing = || async {
            let subject = self.shared.subject.clone();
            spawn_blocking(move || Arc::new(subject.meshes())).await
        };
        let content = match self.shared.meshes.get_or_try_init(listing).await.cloned() {
            Ok(meshes) => {
                let subject = self.shared.subject.clone();
                spawn_blocking(move || assets::read(&*subject, &meshes, &uri)).await
            }
            Err(error) => Err(error),
        };
        let content = content.unwrap_or_else(|_| Err("this cannot be read".to_owned()));
        let message = protocol::asset(request, content.as_deref().map_err(String::as_str));
        self.send_within(message, ASSET_TIMEOUT).await
    }

    /// Sends a message of a channel, if the client subscribes to it. `stamp`: [s since the Unix epoch].
    async fn publish(&mut self, topic: Topic, stamp: f64, payload: Vec<u8>) -> Result<(), Stopped> {
        let subscription = self.subscriptions.iter().find(|(_, own)| **own == topic).map(|(id, _)| *id);
        match subscription {
            Some(id) => self.send(protocol::data(id, nanoseconds(stamp), &payload)).await,
            None => Ok(()),
        }
    }

    async fn send(&mut self, message: Message) -> Result<(), Stopped> {
        self.send_within(message, SEND_TIMEOUT).await
    }

    async fn send_within(&mut self, message: Message, limit: Duration) -> Result<(), Stopped> {
        let sent = timeout(limit, self.to.send(message)).await;
        sent.ok().and_then(Result::ok).ok_or(Stopped::Client)
    }
}

/// Waits for the next line of the run.
async fn next(lines: &mut Lines<BufReader<OwnedReadHalf>>) -> Result<Line, Stopped> {
    let line = lines.next_line().await.ok().flatten().ok_or(Stopped::Run)?;
    serde_json::from_str(&line).map_err(|_| Stopped::Run)
}

/// Reads a reply; `None`: the run refused the request.
fn read<T: DeserializeOwned>(result: Value) -> Option<T> {
    serde_json::from_value(result).ok()
}

/// Returns the names of a description's links.
fn links(urdf: &str) -> BTreeSet<&str> {
    urdf.split("<link name=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect()
}
