//! No motion of an arm moves its tool faster than its limit: direct, timed along a path, or from a stream. Judged by
//! the poses of the model's links at millisecond steps, not by the Jacobian that keeps the limit. `DIMOS_TOOL_MOTIONS`
//! is the number of motions for each arm.

use std::collections::HashMap;

use dimos::blueprint::{Arm, Overrides, find, load};
use dimos::control::config::{ArmConfig, TaskKind, ToolLimit};
use dimos::control::point_to_point::point_to_point;
use dimos::joint::{ControlMode, JointBounds, JointLimits};
use dimos::planning::timing::settings::{TimingSettings, ToolTimingSettings};
use dimos::planning::timing::time_within;
use dimos::planning::timing::tool_timing::Tools;
use dimos::robot::model::RobotModel;
use dimos::robot::random::Random;
use dimos::telemetry::{Event, LimitKind};
use dimos::trajectory::{Cursor, JointTrajectory, Sample, Spline};

use crate::support::rig::{self, Rig};

/// More than this part of the limit is too fast.
const TOLERANCE: f64 = 1.01;

fn motions(otherwise: usize) -> usize {
    std::env::var("DIMOS_TOOL_MOTIONS").map_or(otherwise, |n| n.parse().expect("a number"))
}

/// An arm whose tool has a speed limit.
struct Limited {
    name: String,
    arm: Arm,
    limit: ToolLimit,
    model: RobotModel,
    joints: Vec<String>,
}

impl Limited {
    fn all() -> Vec<Self> {
        let names =
            ["coordinator-lite6", "coordinator-xarm6", "xarm7-planner", "xarm6-planner", "fr3-planner", "ur5e-planner"];
        // An FR3 hardly reaches 3 m/s.
        let set = |name: &str| {
            if name.starts_with("fr3") { vec!["hardware.arm.limits.tcp_velocity=1.2"] } else { Vec::new() }
        };
        names.iter().map(|name| Self::of(name, &set(name))).collect()
    }

    fn of(name: &str, set: &[&str]) -> Self {
        let set = set.iter().map(|set| (*set).to_owned()).collect();
        let loaded = load(&find(name).unwrap(), &Overrides { set, ..Overrides::default() }, &dimos::arms::registry());
        let arm = loaded.blueprint.unwrap_or_else(|| panic!("{name}")).arms.remove(0);
        let limit = arm.tool_limit().unwrap().unwrap_or_else(|| panic!("{name} has no tool limit"));
        let model = dimos::robot::load(&arm.tool_robot.as_ref().unwrap().robot.source).model.unwrap();
        let joints = limit.robot.kinematics.names().to_vec();
        Self { name: name.to_owned(), arm, limit, model, joints }
    }

    /// Where the points are whose speed is limited [m].
    fn points(&self, q: &[f64]) -> Vec<nalgebra::Vector3<f64>> {
        let named: HashMap<String, f64> = self.joints.iter().cloned().zip(q.iter().copied()).collect();
        let poses = self.model.link_poses(&self.model.positions(&named));
        let tool = self.arm.tool_robot.as_ref().unwrap().robot.tool.unwrap_or_default();
        let links = self.limit.links.iter().map(|link| poses[*link].translation.vector);
        links.chain([(poses[self.limit.robot.link] * tool).translation.vector]).collect()
    }

    fn fastest(&self, from: &[f64], to: &[f64], dt: f64) -> f64 {
        let pairs = self.points(from).into_iter().zip(self.points(to));
        pairs.map(|(a, b)| (b - a).norm() / dt).fold(0.0, f64::max)
    }

    fn limits(&self) -> JointLimits {
        self.arm.own_limits.clone().with_defaults()
    }

    fn bounds(&self, speed: f64) -> Vec<JointBounds> {
        let l = self.limits();
        let bound = |j: usize| JointBounds {
            velocity: l.velocity_max[j] * speed,
            acceleration: l.acceleration_max[j] * speed,
            jerk: l.jerk_max[j] * speed,
            ..JointBounds::NONE
        };
        (0..self.joints.len()).map(bound).collect()
    }

    fn pose(&self, random: &mut Random) -> Vec<f64> {
        let l = self.limits();
        let joint = |j: usize| random.between(l.position_lower[j].max(-2.0) + 0.1, l.position_upper[j].min(2.0) - 0.1);
        (0..self.joints.len()).map(joint).collect()
    }

    fn tools(&self) -> Tools {
        let mut tools = Tools::default();
        tools.push(0..self.joints.len(), self.limit.speed(), self.limit.velocity);
        tools
    }

