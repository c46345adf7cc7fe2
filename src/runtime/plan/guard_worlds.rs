//! Keeps the collision guard of the tick up to date: a thread prepares each change of the planner's world, and of the
//! joints that are not planned, and hands it to the tick through a ring. It frees what the tick has replaced.

use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, Weak};
use std::time::Duration;

use super::PlannerPort;
use crate::runtime::Service;
use dimos_control::guard::GuardWorld;
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::Names;
use dimos_planner::collision::settings::GuardSettings;
use dimos_planner::collision::{OwnMargins, Scene};
use dimos_rpc::api::Moment;

/// Distance that the links of one arm keep from each other, where their covers are fine enough [m].
const OWN_MARGIN: f64 = 0.002;
/// Time between two looks for changes.
const PERIOD: Duration = Duration::from_millis(100);
/// Longest wait of a request for its change to be guarded.
const WAIT: Duration = Duration::from_secs(2);

/// The ends of the rings of the collision guard.
pub(in crate::runtime) struct GuardEnds {
    pub worlds: rtrb::Producer<Box<GuardWorld>>,
    pub retired: rtrb::Consumer<Box<GuardWorld>>,
}

/// The part of the guard outside of the tick.
pub(in crate::runtime) struct GuardWorlds {
    /// Distance from obstacles and other arms [m].
    margin: f64,
    own: OwnMargins,
    /// The coordinator's joints, by name, and the arm of each.
    joints: BTreeMap<String, u16>,
    arms: Vec<u16>,
    ends: Mutex<Sent>,
    /// Number of changes asked for, and of those that are guarded or failed.
    changes: Mutex<(u64, u64)>,
    changed: Condvar,
}

struct Sent {
    ends: GuardEnds,
    /// Version of the world that was sent last, and whether all positions were known.
    last: Option<(u64, bool)>,
}

impl GuardWorlds {
    /// Sends the first world. The error says why streams cannot be guarded.
    pub fn start(port: &PlannerPort, names: &Names, margin: f64, ends: GuardEnds) -> Result<Self, String> {
        let mut joints = BTreeMap::new();
        let mut arms = Vec::new();
        for (index, arm) in names.arms.iter().enumerate() {
            for joint in &arm.joints {
                joints.insert(joint.clone(), arms.len() as u16);
                arms.push(index as u16);
            }
        }
        let (scene, _) = port.thread.snapshot();
        let own = OwnMargins::of(&scene, OWN_MARGIN, &GuardSettings::default());
        for ([link, other], distance) in own.overlapping() {
            tracing::info!(
                "collision guard: {link} and {other} are kept apart to within {:.0} mm only: they are close by design",
                -distance * 1e3
            );
        }
        let sent = Mutex::new(Sent { ends, last: None });
        let made = Self { margin, own, joints, arms, ends: sent, changes: Mutex::new((0, 0)), changed: Condvar::new() };
        made.refresh(port, &Moment::default())?;
        Ok(made)
    }

    /// Runs until the service is gone.
    pub fn run(self: &Arc<Self>, service: &Weak<Service>) -> std::io::Result<()> {
        let (guard, service) = (self.clone(), service.clone());
        std::thread::Builder::new().name("guard".into()).spawn(move || {
            let mut failed = false;
            while let Some(service) = service.upgrade() {
                let asked = lock(&guard.changes).0;
                if let Some(port) = service.plans.port() {
                    let moment = service.moment(0);
                    port.measured(&moment);
                    if let Err(what) = guard.refresh(port, &moment)
                        && !std::mem::replace(&mut failed, true)
                    {
                        tracing::error!("the collision guard keeps an old world: {what}");
                    }
                }
                // Before the wait: the service ends with its last user.
                drop(service);
                let mut changes = lock(&guard.changes);
                changes.1 = asked;
                guard.changed.notify_all();
                if changes.0 == asked {
                    drop(guard.changed.wait_timeout(changes, PERIOD));
                }
            }
        })?;
        Ok(())
    }

    /// Waits until the world as it is now is guarded, at most 2 s. Blocks.
    pub fn wait(&self) {
        let mut changes = lock(&self.changes);
        changes.0 += 1;
        let mine = changes.0;
        self.changed.notify_all();
        drop(self.changed.wait_timeout_while(changes, WAIT, |changes| changes.1 < mine));
    }

    /// Sends the present world if it has changed since the last one.
    fn refresh(&self, port: &PlannerPort, moment: &Moment) -> Result<(), String> {
        let mut sent = lock(&self.ends);
        while sent.ends.retired.pop().is_ok() {}
        let version = port.thread.version();
        let known = self.joints.keys().all(|joint| moment.positions.contains_key(joint));
        if sent.last.is_some_and(|(last, placed)| last == version && (placed || !known)) {
            return Ok(());
        }
        let (scene, version) = port.thread.snapshot();
        let mut world = GuardWorld::new(&scene, self.commanded(&scene, port)?, &self.arms, self.margin, &self.own)?;
        if known {
            let mut positions = vec![0.0; self.arms.len()];
            for (joint, index) in &self.joints {
                let own = positions.get_mut(usize::from(*index));
                own.into_iter().zip(moment.positions.get(joint)).for_each(|(to, at)| *to = *at);
            }
            world.allow_present(|joint| positions.get(usize::from(joint)).copied().unwrap_or_default());
        }
        // A full ring: the tick does not run. The next look tries again.
        if sent.ends.worlds.push(Box::new(world)).is_ok() {
            sent.last = Some((version, known));
        }
        Ok(())
    }

    /// Returns the coordinator's joint of each joint of a scene.
    fn commanded(&self, scene: &Scene, port: &PlannerPort) -> Result<Vec<u16>, String> {
        let names = port.thread.setup().robots.iter().flat_map(|robot| &robot.config.coordinator_joints);
        let index = |name: &String| self.joints.get(name).copied().ok_or_else(|| format!("no arm has joint {name}"));
        let joints = names.map(index).collect::<Result<Vec<_>, _>>()?;
        if joints.len() == scene.dof() { Ok(joints) } else { Err("a robot has other joints than planned".to_owned()) }
    }
}
