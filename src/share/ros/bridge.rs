//! The bridge itself: joins the router of ROS when it is there, and serves.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use zenoh::{Session, Wait};

use super::action::{self, Action};
use super::follow::Way;
use super::node::Node;
use super::publish::{Source, publish};
use super::services::{Services, of_ends, of_lists};
use crate::blueprint::share::{OnLost, RosConfig, ShareConfig, is_ros_name};
use crate::share::settings;
use dimos_core::sync::lock;
use dimos_rpc::api::{FaceReport, OnBehalfOf, Status};
use dimos_rpc::client::Client;
use dimos_rpc::error::{Code, RpcError};

/// Requests of services that may wait.
const QUEUE: usize = 32;
/// Period of the check whether the router is there.
const PERIOD: Duration = Duration::from_millis(200);
/// Name of this bridge in reports.
const BRIDGE: &str = "ros";
/// What the run shows as the commander of an arm.
const COMMANDER: &str = "ROS 2";

/// The bridge of a run to ROS 2. Ends when dropped.
pub struct Bridge {
    core: Arc<Core>,
}

struct Core {
    run: String,
    socket: PathBuf,
    config: RosConfig,
    on_lost: OnLost,
    may_end: bool,
    /// The trajectory tasks that have an action.
    tasks: Vec<String>,
    ended: Arc<AtomicBool>,
    /// Why it does not serve; `None`: it does.
    down: Mutex<Option<String>>,
    open: Mutex<Option<Open>>,
}

/// What is open while it serves.
struct Open {
    node: Arc<Node>,
    actions: Vec<Arc<Action>>,
}

impl Bridge {
    /// Starts the bridge of a run. It serves once the router is there, also when that comes later. `changed` is called
    /// when its report changes.
    pub fn start(
        (run, socket): (&str, &Path),
        share: &ShareConfig,
        config: &RosConfig,
        changed: impl Fn() + Send + 'static,
    ) -> Result<Self, RpcError> {
        let failed = |e: String| RpcError::new(Code::Internal, format!("ros: {e}"));
        let status = Client::connect(run, socket).and_then(|mut client| client.call(Status {}));
        let tasks = status.map_err(|e| failed(e.to_string()))?.tasks.into_iter().filter(|task| task.takes("execute"));
        let (tasks, others): (Vec<String>, Vec<String>) =
            tasks.map(|task| task.name).partition(|name| is_ros_name(name));
        if !others.is_empty() {
            let names = others.join(", ");
            tracing::warn!("share: ros: no action for {names}: names of ROS have letters, digits and '_' only");
        }
        let core = Arc::new(Core {
            run: run.to_owned(),
            socket: socket.to_owned(),
            config: config.clone(),
            on_lost: share.on_lost,
            may_end: config.command || share.observers_stop,
            tasks,
            ended: Arc::default(),
            down: Mutex::new(Some(no_router(config))),
            open: Mutex::new(None),
        });
        let settings = settings::of_ros(config, share.identity.as_ref())?;
        let served = core.clone();
        let serve = move || {
            // Waits for the router.
            let result = zenoh::open(settings).wait().and_then(|session| served.serve(session, &changed));
            if let Err(error) = result {
                tracing::error!("share: ros: {error}");
                *lock(&served.down) = Some(error.to_string());
                changed();
            }
        };
        std::thread::Builder::new().name("ros-bridge".into()).spawn(serve).map_err(|e| failed(e.to_string()))?;
        Ok(Self { core })
    }

    /// Returns its report.
    pub fn report(&self) -> FaceReport {
        report(&self.core.config, lock(&self.core.down).clone())
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        self.core.ended.store(true, Ordering::Release);
        let Some(open) = lock(&self.core.open).take() else { return };
        open.actions.iter().for_each(|action| action.end());
        open.node.close();
    }
}

/// Returns the report of a bridge. `down`: why it does not serve.
pub fn report(config: &RosConfig, down: Option<String>) -> FaceReport {
    let namespace = if config.namespace.is_empty() { String::new() } else { format!("/{}", config.namespace) };
    FaceReport {
        face: BRIDGE.into(),
        name: format!("{namespace}/{}", super::names::NODE),
        serves: down.is_none(),
        command: config.command,
        reason: down,
    }
}

fn no_router(config: &RosConfig) -> String {
    format!("no router at {} (hint: ros2 run rmw_zenoh_cpp rmw_zenohd)", config.router)
}

impl Core {
    /// Serves until the bridge ends.
    fn serve(&self, session: Session, changed: &impl Fn()) -> zenoh::Result<()> {
        let node = Arc::new(Node::new(session, &self.config)?);
        let actions = self.declare(&node)?;
        {
            let mut open = lock(&self.open);
            // Nothing may be left open by a bridge that has ended meanwhile.
            if self.ended.load(Ordering::Acquire) {
                node.close();
                return Ok(());
            }
            *open = Some(Open { node: node.clone(), actions });
        }
        while !self.ended.load(Ordering::Acquire) {
            let is_there = node.session.info().routers_zid().wait().next().is_some();
            if is_there == lock(&self.down).is_some() {
                *lock(&self.down) = (!is_there).then(|| no_router(&self.config));
                changed();
            }
            std::thread::sleep(PERIOD);
        }
        Ok(())
    }

    /// Declares all parts of the node.
    fn declare(&self, node: &Node) -> zenoh::Result<Vec<Arc<Action>>> {
        let source = Source { run: self.run.clone(), socket: self.socket.clone(), ended: self.ended.clone() };
        publish(node, &source)?;
        let services = Services {
            run: self.run.clone(),
            socket: self.socket.clone(),
            distro: self.config.distro,
            may_end: self.may_end,
        };
        for (thread, list) in [("ros-ends", of_ends()), ("ros-lists", of_lists(self.config.distro))] {
            let (queue, requests) = sync_channel(QUEUE);
            let served = services.clone();
            std::thread::Builder::new().name(thread.into()).spawn(move || served.serve(requests))?;
            for (name, service, of) in list {
                node.serve(name, of, service, queue.clone())?;
            }
        }
        self.declare_actions(node)
    }

    fn declare_actions(&self, node: &Node) -> zenoh::Result<Vec<Arc<Action>>> {
        let mut actions = Vec::new();
        for task in &self.tasks {
            let behalf = OnBehalfOf { client: COMMANDER.into(), cancel_at_end: self.on_lost == OnLost::Cancel };
            let way = Way { run: self.run.clone(), socket: self.socket.clone(), task: task.clone(), behalf };
            actions.push(Arc::new(Action::new(node, way, self.config.command, self.config.distro)?));
        }
        let weak: Vec<_> = actions.iter().map(Arc::downgrade).collect();
        let (queue, requests): (SyncSender<_>, _) = sync_channel(QUEUE);
        std::thread::Builder::new().name("ros-goals".into()).spawn(move || action::serve(&weak, requests))?;
        for (index, task) in self.tasks.iter().enumerate() {
            for (part, service, of) in action::SERVICES {
                node.serve(&format!("{}/_action/{part}", action::name(task)), of, (index, service), queue.clone())?;
            }
        }
        Ok(actions)
    }
}