    /// Checks a motion as it is sampled; returns the tool's top speed [m/s].
    fn judge(&self, motion: &JointTrajectory, bounds: &[JointBounds], speed: f64, what: &str) -> f64 {
        let spline = Spline::new(motion).unwrap();
        let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); self.joints.len()]);
        let (mut before, mut top, dt) = (None::<Vec<f64>>, 0.0_f64, (spline.duration() / 600.0).max(1e-3));
        for k in 0..=(spline.duration() / dt) as usize {
            spline.sample(k as f64 * dt, &mut cursor, &mut samples);
            let q: Vec<f64> = samples.iter().map(|s| s.position).collect();
            top = top.max(before.map_or(0.0, |before| self.fastest(&before, &q, dt)));
            before = Some(q);
            for (j, (sample, bound)) in samples.iter().zip(bounds).enumerate() {
                let (v, a) = (sample.velocity.abs() / bound.velocity, sample.acceleration.abs() / bound.acceleration);
                assert!(v < 1.002 && a < 1.01, "{} {what}: joint {j} uses {v:.4} of its velocity, {a:.4}", self.name);
            }
        }
        let most = self.limit.velocity * speed * TOLERANCE;
        assert!(top <= most, "{} {what}: the tool moves at {top:.3} m/s, and may {most:.3} m/s", self.name);
        top
    }
}

#[test]
fn direct_motions_and_timed_paths_keep_the_speed_of_the_tool() {
    for arm in Limited::all() {
        let mut random = Random::new(17);
        let (mut slowed, mut shares) = (0, Vec::new());
        let number = motions(10);
        for k in 0..number {
            let speed = [0.1, 0.5, 1.0][k % 3];
            let bounds = arm.bounds(1.0);
            let (start, goal) = (arm.pose(&mut random), arm.pose(&mut random));
            let direct = point_to_point(&arm.joints, &start, &goal, &arm.limits(), speed).unwrap();
            if let Some(slower) = arm.tools().slowed(&direct, &bounds, speed, &ToolTimingSettings::default()) {
                shares.push(
                    arm.judge(&slower, &bounds, speed, &format!("direct motion {k}")) / (arm.limit.velocity * speed),
                );
                slowed += 1;
            } else {
                arm.judge(&direct, &bounds, speed, &format!("direct motion {k}"));
            }
            let bounds = arm.bounds(speed);
            let path: Vec<Vec<f64>> = (0..2 + random.below(4)).map(|_| arm.pose(&mut random)).collect();
            let deviation = vec![0.05; path.len()];
            let timed = time_within(&arm.joints, &path, &bounds, &deviation, &TimingSettings::default(), |_, _| true)
                .unwrap()
                .trajectory;
            let kept = arm.tools().slowed(&timed, &bounds, speed, &ToolTimingSettings::default()).unwrap_or(timed);
            arm.judge(&kept, &bounds, speed, &format!("path {k}"));
        }
        // Not by being slow: most motions that are slowed use nearly the whole limit.
        let near = shares.iter().filter(|share| **share > 0.97).count();
        assert!(slowed > 0 && 2 * near > slowed, "{}: {slowed} of {number} slowed, {near} of them near it", arm.name);
    }
}

#[test]
fn a_slowed_motion_takes_little_longer_than_its_tool_needs() {
    let arm = Limited::of("coordinator-xarm6", &[]);
    let bounds = arm.bounds(1.0);
    let radius = |q: &Vec<f64>| arm.points(q).iter().map(|p| p.xy().norm()).fold(0.0, f64::max);
    let mut random = Random::new(1);
    let poses = (0..500).map(|_| arm.pose(&mut random)).max_by(|a, b| radius(a).total_cmp(&radius(b)));
    let (mut stretched, mut goal) = (poses.clone().unwrap(), poses.unwrap());
    (stretched[0], goal[0]) = (0.0, 2.4);
    let direct = point_to_point(&arm.joints, &stretched, &goal, &arm.limits(), 1.0).unwrap();
    let slower = arm.tools().slowed(&direct, &bounds, 1.0, &ToolTimingSettings::default()).unwrap();
    let way = 2.4 * radius(&stretched);
    let least = way / arm.limit.velocity;
    assert!(slower.duration() < least + 0.5, "{:.2} s for {way:.2} m, at least {least:.2} s", slower.duration());
}

