//! Efforts that are fed forward: what blueprints say of them, and what the tick commands.

use dimos::arm::EffortLimits;
use dimos::blueprint::{self, Catalog, Found, Loaded, Overrides, Source};
use dimos::control::config::{ArmConfig, EffortConfig, FeedForward};
use dimos::control::request::Request;
use dimos::control::task_spec::TaskTable;
use dimos::joint::{ControlMode, MAX_DOF};
use dimos::robot::dynamics::Dynamics;
use dimos::rt::counting::{watch, watched_calls};
use dimos::telemetry::{Event, LimitKind};

use super::task_conformance::failures;
use crate::support::rig::{Rig, arm, sweep, task, trajectory};

#[path = "../../docs/examples/compliant.rs"]
mod compliant;

/// A blueprint with one arm, and more.
fn load(adapter: &str, own: &str, more: &str) -> Loaded {
    let text = format!(
        "hardware:\n  - {{hardware_id: arm, adapter_type: {adapter}, address: sim, joints: {{prefix: arm, count: 6}}, \
         {own}}}\n{more}"
    );
    let found = Found { name: "fed".into(), source: Source::Embedded, bytes: text.into_bytes() };
    let (adapters, tasks) = (dimos::arms::registry(), TaskTable::with(&[compliant::SPEC]));
    blueprint::load(&found, &Overrides::default(), Catalog { adapters: &adapters, tasks: &tasks })
}

/// What its arm is commanded beside positions.
fn effort(adapter: &str, own: &str, more: &str) -> EffortConfig {
    let loaded = load(adapter, own, more);
    let blueprint = loaded.blueprint.clone().unwrap_or_else(|| panic!("{}", loaded.render(false)));
    blueprint.arms[0].effort_config(None).unwrap().expect("it is commanded efforts")
}

fn gravity(config: &EffortConfig, q: [f64; 6]) -> [f64; 6] {
    let mut out = [0.0; 6];
    config.dynamics.clone().expect("its model").gravity(&q, &mut out);
    out
}

const POSE: [f64; 6] = [0.2, 0.4, 0.5, 0.1, 0.3, 0.2];

#[test]
fn a_blueprint_gives_limits_model_load_and_the_direction_of_gravity() {
    let up = effort("yourarm", "feed_forward: gravity, limits: {effort: 60}", "");
    assert_eq!((up.feed_forward, up.limits.max[5], up.limits.rate[0]), (FeedForward::Gravity, 60.0, 600.0));
    let given = effort("yourarm", "feed_forward: dynamics, limits: {effort: [9, 8, 7, 6, 5, 4], effort_rate: 30}", "");
    assert_eq!((given.limits.max[2], given.limits.rate[2]), (7.0, 30.0));
    let upright = gravity(&up, POSE);
    assert!(upright[1].abs() > 5.0, "{upright:?}");
    let close = |a: [f64; 6], b: [f64; 6]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
    let hung = effort(
        "yourarm",
        "feed_forward: gravity, limits: {effort: 60}, mounting: {rpy: [3.141592653589793, 0, 0]}",
        "",
    );
    assert!(close(gravity(&hung, POSE), upright.map(|torque| -torque)), "{:?}", gravity(&hung, POSE));
    // 1 kg at the flange, the forearm forward: its moment about the elbow.
    let loaded = effort("yourarm", "feed_forward: gravity, limits: {effort: 60}, payload: {mass: 1}", "");
    let more = gravity(&loaded, [0.0; 6])[2] - gravity(&up, [0.0; 6])[2];
    assert!((3.0..6.0).contains(&more.abs()), "{more} Nm");
    let named = effort("remote", "feed_forward: gravity, model_path: 'builtin:yourarm', limits: {effort: 60}", "");
    assert!(close(gravity(&named, POSE), upright), "the same model by its name");
    let planner = "planner:\n  robots:\n    - {name: arm, model_path: 'builtin:yourarm', end_effector_link: flange, \
                   joint_names: [joint1, joint2, joint3, joint4, joint5, joint6], joint_prefix: arm_, base_pose: {xyz: [0, 0, 1], rpy: [3.141592653589793, 0, 0]}}\n";
    let placed = effort("yourarm", "feed_forward: gravity, limits: {effort: 60}", planner);
    assert!(close(gravity(&placed, POSE), gravity(&hung, POSE)), "by where the planner has its base");
}

#[test]
fn what_cannot_be_fed_forward_is_said_with_its_reason() {
    let soft = "tasks:\n  - {name: soft, type: compliant, joint_names: {hardware: arm}}\n";
    for (adapter, own, more, says) in [
        ("so101", "feed_forward: gravity", "", "is given no efforts"),
        ("ur", "feed_forward: gravity", "", "refused by dimos: servoj has none"),
        ("mock", "feed_forward: gravity, limits: {effort: 9}", "", "no model of arm is known"),
        ("yourarm", "model_path: 'builtin:yourarm'", "", "`model_path` has no use without `feed_forward`"),
        ("yourarm", "limits: {effort: -1}", "", "must be above 0, not -1"),
        ("yourarm", "feed_forward: weight", "", "weight"),
        (
            "mock",
            "auto_enable: true",
            soft,
            "the highest effort of `arm_joint1` is not known, and task soft commands it",
        ),
        ("xarm", "auto_enable: true", soft, "need the mode impedance"),
    ] {
        let said = load(adapter, own, more).render(false);
        assert!(said.contains(says), "{adapter} {own}: {said}");
    }
    let planner = "planner:\n  robots:\n    - {name: arm, model_path: 'builtin:yourarm', end_effector_link: flange, \
                   joint_names: [joint1, joint2, joint3, joint4, joint5, joint6], joint_prefix: arm_}\n";
    let own = "feed_forward: gravity, limits: {effort: 60}, mounting: {rpy: [1.5707963, 0, 0]}";
    let said = load("yourarm", own, planner).render(false);
    assert!(said.contains("gravity is 90.0° from where `base_pose` of the planner has it"), "{said}");
}

