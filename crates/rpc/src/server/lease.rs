//! Leases: only one connection at a time can command an arm.
//!
//! A connection takes the lease of an arm with its first accepted motion request, or with `lease`, and holds it until
//! `release` or its end. The run learns when one is taken and when it ends: then its chunks end, and what was
//! requested but has not begun does not begin. A stream of targets times out, and a trajectory that has begun
//! continues.

use std::collections::BTreeMap;
use std::fmt::{self, Debug, Formatter};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, Weak};
use std::time::Instant;

use serde_json::json;

use crate::api::{
    Backend, ExecutePlan, FaceReport, GatewayReport, Go, Lease, Method, Presence, RegisterGateway, Reply, Request,
};
use crate::error::{Code, RpcError};
use crate::report::CommanderReport;
use crate::server::who::Peer;
use dimos_core::sync::lock;
use dimos_core::telemetry::Who;

/// The arms that a request concerns, for [`Backend::arms_of`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Subject<'a> {
    /// All arms of the run.
    All,
    /// The arm with this `hardware_id`.
    Arm(&'a str),
    /// The arms whose joints this task may claim.
    Task(&'a str),
    /// The arms of these joints.
    Joints(&'a [String]),
}

/// Lease that a request requires.
#[derive(Debug, PartialEq)]
pub(crate) enum Need<'a> {
    /// None: it reads, plans, or ends motion.
    Nothing,
    /// The lease, taken if it is free: the request moves an arm.
    Lease(Subject<'a>),
    /// The leases of the arms that a plan moves; without a number, the newest plan's.
    Plan(Option<u64>),
    /// Those of what it moves, when that begins: it gets its [`Claimant`].
    AtEachStep,
    /// No lease, but no other connection may hold it: the request changes whether the arm accepts motion.
    NoOtherHolder(Subject<'a>),
    /// The same, for the arm whose load the request changes with an object of known mass.
    NoOtherHolderOfLoad,
}

impl<'a> Need<'a> {
    /// The lease of an arm.
    pub fn of_arm(arm: &'a str) -> Self {
        Self::Lease(Subject::Arm(arm))
    }

    /// The leases of a task's arms.
    pub fn of_task(task: &'a str) -> Self {
        Self::Lease(Subject::Task(task))
    }

    /// The leases of the arms of these joints.
    pub fn of_joints(joints: &'a [String]) -> Self {
        Self::Lease(Subject::Joints(joints))
    }

    /// No lease, but no other holder of an arm's.
    pub fn no_other_of(arm: &'a str) -> Self {
        Self::NoOtherHolder(Subject::Arm(arm))
    }

    /// What an object of this mass needs, if that is known [kg].
    pub fn of_load(mass: Option<f64>) -> Self {
        mass.map_or(Self::Nothing, |_| Self::NoOtherHolderOfLoad)
    }
}

/// Holder of an arm's lease.
#[derive(Debug, Clone)]
struct Holder {
    connection: u64,
    who: Arc<Who>,
    since: Instant,
    /// A request was accepted under it, or `lease` took it: it remains until it is released.
    kept: bool,
}

impl Holder {
    fn report(&self) -> CommanderReport {
        let held_for = self.since.elapsed().as_secs_f64();
        CommanderReport { pid: self.who.pid, program: self.who.program.clone(), held_for }
    }
}

/// The leases of a run, by arm, and its gateway.
#[derive(Default)]
pub(crate) struct Leases {
    holders: Mutex<BTreeMap<String, Holder>>,
    gateway: Mutex<Option<Gateway>>,
    /// The run; `None` in tests.
    run: Option<Arc<dyn Backend>>,
}

impl Debug for Leases {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.debug_struct("Leases").field("holders", &self.holders).field("gateway", &self.gateway).finish_non_exhaustive()
    }
}

/// The gateway of a run.
#[derive(Debug)]
struct Gateway {
    /// The connection that registered it.
    connection: u64,
    /// Whether it does not listen yet.
    starting: bool,
    report: GatewayReport,
}

impl Leases {
    /// Creates the leases of a run, all free.
    pub fn new(run: Arc<dyn Backend>) -> Self {
        Self { run: Some(run), ..Self::default() }
    }

    fn ended(&self, arm: &str, connection: u64) {
        if let Some(run) = &self.run {
            run.lease_ended(arm, connection);
        }
    }

    /// Reports to the run what it was not asked for.
    fn refused(&self, method: &'static str, error: &RpcError) {
        if let Some(run) = &self.run {
            run.refused(method, error);
        }
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Holder>> {
        lock(&self.holders)
    }

    /// Returns whether a connection holds the lease of any arm.
    pub fn holds(&self, connection: u64) -> bool {
        self.lock().values().any(|holder| holder.connection == connection)
    }

    /// Releases the leases of a connection that has ended; `alive` is what its presence observes.
    pub fn end_connection(&self, connection: u64, alive: Arc<()>) {
        let mut held = self.lock();
        drop(alive);
        held.retain(|arm, holder| {
            let ends = holder.connection == connection;
            if ends {
                self.ended(arm, connection);
            }
            !ends
        });
        drop(held);
        lock(&self.gateway).take_if(|gateway| gateway.connection == connection);
    }

    /// Takes the leases of arms for a connection: all of them, or none.
    fn claim(
        &self,
        (connection, who): (u64, &Arc<Who>),
        held: &mut BTreeMap<String, Holder>,
        arms: &[String],
        kept: bool,
    ) -> Result<(), RpcError> {
        check(connection, arms, held)?;
        // The tick learns of a lease that a request takes with that request, if it accepts it.
        if let Some(run) = self.run.as_ref().filter(|_| kept) {
            arms.iter().try_for_each(|arm| run.lease_taken(arm, connection))?;
        }
        for arm in arms {
            match held.get_mut(arm) {
                Some(holder) => holder.kept |= kept,
                None => {
                    let (who, since) = (who.clone(), Instant::now());
                    held.insert(arm.clone(), Holder { connection, who, since, kept });
                }
            }
        }
        Ok(())
    }

    /// Keeps the leases of a connection whose request was accepted; else releases those that it took.
    fn settle(&self, connection: u64, arms: &[String], accepted: bool) {
        if arms.is_empty() {
            return;
        }
        let mut held = self.lock();
        for arm in arms {
            match held.get_mut(arm).filter(|holder| holder.connection == connection) {
                Some(holder) if accepted => holder.kept = true,
                Some(Holder { kept: false, .. }) => drop(held.remove(arm)),
                _ => {}
            }
        }
    }

    /// Adds the lease holders and the gateway to a `status` reply.
    pub fn complete(&self, mut reply: Reply) -> Reply {
        if let Reply::Status(status) = &mut reply {
            let gateway = lock(&self.gateway);
            let listening = gateway.as_ref().filter(|gateway| !gateway.starting);
            status.share = listening.map(|gateway| Box::new(gateway.report.clone()));
            let held = self.lock();
            for arm in &mut status.arms {
                arm.commander = held.get(&arm.hardware_id).map(Holder::report);
            }
        }
        reply
    }
}

/// The leases of one connection. Dropping it releases them.
#[derive(Debug)]
pub(crate) struct Lessee {
    leases: Arc<Leases>,
    connection: u64,
    peer: Peer,
    /// Who that is, once it has asked for something; the client, if it is a connection of a gateway.
    who: OnceLock<Arc<Who>>,
    /// Dropped with the connection.
    alive: Arc<()>,
}

impl Lessee {
    /// Creates a lessee without leases. `connection` is unique within the run; `peer` is the client's process.
    pub fn new(leases: Arc<Leases>, connection: u64, peer: Peer) -> Self {
        Self { leases, connection, peer, who: OnceLock::new(), alive: Arc::default() }
    }

    /// Returns the connection's number.
    pub fn connection(&self) -> u64 {
        self.connection
    }

    /// Returns the client's process, if the system reports it.
    pub fn pid(&self) -> Option<i32> {
        self.peer.pid
    }

    /// Returns who asks on this connection.
    pub fn who(&self) -> Arc<Who> {
        self.who.get_or_init(|| Arc::new(self.peer.who())).clone()
    }

    /// The same for a stop, which never waits.
    pub fn who_at_once(&self, verb: &str) -> Arc<Who> {
        self.who.get().cloned().unwrap_or_else(|| Arc::new(self.peer.at_once(verb)))
    }

    /// Shows another name than that of the process to those who ask who commands an arm.
    pub fn set_client(&mut self, client: String) {
        self.who = OnceLock::from(Arc::new(Who { program: client, ..self.peer.who() }));
    }

    /// Returns whether this connection holds the leases of all these arms.
    pub fn holds_all(&self, arms: &[String]) -> bool {
        let held = self.leases.lock();
        arms.iter().all(|arm| held.get(arm).is_some_and(|holder| holder.connection == self.connection))
    }

    /// Makes this connection that of the run's gateway, or updates what it says of itself. Fails if the run has another
    /// one. Returns the faces that serve no more.
    pub fn register_gateway(&self, gateway: RegisterGateway) -> Result<Vec<FaceReport>, RpcError> {
        let mut registered = lock(&self.leases.gateway);
        if let Some(Gateway { report: other, .. }) = registered.as_ref().filter(|own| own.connection != self.connection)
        {
            let process = other.pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default();
            let faces = other.faces.iter().map(|face| face.face.as_str());
            let places: Vec<&str> = other.endpoints.iter().map(String::as_str).chain(faces).collect();
            let text = format!("the run is shared already at {}{process}", places.join(", "));
            return Err(
                RpcError::new(Code::HasGateway, text).hint("end that `dimos share` first: a run has one gateway")
            );
        }
        let RegisterGateway { endpoints, clients, faces, starting } = gateway;
        let known = registered.take().map(|known| known.report.faces).unwrap_or_default();
        let fallen = faces.iter().filter(|face| !face.serves && !known.contains(face)).cloned().collect();
        let report = GatewayReport { pid: self.peer.pid, endpoints, clients, faces };
        *registered = Some(Gateway { connection: self.connection, starting, report });
        Ok(fallen)
    }

    /// Returns the leases of the run.
    pub fn leases(&self) -> &Arc<Leases> {
        &self.leases
    }

    /// Takes the leases that a request requires; fails if another connection holds one. A request for the newest plan
    /// gets its number, so that the plan whose arms are leased is the one that is executed.
    ///
    /// Returns the request and the leased arms; afterwards call [`settle`](Self::settle) with them.
    pub async fn admit(&self, request: Request, backend: &dyn Backend) -> Result<(Request, Vec<String>), RpcError> {
        let method = request.method();
        self.admitted(request, backend).await.inspect_err(|error| self.leases.refused(method, error))
    }

    async fn admitted(&self, request: Request, backend: &dyn Backend) -> Result<(Request, Vec<String>), RpcError> {
        match request.need() {
            Need::Nothing => {}
            Need::Lease(subject) => {
                let arms = backend.arms_of(subject);
                self.claim(&arms, false)?;
                return Ok((request, arms));
            }
            Need::NoOtherHolder(subject) => self.check(&backend.arms_of(subject), &self.leases.lock())?,
            Need::NoOtherHolderOfLoad => {
                let arms = backend.arms_of_load(&request).await?;
                self.check(&arms, &self.leases.lock())?;
            }
            Need::Plan(plan) => {
                let (plan, joints) = backend.plan_of(plan).await?;
                let arms = backend.arms_of(Subject::Joints(&joints));
                self.claim(&arms, false)?;
                let Request::ExecutePlan(execute) = request else { return Ok((request, arms)) };
                let presence = Some(Presence::of(&self.alive));
                return Ok((Request::ExecutePlan(ExecutePlan { plan: Some(plan), presence, ..execute }), arms));
            }
            Need::AtEachStep => {
                let Request::Go(go) = request else { return Ok((request, Vec::new())) };
                return Ok((Request::Go(Go { claimant: Some(self.claimant()), ..go }), Vec::new()));
            }
        }
        Ok((request, Vec::new()))
    }

    /// Ends a request that required the leases of these arms: keeps them if it was accepted, otherwise releases those
    /// that it took.
    pub fn settle(&self, arms: &[String], accepted: bool) {
        self.leases.settle(self.connection, arms, accepted);
    }

    /// Takes the leases of arms: all of them, or none.
    pub fn take(&self, arms: &[String]) -> Result<(), RpcError> {
        self.claim(arms, true).inspect_err(|error| self.leases.refused(Lease::NAME, error))
    }

    fn claim(&self, arms: &[String], kept: bool) -> Result<(), RpcError> {
        self.leases.claim((self.connection, &self.who()), &mut self.leases.lock(), arms, kept)
    }

    /// Returns what claims leases for this connection later.
    fn claimant(&self) -> Claimant {
        let (leases, connection, who) = (Arc::downgrade(&self.leases), self.connection, self.who());
        Claimant { leases, connection, who, presence: Presence::of(&self.alive) }
    }

    /// Releases the leases of arms, as far as this connection holds them; returns the released arms.
    pub fn release(&self, arms: &[String]) -> Vec<String> {
        let mut held = self.leases.lock();
        let mine = |arm: &&String| held.get(*arm).is_some_and(|h| h.connection == self.connection);
        let released: Vec<String> = arms.iter().filter(mine).cloned().collect();
        for arm in &released {
            self.leases.ended(arm, self.connection);
            held.remove(arm);
        }
        released
    }

    fn check(&self, arms: &[String], held: &BTreeMap<String, Holder>) -> Result<(), RpcError> {
        check(self.connection, arms, held)
    }
}

impl Drop for Lessee {
    fn drop(&mut self) {
        self.leases.end_connection(self.connection, std::mem::take(&mut self.alive));
    }
}

/// Fails if another connection holds the lease of one of these arms.
fn check(connection: u64, arms: &[String], held: &BTreeMap<String, Holder>) -> Result<(), RpcError> {
    let other = |arm: &&String| held.get(*arm).is_some_and(|h| h.connection != connection);
    let Some((arm, holder)) = arms.iter().find(other).and_then(|arm| Some((arm, held.get(arm)?))) else {
        return Ok(());
    };
    let CommanderReport { pid, program, held_for } = holder.report();
    let process = pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default();
    let text = format!("{arm} is commanded by {program}{process} for {held_for:.1} s");
    Err(RpcError::new(Code::LeaseHeld, text)
        .hint("wait until it ends or releases the arm, or end it; `dimos stop` and `dimos cancel` always work")
        .data(json!({"arm": arm, "pid": pid, "program": program, "held_for": held_for})))
}

/// A connection whose request the run carries out step by step: claims the leases of each step when it begins.
#[derive(Debug, Clone)]
pub struct Claimant {
    /// The run keeps claimants: it must not keep itself alive by them.
    leases: Weak<Leases>,
    connection: u64,
    who: Arc<Who>,
    presence: Presence,
}

impl PartialEq for Claimant {
    fn eq(&self, other: &Self) -> bool {
        self.presence == other.presence
    }
}

impl Claimant {
    /// Returns what observes whether the connection is open.
    pub fn presence(&self) -> &Presence {
        &self.presence
    }

    /// Answers a request for this method under the leases of these arms: taken if they are free, kept if it is
    /// accepted. Fails if another connection holds one, or if this one has ended.
    pub async fn command<T>(
        &self,
        arms: &[String],
        method: &'static str,
        answer: impl Future<Output = Result<T, RpcError>>,
    ) -> Result<T, RpcError> {
        let over = || RpcError::new(Code::Superseded, "the connection that requested it has ended");
        let leases = self.leases.upgrade().ok_or_else(over)?;
        {
            let mut held = leases.lock();
            // Its leases end under this lock: none is taken after it.
            if self.presence.is_over() {
                return Err(over());
            }
            let claimed = leases.claim((self.connection, &self.who), &mut held, arms, false);
            claimed.inspect_err(|error| leases.refused(method, error))?;
        }
        let result = answer.await;
        leases.settle(self.connection, arms, may_take_effect(&result));
        result
    }
}

/// Returns whether a request may take effect: it was accepted, or not answered in time.
pub(crate) fn may_take_effect<T>(result: &Result<T, RpcError>) -> bool {
    result.as_ref().map_or_else(|error| error.code == Code::NoAnswer, |_| true)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn own() -> Peer {
        Peer { pid: Some(std::process::id() as i32), uid: None }
    }

    fn names(arms: &[&str]) -> Vec<String> {
        arms.iter().map(|arm| (*arm).to_owned()).collect()
    }

    #[test]
    fn leases_are_taken_all_or_none_and_released_with_the_connection() {
        let leases = Arc::new(Leases::default());
        let lessee = |connection| Lessee::new(leases.clone(), connection, own());
        let (one, two) = (lessee(1), lessee(2));
        one.take(&names(&["left"])).unwrap();
        one.take(&names(&["left"])).unwrap();
        let refusal = two.take(&names(&["right", "left"])).unwrap_err();
        assert_eq!(refusal.code, Code::LeaseHeld);
        let pid = format!("(pid {})", std::process::id());
        assert!(refusal.message.contains("left is commanded by ") && refusal.message.contains(&pid), "{refusal}");
        one.take(&names(&["right"])).unwrap();
        assert_eq!(two.release(&names(&["left", "right"])), names(&[]));
        assert_eq!(one.release(&names(&["right", "third"])), names(&["right"]));
        drop(one);
        two.take(&names(&["left", "right"])).unwrap();
    }

    #[test]
    fn a_refused_request_keeps_no_lease() {
        let leases = Arc::new(Leases::default());
        let (one, arms) = (Lessee::new(leases.clone(), 1, Peer::default()), names(&["left"]));
        one.claim(&arms, false).unwrap();
        assert!(leases.holds(1), "during the request");
        one.settle(&arms, false);
        assert!(!leases.holds(1));
        one.claim(&arms, false).unwrap();
        one.settle(&arms, true);
        one.claim(&arms, false).unwrap();
        one.settle(&arms, false);
        assert!(leases.holds(1), "a later refusal does not release it");
    }
}
