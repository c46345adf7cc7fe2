//! A job: its steps, and what each of them does.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::cli::grip::Opening;
use dimos_rpc::api::{Attach, OnPath, PlanGoal, Until};
use dimos_yaml::{NodeId, Tree};

/// A job that can be run.
pub struct Job {
    /// The file's tree.
    pub tree: Tree,
    /// Name of the file.
    pub file: String,
    /// The arm of steps that name none; empty: the run's only arm.
    pub arm: String,
    /// Its steps.
    pub steps: Vec<Step>,
    /// How often they are done; `None`: until the job is ended.
    pub repeat: Option<u64>,
    /// Steps after a fault.
    pub on_fault: Vec<Step>,
    /// Number of all steps, nested ones too.
    pub count: usize,
}

/// A step.
pub struct Step {
    /// Its place.
    pub at: NodeId,
    /// Its number, in the order of the file, from 0.
    pub id: usize,
    /// Its line, from 1.
    pub line: usize,
    /// How it begins in the file.
    pub text: String,
    /// Its arm; empty: that of the job.
    pub arm: String,
    /// What it does.
    pub act: Act,
}

/// What a step does.
pub enum Act {
    /// Moves the arm.
    Move(Box<Motion>),
    /// Opens or closes the gripper, and waits until it settles. `object`: whether it must hold something then.
    Gripper { to: Opening, force: Option<f64>, object: Option<bool>, timeout: Duration },
    /// Waits.
    Wait(Duration),
    /// Waits for the level of a digital input.
    Input { input: String, high: bool, timeout: Option<Duration> },
    /// Sets outputs.
    Output(BTreeMap<String, f64>),
    /// Repeats steps.
    Repeat { times: u64, steps: Vec<Step> },
    /// Attaches an object to the arm, in the planner's world.
    Attach(Attach),
    /// Detaches an object.
    Detach(String),
    /// Clears the hold of the arm.
    Reset,
    /// Enables the arm.
    Enable,
}

/// A motion of a step. Its goals get their robot later.
#[derive(Clone)]
pub struct Motion {
    /// Waypoints before the goal.
    pub through: Vec<PlanGoal>,
    /// The goal.
    pub goal: PlanGoal,
    /// How far away waypoints may be passed [m].
    pub blend: f64,
    /// Fraction of the highest speed.
    pub speed: f64,
    /// Highest speed of the tool [m/s].
    pub tcp_speed: Option<f64>,
    /// Obstacles that the end effector may touch.
    pub touch: Vec<String>,
    /// Whether it is straight in joint space, without a planner.
    pub direct: bool,
    /// Whether it is planned again if an obstacle blocks it.
    pub replan: bool,
    /// What is done at places of its path.
    pub on_path: Vec<OnPath>,
    /// What ends it before its goal.
    pub until: Option<Until>,
}