#[test]
fn a_type_that_demands_impedance_conforms() {
    let failures = failures(&compliant::SPEC);
    assert!(failures.is_empty(), "{failures:?}");
}

/// An arm of the tick that is fed forward, with these limits [Nm, Nm/s].
fn fed(feed_forward: FeedForward, (max, rate): (f64, f64)) -> (Rig, Dynamics) {
    let config = effort("yourarm", "feed_forward: dynamics, limits: {effort: 100}", "");
    let dynamics = config.dynamics.clone().unwrap();
    let limits = EffortLimits { max: [max; MAX_DOF], rate: [rate; MAX_DOF] };
    let arm = ArmConfig { effort: Some(Box::new(EffortConfig { limits, feed_forward, ..config })), ..arm("arm", 6) };
    let mut rig = Rig::new(100.0, vec![arm], vec![task("t", trajectory(), 0..6, 10)]);
    rig.run(2);
    rig.ask(Request::Enabled { arm: 0, outside: false });
    rig.run_for(0.3);
    (rig, dynamics)
}

#[test]
fn the_tick_commands_the_efforts_of_its_setpoints_and_allocates_nothing() {
    for feed_forward in [FeedForward::Gravity, FeedForward::Dynamics] {
        let (mut rig, mut dynamics) = fed(feed_forward, (100.0, 1e5));
        rig.send(Request::Execute { task: 0, motion: sweep(1, 0..6, 0.0, 0.6, 1.5) });
        let (before, mut moved) = (watched_calls(), 0.0f64);
        rig.around = watch;
        for _ in 0..160 {
            rig.tick();
            let command = &rig.commands[0];
            let mut expected = [0.0; 6];
            match feed_forward {
                FeedForward::Gravity => dynamics.gravity(&command.values[..6], &mut expected),
                _ => dynamics.inverse(
                    &command.values[..6],
                    &command.velocity[..6],
                    &command.acceleration[..6],
                    &mut expected,
                ),
            }
            let efforts = command.effort.expect("it is fed forward");
            let off = efforts.iter().zip(expected).fold(0.0f64, |most, (a, b)| most.max((a - b).abs()));
            assert!(off < 1e-9 && command.gains.is_none(), "{off}");
            moved = moved.max(command.acceleration[0].abs());
        }
        assert_eq!(watched_calls(), before, "allocations");
        assert!(moved > 0.5 && rig.commands[0].acceleration[..6] == [0.0; 6], "{moved}, then at rest");
    }
}

#[test]
fn efforts_keep_their_limits_and_the_first_tick_at_one_says_so() {
    let (mut rig, mut dynamics) = fed(FeedForward::Gravity, (4.0, 2.0));
    let mut weight = [0.0; 6];
    dynamics.gravity(&[0.0; 6], &mut weight);
    assert!(weight[2].abs() > 7.0, "{weight:?}");
    let first = rig.commands[0].effort.unwrap();
    assert_eq!(first[2].abs(), 4.0, "the weight at once, as far as the limit lets it");
    let limited = |rig: &Rig| {
        let is = |(_, event): &&(u64, Event)| matches!(event, Event::Limited(2, LimitKind::Effort, asked) if asked.abs() > 7.0);
        rig.events.iter().filter(is).count()
    };
    assert_eq!(limited(&rig), 1);
    rig.send(Request::Execute { task: 0, motion: sweep(1, 0..6, 0.0, 1.2, 2.0) });
    let mut last = first;
    for _ in 0..250 {
        rig.tick();
        let now = rig.commands[0].effort.unwrap();
        assert!(now.iter().all(|effort| effort.abs() <= 4.0));
        let steepest = now.iter().zip(last).fold(0.0f64, |most, (a, b)| most.max((a - b).abs()));
        assert!(steepest <= 0.02 + 1e-12, "{steepest} Nm in a tick");
        last = now;
    }
}

#[test]
fn an_arm_without_it_is_commanded_no_efforts_and_none_in_velocity_mode() {
    let mut plain = Rig::new(100.0, vec![arm("arm", 6)], vec![task("t", trajectory(), 0..6, 10)]);
    plain.make_ready();
    assert_eq!((plain.commands[0].effort, plain.commands[0].gains), (None, None));
    let (mut rig, _) = fed(FeedForward::Gravity, (100.0, 1e4));
    let velocity = crate::support::rig::velocity();
    let mut config = rig.config.clone();
    config.tasks.push(task("v", velocity, 0..6, 20));
    rig = Rig::new(100.0, config.arms, config.tasks);
    rig.make_ready();
    for _ in 0..60 {
        rig.velocity(1, &[0.1; 6]);
        rig.tick();
    }
    assert_eq!((rig.commands[0].mode, rig.commands[0].effort), (Some(ControlMode::Velocity), None));
}