/// The rig checks the acceleration of every setpoint; here the tool is checked too. `fraction`: that of its speed at
/// which the arm's controller runs motions; limits are kept in the time that passes there. Returns how often the tool's
/// limit began to slow it.
fn stream(arm: &Limited, mode: &str, rate: f64, fraction: f64, seed: u64) -> usize {
    let mut limits = arm.limits();
    limits.jerk_max.clear();
    let config = ArmConfig {
        limits: limits.with_defaults(),
        modes: vec![ControlMode::ServoPosition, ControlMode::Velocity],
        tool: Some(Box::new(arm.limit.clone())),
        effort: None,
        ..rig::arm("arm", arm.joints.len())
    };
    let kind: TaskKind = if mode == "velocity" { rig::velocity() } else { rig::servo() };
    let dof = arm.joints.len();
    let mut rig = Rig::new(rate, vec![config], vec![rig::task("t", kind, 0..dof as u16, 10)]);
    let mut random = Random::new(seed);
    rig.arms[0].q = arm.pose(&mut random);
    rig.make_ready();
    rig.checked = fraction == 1.0;
    rig.arms[0].state.speed_fraction = Some(fraction);
    let bounds = arm.bounds(fraction);
    let (mut q, mut goal) = (rig.arms[0].q.clone(), rig.arms[0].q.clone());
    let (mut top, mut before) = (0.0_f64, None::<Vec<f64>>);
    let (mut speeds, dt) = (vec![0.0; dof], 1.0 / rate);
    for k in 0..(motions(8) as f64 * rate) as usize {
        if k % (0.7 * rate) as usize == 0 {
            goal = arm.pose(&mut random);
            speeds = bounds.iter().map(|b| random.between(-b.velocity, b.velocity)).collect();
        }
        if mode == "velocity" {
            rig.velocity(0, &speeds);
        } else {
            for ((q, goal), b) in q.iter_mut().zip(&goal).zip(&bounds) {
                *q += (goal - *q).clamp(-b.velocity * dt, b.velocity * dt);
            }
            rig.servo(0, &q);
        }
        rig.tick();
        let command = rig.commands[0];
        let now: Vec<f64> = match (mode, &before) {
            ("velocity", Some(before)) => before.iter().zip(command.values).map(|(q, v)| q + v * dt).collect(),
            ("velocity", None) => rig.arms[0].q.clone(),
            _ => command.values[..dof].to_vec(),
        };
        top = top.max(before.as_ref().map_or(0.0, |before| arm.fastest(before, &now, dt)));
        before = Some(now);
        let most = arm.limit.velocity * fraction * TOLERANCE;
        assert!(top <= most, "{} {mode} at {rate} Hz: {top:.3} m/s in tick {k}, and may {most:.3}", arm.name);
    }
    let reported = rig.count(|event| matches!(event, Event::Limited(_, LimitKind::Tool, _)));
    assert!(top > 0.9 * fraction * arm.limit.velocity && reported > 0, "{} {mode}: only {top:.3} m/s", arm.name);
    reported
}

#[test]
fn streams_keep_the_speed_of_the_tool() {
    for (k, arm) in Limited::all().iter().enumerate() {
        let reported = stream(arm, "servo", 100.0, 1.0, k as u64);
        assert!(reported > 1 || k > 0, "reported once, though the arm is slowed repeatedly");
        stream(arm, "servo", 500.0, 1.0, 100 + k as u64);
        stream(arm, "velocity", 125.0, 1.0, 200 + k as u64);
        stream(arm, "servo", 100.0, 0.3, 300 + k as u64);
    }
}

#[test]
fn the_blueprint_narrows_it_and_raises_only_what_is_a_setting() {
    let of = |name: &str, value: &str| {
        Limited::of(name, &[&format!("hardware.arm.limits.tcp_velocity={value}")]).limit.velocity
    };
    assert_eq!(of("coordinator-xarm6", "0.3"), 0.3);
    assert_eq!(of("ur5e-planner", "2.5"), 2.5, "a setting of the controller");
    let said = |name: &str, value: &str| {
        let set = vec![format!("hardware.arm.limits.tcp_velocity={value}")];
        load(&find(name).unwrap(), &Overrides { set, ..Overrides::default() }, &dimos::arms::registry()).render(false)
    };
    let text = said("coordinator-xarm6", "1.2");
    assert!(text.contains("1.2 m/s is above the arm's own limit") && text.contains("0.95 m/s"), "{text}");
    assert!(said("coordinator-xarm6", "0").contains("must be above 0"), "{}", said("coordinator-xarm6", "0"));
    let text = said("coordinator-so101", "0.5");
    assert!(text.contains("no model of arm is known"), "{text}");
}
