//! Arms in memory in a world of obstacles, with the collision guard, and an exact check of every step.

use std::sync::Arc;

use dimos::collision::cloud::Cloud;
use dimos::collision::settings::GuardSettings;
use dimos::collision::world::{Obstacle, Robot};
use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, OwnMargins, Scene, Solid, World};
use dimos::control::config::{ArmConfig, TaskConfig};
use dimos::control::guard::GuardWorld;
use dimos::planning::scene::planning_scene::{always_touch, whole};
use dimos::robot::{Source, load};
use glamx::{DAffine3, DVec3};

use super::rig::{Rig, arm};

/// What the guard keeps from obstacles and other arms, and within an arm [m].
pub const MARGINS: (f64, f64) = (0.01, 0.002);

/// A robot of the box with its base at a place.
pub fn robot(model: &str, name: &str, base: DAffine3) -> Robot {
    let model = load(&Source::new(format!("builtin:{model}"))).into_model().unwrap();
    let mut robot = whole(model, Vec::new()).unwrap();
    robot.allowed.extend(always_touch(&robot).into_iter().map(Into::into));
    Robot { name: name.into(), base, ..robot }
}

/// A box of these edges [m] with its middle at a place.
pub fn cuboid(name: &str, size: [f64; 3], at: [f64; 3]) -> Obstacle {
    let at = DAffine3::from_translation(DVec3::from_array(at));
    Obstacle { name: name.into(), solid: Solid::cuboid(DVec3::from_array(size), at).unwrap(), padding: 0.0 }
}

/// A cloud of `number` points on a shell around the origin, beyond what is in reach of a start.
pub fn cloud(name: &str, number: usize, radius: f64) -> Obstacle {
    let golden = std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
    let point = |k: usize| {
        let z = 1.0 - 2.0 * (k as f64 + 0.5) / number as f64;
        let (sin, cos) = (golden * k as f64).sin_cos();
        DVec3::new(cos * (1.0 - z * z).sqrt(), sin * (1.0 - z * z).sqrt(), z) * radius
    };
    let cloud = Cloud::new((0..number).map(point)).unwrap();
    let solid = Solid::cloud(Arc::new(cloud), 0.01, DAffine3::IDENTITY).unwrap();
    Obstacle { name: name.into(), solid, padding: 0.0 }
}

/// A scene for the guard: each robot is an arm, its joints are those of the coordinator.
pub fn prepared(scene: &Arc<Scene>, own: &OwnMargins, q: &[f64]) -> Box<GuardWorld> {
    let robots = scene.robots().iter().enumerate();
    let arms: Vec<u16> = robots.flat_map(|(i, r)| std::iter::repeat_n(i as u16, r.kinematics.dof())).collect();
    let joints = (0..arms.len() as u16).collect();
    let mut world = GuardWorld::new(scene, joints, &arms, MARGINS.0, own).unwrap();
    world.allow_present(|joint| q[usize::from(joint)]);
    Box::new(world)
}

/// Arms, their guard, and the exact checker.
pub struct Guarded {
    pub rig: Rig,
    pub world: World,
    own: OwnMargins,
    checker: ExactChecker,
    last: Vec<f64>,
}

impl Guarded {
    /// The arms of a world's robots at `home` with these limits of velocity and acceleration, ready and guarded.
    pub fn new(world: World, home: &[f64], limits: (f64, f64), tasks: Vec<TaskConfig>) -> Self {
        let mut made = Self::unready(world, home, limits, tasks);
        made.rig.make_ready();
        made.take_world(|_| {});
        assert_eq!(made.contact(), None, "the start");
        made
    }

    /// The same before the first tick, without a guard.
    pub fn unready(world: World, home: &[f64], limits: (f64, f64), tasks: Vec<TaskConfig>) -> Self {
        let config = |robot: &Robot| -> ArmConfig {
            let own = robot.kinematics.limits();
            let mut arm = arm(&robot.name, own.len());
            arm.limits.position_lower = own.iter().map(|l| l.lower.max(-6.0)).collect();
            arm.limits.position_upper = own.iter().map(|l| l.upper.min(6.0)).collect();
            arm.limits.velocity_max = vec![limits.0; own.len()];
            arm.limits.acceleration_max = vec![limits.1; own.len()];
            arm
        };
        let arms: Vec<ArmConfig> = world.robots().iter().map(config).collect();
        let mut rig = Rig::new(100.0, arms, tasks);
        let mut first = 0;
        for arm in &mut rig.arms {
            arm.q.copy_from_slice(&home[first..first + arm.dof]);
            first += arm.dof;
        }
        let checker = ExactChecker::new(world.snapshot(), CheckSettings::default());
        let own = OwnMargins::of(&world.snapshot(), MARGINS.1, &GuardSettings::default());
        Self { rig, world, own, checker, last: home.to_vec() }
    }

    /// Changes the world, as a run does: prepared elsewhere, taken by the next tick.
    pub fn take_world(&mut self, change: impl FnOnce(&mut World)) {
        change(&mut self.world);
        let scene = self.world.snapshot();
        self.checker = ExactChecker::new(scene.clone(), CheckSettings::default());
        let world = prepared(&scene, &self.own, &self.q());
        self.rig.coordinator.set_guard(Some(world));
    }

    /// Sends the same target to a task for a while; checks every step.
    pub fn hold(&mut self, task: u16, target: &[f64], ticks: usize) {
        for _ in 0..ticks {
            self.rig.servo(task, target);
            self.tick();
        }
    }

    /// Leads a servo task to a target in steps; checks every step.
    pub fn lead(&mut self, task: u16, from: &mut [f64], to: &[f64], ticks: usize) {
        for _ in 0..ticks {
            for (at, goal) in from.iter_mut().zip(to) {
                *at += (goal - *at).clamp(-0.02, 0.02);
            }
            self.rig.servo(task, from);
            self.tick();
        }
    }

    /// Positions of all joints.
    pub fn q(&self) -> Vec<f64> {
        self.rig.arms.iter().flat_map(|arm| arm.q.clone()).collect()
    }

    /// Returns the pair that touches now, exactly.
    pub fn contact(&mut self) -> Option<String> {
        let q = self.q();
        self.contact_at(&q)
    }

    pub fn contact_at(&mut self, q: &[f64]) -> Option<String> {
        self.checker.first_contact(q)?;
        let contacts = self.checker.contacts(q);
        Some(contacts.first().map_or("unknown".into(), |c| format!("{} and {} at {} m", c.link, c.other, c.distance)))
    }

    /// Returns the smallest distance of an arm from something else [m]: an obstacle or another arm, by the beginning of
    /// its name; 1 if there is none within a metre.
    pub fn distance_to(&self, other: &str) -> f64 {
        let mut checker = self.checker.clone().with_padding(1.0);
        let near = checker.closer_than_padding(&self.q()).into_iter();
        near.filter(|(_, contact)| contact.other.starts_with(other)).map(|(_, c)| c.distance).fold(1.0, f64::min)
    }

    /// One tick; checks exactly that nothing touches where the arms are then, and half-way there.
    pub fn tick(&mut self) {
        self.rig.tick();
        let now = self.q();
        let half: Vec<f64> = now.iter().zip(&self.last).map(|(a, b)| 0.5 * (a + b)).collect();
        for q in [half, now.clone()] {
            if let Some(contact) = self.contact_at(&q) {
                panic!("tick {}: {contact}: {q:?}", self.rig.ticks);
            }
        }
        self.last = now;
    }
}
