//! What a trial is made from: the row, rate, task, arms and lie of a seed.

use std::collections::VecDeque;

use dimos::arm::ArmState;
use dimos::clock::Mono;
use dimos::control::config::*;
use dimos::control::coordinator::Coordinator;
use dimos::control::task_spec::TaskTable;
use dimos::robot::random::Random;
use dimos::telemetry::{Cause, Phase, TaskView};

use super::arm_rows::{Row, rows};
use super::arm_traits::{Traits, Velocities};
use super::lies::{KINDS, Kind, Lie, OCCASIONS, Occasion};
use super::motion_judge::Judge;
use super::trial::{Act, Trial};
use super::true_arm::TrueArm;

/// Which trial a seed is.
pub fn kind_of(seed: u64) -> (usize, Kind) {
    let rows = rows().len() as u64;
    ((seed % rows) as usize, KINDS[(seed / rows % KINDS.len() as u64) as usize])
}

impl Trial {
    pub fn new(seed: u64, honest: bool) -> Self {
        let mut random = Random::new(seed ^ if honest { 0x5eed_0000_0000 } else { 0 });
        let (index, kind) = kind_of(seed);
        let rates = rows()[index].rates();
        let rate = if random.below(8) == 0 { rates[random.below(rates.len())] } else { rates[0] };
        let row = rows()[index].at(rate);
        let act = loop {
            let act = [Act::Trajectory, Act::Servo, Act::Velocity, Act::Chunk, Act::Pose, Act::Twist, Act::Follow];
            match act[random.below(7)] {
                Act::Velocity if !row.has_velocity() => {}
                Act::Pose | Act::Twist if row.robot.is_none() => {}
                act => break act,
            }
        };
        let occasion = OCCASIONS[random.below(OCCASIONS.len())];
        let leader = act == Act::Follow && random.below(2) == 0 && occasion == Occasion::Motion;
        let mut lie = Lie::draw(kind, occasion, row.arm.dof, row.arm.read_period.as_secs_f64(), &mut random);
        lie.of_adapter |= leader;
        let (config, acts) = Self::config(&row, rate, act);
        let period = config.period();
        let mut arms: Vec<TrueArm> = config
            .arms
            .iter()
            .map(|_| {
                let mut traits = Traits::draw(&row, &mut random);
                if !honest && random.below(8) == 0 {
                    traits.velocities = Velocities::Zeros;
                }
                let q: Vec<f64> = row.middle().iter().map(|q| q + random.between(-0.2, 0.2)).collect();
                TrueArm::new(&row, traits, &q, period)
            })
            .collect();
        if let [follower, leader] = &mut arms[..] {
            leader.q = follower.q.iter().map(|q| q + random.between(-0.1, 0.1)).collect();
        }
        let judges = arms
            .iter()
            .enumerate()
            .map(|(i, a)| Judge::new(i, &row.arm, &a.q, a.traits.noise + a.traits.resolution, 1.0 / rate))
            .collect();
        let begin = Mono(1_000_000_000);
        Self {
            seed,
            rate,
            act,
            lie: (!honest).then_some((usize::from(leader), lie)),
            lied_at: None,
            written_before: 0,
            noise: Random::new(random.bits()),
            random,
            coordinator: Coordinator::new(&config, TaskTable::builtin().build(&config.tasks).unwrap()),
            phases: vec![(Phase::Unknown, Cause::None); arms.len()],
            said: vec![ArmState::default(); arms.len()],
            commands: vec![Default::default(); arms.len()],
            arms,
            judges,
            now: begin,
            began: begin,
            inbox: VecDeque::new(),
            next_id: 1,
            outcomes: Vec::new(),
            tasks: vec![TaskView::default(); config.tasks.len()],
            acts,
            hand: None,
            hand_time: 0.0,
            velocities: None,
            led_by_reading: true,
            late_states: honest,
            late_left: vec![0; 2],
            verbose: false,
            recorded: None,
            row,
        }
    }

    fn config(row: &Row, rate: f64, act: Act) -> (CoordinatorConfig, Vec<Act>) {
        let s = &row.arm.supervision;
        let dof = row.arm.dof as u16;
        let trajectory =
            TrajectoryParams { goal_tolerance: 0.02 + 2.0 * s.accuracy + s.droop, ..TrajectoryParams::default() };
        let mut acts = vec![Act::Trajectory, Act::Servo, Act::Chunk];
        acts.extend(row.has_velocity().then_some(Act::Velocity));
        acts.extend(matches!(act, Act::Pose | Act::Twist | Act::Follow).then_some(act));
        let kind = |act: &Act| match act {
            Act::Trajectory => TaskKind::new("trajectory", &trajectory),
            Act::Servo => TaskKind::new("servo", &ServoParams::default()),
            Act::Chunk => TaskKind::new("chunk", &ChunkParams::default()),
            Act::Velocity => TaskKind::new("velocity", &VelocityParams::default()),
            Act::Pose | Act::Twist => {
                let name = if *act == Act::Pose { "cartesian_ik" } else { "eef_twist" };
                let kind = TaskKind::new(name, &CartesianParams::default());
                row.robot.clone().map_or(kind.clone(), |robot| kind.of_robot(robot))
            }
            Act::Follow => {
                let params = FollowParams { leader: Some("leader".to_owned()), ..FollowParams::default() };
                let led = |joint| LeaderJoint { joint, scale: 1.0, offset: 0.0, endless: false };
                TaskKind::new("follow", &params).led_by((dof..2 * dof).map(led).collect())
            }
        };
        let tasks = acts.iter().enumerate().map(|(i, act)| TaskConfig {
            name: format!("t{i}"),
            kind: kind(act),
            joints: (0..dof).collect(),
            priority: 10,
            auto_start: false,
        });
        let tasks = tasks.collect();
        let mut arms = vec![row.arm.clone()];
        if act == Act::Follow {
            arms.push(ArmConfig { name: "leader".to_owned(), ..row.arm.clone() });
        }
        (CoordinatorConfig { version: CONFIG_VERSION, rate, arms, tasks }, acts)
    }
}
