//! A planner in its own process, attached to a run: registers over the run's socket, answers the run's requests, and
//! reconnects when the run is back.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::mpsc::{Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::sync::oneshot;

use super::PlannerPort;
use super::planner_link::answer_encoded;
use super::planner_port::registered;
use crate::metrics::AttachedFigures;
use crate::runtime::StartError;
use crate::runtime::start::robots;
use dimos_planner::planning::scene::config::PlannerConfig;
use dimos_planner::planning::scene::planning_scene::PlanningScene;
use dimos_rpc::api::{RegisterPlanner, RegisteredRobot};
use dimos_rpc::client::planner_stub::{PlannerStub, RegisterError};
use dimos_rpc::error::Code;

/// First pause before a reconnect; each further one is twice as long.
const FIRST_PAUSE: Duration = Duration::from_millis(200);
/// Longest pause.
const LONGEST_PAUSE: Duration = Duration::from_millis(400);

/// Change of the connection to the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LinkEvent {
    /// The run is back, and the planner is attached again.
    Back,
    /// The run is gone, or rejects the planner, for this reason. The planner keeps trying.
    Fault(String),
}

/// An attached planner. Shuts down when dropped.
pub struct AttachedPlanner {
    robots: Vec<RegisteredRobot>,
    link: Arc<Link>,
    port: Arc<PlannerPort>,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl AttachedPlanner {
    /// Reads the robots' descriptions and attaches to the run at this socket, as `name`. `report` receives later
    /// changes of the connection, on a thread of the planner.
    pub fn start(
        name: &str,
        config: &PlannerConfig,
        socket: &Path,
        report: impl FnMut(LinkEvent) + Send + 'static,
    ) -> Result<Self, StartError> {
        let setup = robots(config)?;
        let robots = registered(&setup);
        let registration = RegisterPlanner { name: name.to_owned(), robots: robots.clone() };
        let link = Arc::<Link>::default();
        let process = Process { config: config.clone(), registration, socket: socket.to_owned(), link: link.clone() };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build();
        let runtime = runtime.map_err(|e| StartError::other(e, "see ulimit -n"))?;
        let (stop, stopped) = oneshot::channel();
        let (ready, begun) = channel();
        let thread = std::thread::Builder::new().name("attached".into()).spawn(move || {
            runtime.block_on(async {
                tokio::select! {
                    () = process.live(setup, &ready, report) => {}
                    _ = stopped => {}
                }
            });
            // Reading a large file does not delay the shutdown.
            runtime.shutdown_background();
        });
        let thread = thread.map_err(|e| StartError::other(e, "see ulimit -u"))?;
        match begun.recv() {
            Ok(Ok(port)) => Ok(Self { robots, link, port, stop: Some(stop), thread: Some(thread) }),
            Ok(Err(error)) => Err(error),
            Err(_) => Err(StartError::other("the planner's thread ended: a defect of the program", "see `dimos logs`")),
        }
    }

    /// Returns the robots that it plans for.
    pub fn robots(&self) -> &[RegisteredRobot] {
        &self.robots
    }

    /// Returns a function for the present figures of its metrics; `of` has those that do not change.
    pub fn figures(&self, of: AttachedFigures) -> impl Fn() -> Option<AttachedFigures> + Send + Sync + use<> {
        let (link, port) = (self.link.clone(), Arc::downgrade(&self.port));
        move || {
            let port = port.upgrade()?;
            Some(AttachedFigures {
                attached: !link.is_lost.load(Relaxed),
                lost: link.lost.load(Relaxed),
                age: port.age().map(|age| age.as_secs_f64()),
                plans: port.figures(),
                ..of.clone()
            })
        }
    }
}

/// The connection to the run.
#[derive(Debug, Default)]
struct Link {
    /// Whether it is lost now.
    is_lost: AtomicBool,
    /// How often it was lost.
    lost: AtomicU64,
}

impl Drop for AttachedPlanner {
    fn drop(&mut self) {
        if let Some(stop) = self.stop.take() {
            let _ = stop.send(());
        }
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Process {
    config: PlannerConfig,
    registration: RegisterPlanner,
    socket: PathBuf,
    link: Arc<Link>,
}

impl Process {
    /// Attaches, reports it, and answers requests until the connection ends.
    async fn live(
        self,
        setup: PlanningScene,
        ready: &Sender<Result<Arc<PlannerPort>, StartError>>,
        mut report: impl FnMut(LinkEvent),
    ) {
        let begun = async {
            let end = PlannerStub::register(&self.socket, &self.registration).await.map_err(refused)?;
            let limits = &end.registered.limits;
            let port = PlannerPort::start(&self.config, setup, limits, None).map_err(|what| {
                let hint =
                    "the limits of the model and of the run must overlap; check that the model belongs to this arm";
                StartError::other(what, hint)
            })?;
            Ok((end, Arc::new(port)))
        };
        let (mut end, port) = match begun.await {
            Ok(begun) => begun,
            Err(error) => return drop(ready.send(Err(error))),
        };
        let limits = end.registered.limits.clone();
        let _ = ready.send(Ok(port.clone()));
        loop {
            let answering = port.clone();
            let lost = end.serve(move |asked| {
                let port = answering.clone();
                async move { answer_encoded(&port, asked).await }
            });
            let lost = lost.await;
            // Numbers of plans are not valid in the next run.
            port.thread.forget();
            self.link.lost.fetch_add(1, Relaxed);
            self.link.is_lost.store(true, Relaxed);
            report(LinkEvent::Fault(format!("the run is gone ({lost})")));
            end = self.again(&limits, &mut report).await;
            self.link.is_lost.store(false, Relaxed);
            port.thread.forget();
            report(LinkEvent::Back);
        }
    }

    /// Retries until the run is back and accepts the planner. A refusal is reported once.
    async fn again(&self, limits: &Limits, report: &mut impl FnMut(LinkEvent)) -> PlannerStub {
        let (mut pause, mut last) = (FIRST_PAUSE, String::new());
        loop {
            tokio::time::sleep(pause).await;
            pause = (2 * pause).min(LONGEST_PAUSE);
            let why = match PlannerStub::register(&self.socket, &self.registration).await {
                Ok(end) if end.registered.limits == *limits => return end,
                Ok(_) => "the run has other limits now: start the planner again".to_owned(),
                Err(RegisterError::Io(_)) => continue,
                // Still not there, on another computer.
                Err(RegisterError::Refused(refusal)) if is_away(refusal.code) => continue,
                Err(RegisterError::Refused(refusal)) => refusal.message,
            };
            if why != last {
                report(LinkEvent::Fault(why.clone()));
                last = why;
            }
        }
    }
}

type Limits = std::collections::BTreeMap<String, dimos_rpc::api::CommandLimits>;

fn is_away(code: Code) -> bool {
    matches!(code, Code::Unreachable | Code::Lost | Code::ShuttingDown)
}

fn refused(why: RegisterError) -> StartError {
    match why {
        RegisterError::Io(error) => {
            StartError::other(format!("the run cannot be reached: {error}"), "`dimos status` shows it")
        }
        RegisterError::Refused(refusal) => {
            let hint = refusal.hint.clone().unwrap_or_else(|| "`dimos status` shows what the run has".to_owned());
            StartError::other(format!("{} [{}]", refusal.message, refusal.code.name()), hint)
        }
    }
}
