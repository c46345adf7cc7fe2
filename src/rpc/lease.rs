//! One commander at a time: who may move an arm just now.
//!
//! A connection takes the lease of an arm with its first request that is taken on and moves it, or with `lease`, and
//! has it until `release` or its own end. The rest of the program knows nothing of it: a stream of targets that ends
//! with its commander goes stale like any other, and a trajectory that has begun continues.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use serde_json::json;

use super::api::{Backend, ExecutePlan, Presence, Reply, Request};
use super::error::{Code, RpcError};
use super::report::CommanderReport;
use crate::sync::lock;

/// What a request is about, for [`Backend::arms_of`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Subject<'a> {
    /// All arms of the run.
    All,
    /// The arm of this `hardware_id`.
    Arm(&'a str),
    /// The arms whose joints a task may claim.
    Task(&'a str),
    /// The arms of these joints.
    Joints(&'a [String]),
}

/// What a request needs.
#[derive(Debug, PartialEq)]
pub(super) enum Need<'a> {
    /// Nothing: it reads, or it ends motion. Both are for everyone, always.
    Nothing,
    /// The lease, which it takes where it is free: it moves an arm.
    Lease(Subject<'a>),
    /// The leases of the arms that a plan moves; without a number, the newest plan.
    Plan(Option<u64>),
    /// No other client may command the arm: the request changes what the arm is ready for.
    Peace(Subject<'a>),
}

/// What a request needs of the leases.
pub(super) fn need(request: &Request) -> Need<'_> {
    match request {
        Request::Move(m) => Need::Lease(Subject::Arm(&m.arm)),
        Request::Gripper(g) => Need::Lease(Subject::Arm(&g.arm)),
        Request::Execute(e) => Need::Lease(Subject::Joints(&e.trajectory.joint_names)),
        Request::Servo(s) => Need::Lease(Subject::Task(&s.task)),
        Request::Velocity(v) => Need::Lease(Subject::Task(&v.task)),
        Request::Twist(t) => Need::Lease(Subject::Task(&t.task)),
        Request::Pose(p) => Need::Lease(Subject::Task(&p.task)),
        Request::ArmReset(a) => Need::Peace(Subject::Arm(&a.arm)),
        Request::ArmEnable(a) => Need::Peace(Subject::Arm(&a.arm)),
        Request::ArmDisable(a) => Need::Peace(Subject::Arm(&a.arm)),
        Request::Status(_) | Request::State(_) | Request::Motion(_) => Need::Nothing,
        Request::ExecutePlan(e) => Need::Plan(e.plan),
        Request::Plan(_) | Request::Planning(_) | Request::Preview(_) | Request::Planner(_) => Need::Nothing,
        Request::World(_) | Request::WorldAdd(_) | Request::WorldMove(_) | Request::WorldRemove(_) => Need::Nothing,
        Request::Attach(_) | Request::Detach(_) => Need::Nothing,
        Request::Cancel(_) | Request::Stop(_) | Request::Shutdown(_) => Need::Nothing,
    }
}

/// Who holds the lease of an arm.
#[derive(Debug, Clone)]
struct Holder {
    connection: u64,
    pid: Option<i32>,
    program: String,
    since: Instant,
    /// A request under it was taken on, or it was asked for as such: it stays until it is released.
    kept: bool,
}

impl Holder {
    fn report(&self) -> CommanderReport {
        let held_for = self.since.elapsed().as_secs_f64();
        CommanderReport { pid: self.pid, program: self.program.clone(), held_for }
    }
}

/// The leases of a run, by arm.
#[derive(Debug, Default)]
pub(super) struct Leases(Mutex<BTreeMap<String, Holder>>);

impl Leases {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Holder>> {
        lock(&self.0)
    }

    /// Whether a connection holds the lease of any arm.
    pub fn holds(&self, connection: u64) -> bool {
        self.lock().values().any(|holder| holder.connection == connection)
    }

    /// Adds to a reply what only the connections know: `status` reports who commands the arms.
    pub fn complete(&self, mut reply: Reply) -> Reply {
        if let Reply::Status(status) = &mut reply {
            let held = self.lock();
            for arm in &mut status.arms {
                arm.commander = held.get(&arm.hardware_id).map(Holder::report);
            }
        }
        reply
    }
}

/// A connection's part in the leases. Dropping it gives back all that it holds.
#[derive(Debug)]
pub(super) struct Lessee {
    leases: Arc<Leases>,
    connection: u64,
    pid: Option<i32>,
    /// Dropped with the connection.
    alive: Arc<()>,
}

impl Lessee {
    /// `connection` is a number given once; `pid` is the process at its other end.
    pub fn new(leases: Arc<Leases>, connection: u64, pid: Option<i32>) -> Self {
        Self { leases, connection, pid, alive: Arc::default() }
    }

    /// Returns the process at the other end of the connection, if the system knows it.
    pub fn pid(&self) -> Option<i32> {
        self.pid
    }

    /// The leases of the run.
    pub fn leases(&self) -> &Arc<Leases> {
        &self.leases
    }

    /// Lets a request through, or says who is in its way. The newest plan is named by its number from here on, so that
    /// the plan whose arms are leased is the one that is carried out.
    ///
    /// Answers the arms whose leases it needs and has now; pass the result to [`settle`](Self::settle).
    pub async fn admit(&self, request: Request, backend: &dyn Backend) -> Result<(Request, Vec<String>), RpcError> {
        match need(&request) {
            Need::Nothing => {}
            Need::Lease(subject) => {
                let arms = backend.arms_of(subject);
                self.claim(&arms, false)?;
                return Ok((request, arms));
            }
            Need::Peace(subject) => self.check(&backend.arms_of(subject), &self.leases.lock())?,
            Need::Plan(plan) => {
                let (plan, joints) = backend.plan_of(plan).await?;
                let arms = backend.arms_of(Subject::Joints(&joints));
                self.claim(&arms, false)?;
                let replan = matches!(&request, Request::ExecutePlan(execute) if execute.replan);
                let presence = Some(Presence::of(&self.alive));
                return Ok((Request::ExecutePlan(ExecutePlan { plan: Some(plan), replan, presence }), arms));
            }
        }
        Ok((request, Vec::new()))
    }

    /// A request that needed the leases of these arms was taken on, or refused: then those that it took end.
    pub fn settle(&self, arms: &[String], taken_on: bool) {
        if arms.is_empty() {
            return;
        }
        let mut held = self.leases.lock();
        for arm in arms {
            match held.get_mut(arm).filter(|holder| holder.connection == self.connection) {
                Some(holder) if taken_on => holder.kept = true,
                Some(Holder { kept: false, .. }) => drop(held.remove(arm)),
                _ => {}
            }
        }
    }

    /// Takes the leases of arms: all of them, or none.
    pub fn take(&self, arms: &[String]) -> Result<(), RpcError> {
        self.claim(arms, true)
    }

    fn claim(&self, arms: &[String], kept: bool) -> Result<(), RpcError> {
        let mut held = self.leases.lock();
        self.check(arms, &held)?;
        for arm in arms {
            match held.get_mut(arm) {
                Some(holder) => holder.kept |= kept,
                None => {
                    let (connection, pid, since) = (self.connection, self.pid, Instant::now());
                    held.insert(arm.clone(), Holder { connection, pid, program: program(pid), since, kept });
                }
            }
        }
        Ok(())
    }

    /// Gives back the leases of arms, as far as this connection holds them, and answers those.
    pub fn release(&self, arms: &[String]) -> Vec<String> {
        let mut held = self.leases.lock();
        let mine = |arm: &&String| held.get(*arm).is_some_and(|h| h.connection == self.connection);
        let released: Vec<String> = arms.iter().filter(mine).cloned().collect();
        for arm in &released {
            held.remove(arm);
        }
        released
    }

    fn check(&self, arms: &[String], held: &BTreeMap<String, Holder>) -> Result<(), RpcError> {
        let other = |arm: &&String| held.get(*arm).is_some_and(|h| h.connection != self.connection);
        let Some((arm, holder)) = arms.iter().find(other).and_then(|arm| Some((arm, held.get(arm)?))) else {
            return Ok(());
        };
        let CommanderReport { pid, program, held_for } = holder.report();
        let process = pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default();
        let text = format!("{arm} is commanded by {program}{process}, since {held_for:.1} s");
        Err(RpcError::new(Code::LeaseHeld, text)
            .hint("wait until it ends or releases the arm, or end it; `dimos stop` and `dimos cancel` always work")
            .data(json!({"arm": arm, "pid": pid, "program": program, "held_for": held_for})))
    }
}

impl Drop for Lessee {
    fn drop(&mut self) {
        self.leases.lock().retain(|_, holder| holder.connection != self.connection);
    }
}

/// What a process calls itself: `dimos move`, `python3 policy.py`. Asked of the system once per lease.
fn program(pid: Option<i32>) -> String {
    let read = |pid: i32| std::fs::read(format!("/proc/{pid}/cmdline")).ok();
    let line = pid.and_then(read).unwrap_or_default();
    let words = line.split(|byte| *byte == 0).map(String::from_utf8_lossy).filter(|word| !word.is_empty());
    let mut name = String::new();
    for word in words.take(2).take_while(|word| !word.starts_with('-')) {
        let word: String = word.rsplit('/').next().unwrap_or_default().chars().take(40).collect();
        name = if name.is_empty() { word } else { format!("{name} {word}") };
    }
    // Control characters in a name would reach the terminals of others.
    name.retain(|c| !c.is_control());
    if name.is_empty() { "another program".to_owned() } else { name }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(arms: &[&str]) -> Vec<String> {
        arms.iter().map(|arm| (*arm).to_owned()).collect()
    }

    #[test]
    fn all_arms_or_none_are_taken_and_the_end_of_a_connection_gives_them_back() {
        let leases = Arc::new(Leases::default());
        let lessee = |connection| Lessee::new(leases.clone(), connection, Some(std::process::id() as i32));
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
    fn a_refused_request_leaves_no_lease_behind() {
        let leases = Arc::new(Leases::default());
        let (one, arms) = (Lessee::new(leases.clone(), 1, None), names(&["left"]));
        one.claim(&arms, false).unwrap();
        assert!(leases.holds(1), "while it is asked");
        one.settle(&arms, false);
        assert!(!leases.holds(1));
        one.claim(&arms, false).unwrap();
        one.settle(&arms, true);
        one.claim(&arms, false).unwrap();
        one.settle(&arms, false);
        assert!(leases.holds(1), "what it moves already it keeps");
    }

    #[test]
    fn programs_are_named() {
        let mine = program(Some(std::process::id() as i32));
        assert!(mine.starts_with("dimos"), "{mine}");
        assert_eq!(program(None), "another program");
        assert_eq!(program(Some(-5)), "another program");
    }
}
