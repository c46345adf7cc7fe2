//! The resolved blueprint: checked, with indices instead of names.

use std::collections::BTreeMap;

use serde_json::Value;

use crate::assets::{Asset, Cache};
use crate::blueprint::assets::Assets;
use crate::blueprint::catalog::Catalog;
use crate::blueprint::endpoints::MetricsConfig;
use crate::blueprint::feed_forward::{self, ArmEffort};
use crate::blueprint::limits::JointOverride;
use crate::blueprint::peripherals::ArmPeripheral;
use crate::blueprint::physics::{self, ArmBody};
use crate::blueprint::planner::{ViewBackend, ViewConfig};
use crate::blueprint::schema::{
    BlueprintFile, CoordinatorConfig, GuardConfig, HardwareType, OnExit, RecordingConfig, RpcConfig,
};
use crate::blueprint::task_robots::{self, Base};
use crate::blueprint::tool_speed::ToolRobot;
use crate::blueprint::{
    arms, assets, endpoints, park, planner_check, planner_files, planner_models, share, task_leaders, tasks,
    tick_clock, tool_speed,
};
use dimos_control::task_leader::LeaderJoint;
use dimos_control::task_spec::TaskSpec;
use dimos_core::arm::{SetpointFields, Supervision};
use dimos_core::joint::{JointLimits, LONGEST_NAME, may_be_in_name};
use dimos_hardware::check::{LineShare, ToolFacts};
use dimos_hardware::device::Setup;
use dimos_hardware::peripheral::Part;
use dimos_hardware::registry::AdapterSpec;
use dimos_planner::planning::scene::config::PlannerConfig;
use dimos_robot::Source;
use dimos_yaml::{Diag, Located, Lost, NOWHERE, NodeId, Severity, Tree, quote};

/// A blueprint without mistakes.
#[derive(Debug, Clone)]
pub struct Blueprint {
    /// Its name; the run's name unless `--name` gives another.
    pub name: String,
    /// One line.
    pub description: String,
    /// The control loop.
    pub coordinator: CoordinatorConfig,
    /// The arms, in the blueprint's order.
    pub arms: Vec<Arm>,
    /// The tasks, in the blueprint's order.
    pub tasks: Vec<Task>,
    /// Motion planning. Its files have not been read yet.
    pub planner: Option<PlannerConfig>,
    /// Distance that the collision guard keeps from obstacles and other arms [m]; `None`: streams are not guarded.
    pub guard: Option<f64>,
    /// The live view, given as `view` or as `planner.visualization`.
    pub view: Option<ViewConfig>,
    /// The log.
    pub recording: RecordingConfig,
    /// The socket.
    pub rpc: RpcConfig,
    /// Where its metrics are served; `None`: there are none.
    pub metrics: Option<MetricsConfig>,
    /// How the run is on a network; `None`: not at all.
    pub share: Option<share::ShareConfig>,
    /// Files that are fetched on first use.
    pub assets: Vec<UsedAsset>,
    /// The complete blueprint as YAML, with includes and arguments merged; recorded in the log.
    pub source_yaml: String,
    /// The files it was read from: name and text, the main one first.
    pub sources: Vec<(String, String)>,
}

impl Blueprint {
    /// Returns the used assets that are not fetched yet.
    pub fn awaited_assets(&self) -> Vec<&Asset> {
        let cache = Cache::standard();
        self.assets.iter().filter(|a| a.used && !cache.has(&a.asset.sha256)).map(|a| &a.asset).collect()
    }

    /// Returns the names of all joints, arm by arm; [`Task::joints`] are indices in this list.
    pub fn joint_names(&self) -> Vec<&str> {
        self.arms.iter().flat_map(|arm| arm.joints.iter().map(String::as_str)).collect()
    }
}

/// An asset of a blueprint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsedAsset {
    /// The asset.
    pub asset: Asset,
    /// Whether any path of the blueprint refers to it.
    pub used: bool,
}

/// An arm.
#[derive(Debug, Clone)]
pub struct Arm {
    /// Its name.
    pub hardware_id: String,
    /// Kind of hardware.
    pub hardware_type: HardwareType,
    /// Names of its joints, from the base.
    pub joints: Vec<String>,
    /// The adapter's row.
    pub adapter: AdapterSpec,
    /// The adapter's name.
    pub adapter_type: String,
    /// Address; `sim` for the emulator, empty if none is needed.
    pub address: String,
    /// Whether the adapter's emulator replaces the arm.
    pub simulated: bool,
    /// Whether the motors are enabled when the run starts.
    pub auto_enable: bool,
    /// What happens to the motors when the run ends.
    pub on_exit: OnExit,
    /// Whether the blueprint sets `on_exit`; otherwise it is the default.
    pub on_exit_given: bool,
    /// Where it goes before its motors are disabled, with [`OnExit::Park`] [rad]; empty otherwise.
    pub park_pose: Vec<f64>,
    /// Figures that its measurements and motion are checked against.
    pub supervision: Supervision,
    /// What is set of its optional parts.
    pub setup: Setup,
    /// Its gripper and its sensor, where they have their own connections.
    pub peripherals: Vec<ArmPeripheral>,
    /// The adapter's own options: an object.
    pub options: Value,
    /// The arm's own limits, from its adapter.
    pub own_limits: JointLimits,
    /// Limits narrower than the arm's own, one entry for each joint.
    pub limits: Vec<JointOverride>,
    /// What is known of its tool.
    pub tool: ToolFacts,
    /// What it takes of its line, if other arms may be on it.
    pub line: Option<LineShare>,
    /// Highest speed of its tool [m/s]: the blueprint's, else the vendor's.
    pub tcp_velocity: Option<f64>,
    /// What the speed of its tool is computed with, if a model is known.
    pub tool_robot: Option<ToolRobot>,
    /// What its adapter passes on of setpoints besides positions, as far as that is known before it is connected.
    pub setpoint: SetpointFields,
    /// What it is commanded beside positions; `None`: nothing.
    pub effort: Option<ArmEffort>,
    /// The body behind its emulator; `None`: joints without mass.
    pub body: Option<ArmBody>,
}

impl Arm {
    /// Returns whether commands reach a device: it is neither an emulator nor an arm in memory.
    pub fn is_real(&self) -> bool {
        !self.simulated && self.adapter.transport != "memory"
    }

    /// Returns whether it may have a gripper.
    pub fn has_gripper(&self) -> bool {
        self.adapter.gripper || self.peripherals.iter().any(|own| own.row.part == Part::Gripper)
    }
}

/// A task.
#[derive(Debug, Clone)]
pub struct Task {
    /// Its name.
    pub name: String,
    /// The row of its type.
    pub spec: TaskSpec,
    /// Its parameters, defaults filled in.
    pub params: Value,
    /// Its joints, as indices in [`Blueprint::joint_names`].
    pub joints: Vec<usize>,
    /// Indices of the arms of these joints.
    pub arms: Vec<usize>,
    /// Priority: the higher number wins a joint.
    pub priority: i32,
    /// Whether it is started with the run.
    pub auto_start: bool,
    /// The robot whose end effector it moves, if its type needs one.
    pub robot: Option<TaskRobot>,
    /// The joint that each of its joints follows, if its type has a leader.
    pub leader: Vec<LeaderJoint>,
}

/// The robot of a task that moves an end effector. Its description has been checked, and is read again for a run.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskRobot {
    /// Its description.
    pub source: Source,
    /// The model's names of the task's joints, in the task's order.
    pub joints: Vec<String>,
    /// The link that the task moves.
    pub link: String,
    /// Pose of the tool centre point in the frame of that link; `None`: the link itself.
    pub tool: Option<nalgebra::Isometry3<f64>>,
    /// Its base pose if it is a robot of the planner; otherwise everything is in the frame of the model's root.
    pub base: Option<Base>,
    /// Positions of joints that the task does not move, by the model's names [rad or m].
    pub fixed: BTreeMap<String, f64>,
}

/// Context of all checks: the tree, the nodes that could not be read, and the catalog.
pub(super) struct Checker<'t> {
    pub(super) tree: &'t mut Tree,
    /// The root node of the blueprint.
    pub(super) root: NodeId,
    pub(super) lost: Lost,
    pub(super) catalog: Catalog<'t>,
    /// The assets that paths may refer to.
    pub(super) assets: Assets,
    /// Whether a file could not be read, so that names may be missing.
    pub(super) incomplete: bool,
}

impl Checker<'_> {
    /// Reports a mistake at a node.
    pub(super) fn error(&mut self, at: NodeId, diag: Diag) {
        let diag = if at == NOWHERE { diag } else { diag.at(self.tree.label(at)) };
        self.tree.report(diag);
    }

    /// Returns whether a key of a group was read as written (or may be absent).
    pub(super) fn has(&self, group: NodeId, key: &str) -> bool {
        !self.lost.key(group, key)
    }

    /// Returns whether a list at the top level could not be read completely.
    pub(super) fn list_lost(&self, key: &str) -> bool {
        let damaged = |list| self.tree.is_damaged(list) || self.tree.items(list).iter().any(|i| self.lost.dropped(*i));
        self.incomplete || !self.has(self.root, key) || self.tree.get(self.root, key).is_some_and(damaged)
    }

    /// Returns whether a name is valid; reports it if not.
    pub(super) fn check_name(&mut self, name: &Located<String>, what: &str) -> bool {
        let problem = match name.value.chars().find(|c| !may_be_in_name(*c)) {
            _ if name.is_empty() => format!("the {what} is empty"),
            Some(' ') => format!("the {what} {} contains a space", quote(name)),
            Some(c) => format!("the {what} {} contains {}", quote(name), quote(&c.to_string())),
            None if name.starts_with('-') => format!("the {what} {} starts with a dash", quote(name)),
            None if name.len() > LONGEST_NAME => {
                format!("the {what} {} is longer than {LONGEST_NAME} characters", quote(name))
            }
            None => return true,
        };
        let instead: String =
            name.value.chars().map(|c| if may_be_in_name(c) { c } else { '_' }).take(LONGEST_NAME).collect();
        let instead = instead.trim_start_matches('-');
        let hint = match name.value.is_ascii() && instead.chars().any(|c| c.is_ascii_alphanumeric()) {
            true => format!("use letters, digits, `_` and `-`: {instead}"),
            false => "use the letters a to z and A to Z, digits, `_` and `-`".to_owned(),
        };
        self.error(name.at, Diag::error(problem).hint(hint));
        false
    }
}

/// Checks the meaning of a blueprint. The result is only valid if nothing was reported.
pub(super) fn resolve(mut checker: Checker<'_>, file: BlueprintFile, default_name: &str) -> Blueprint {
    let root = checker.root;
    let name = file.name.unwrap_or_else(|| default_name.to_owned().into());
    if checker.has(root, "name") {
        let at = if name.at == NOWHERE { root } else { name.at };
        checker.check_name(&Located { at, value: name.value.clone() }, "blueprint's name");
    }
    let mut hardware = arms::resolve(&mut checker, &file.hardware);
    let mut tasks = tasks::resolve(&mut checker, &file.tasks, &hardware);
    tick_clock::check(&mut checker, &file.coordinator.clock, &hardware);
    park::check_tasks(&mut checker, &file.hardware, &tasks, &hardware);
    checker.assets = Assets::of(file.assets);
    assets::check(&mut checker, &file.tasks, file.planner.as_ref());
    let planner = file.planner.as_ref().map(|planner| {
        let described = planner_models::read(&mut checker, planner);
        planner_check::check(&mut checker, planner, &described, file.view.as_ref(), &file.tasks, &hardware);
        let config = planner_files::resolve(&checker, planner, &described, &hardware);
        planner_models::check(&mut checker, planner, &described, &config, &hardware);
        config
    });
    let guard = guard(&mut checker, file.guard.as_ref(), planner.is_some());
    task_robots::resolve(&mut checker, &file.tasks, &mut tasks, planner.as_ref(), &hardware);
    tool_speed::resolve(&mut checker, &file.hardware, &mut hardware, &tasks, planner.as_ref());
    feed_forward::resolve(&mut checker, &file.hardware, &mut hardware, &tasks, planner.as_ref());
    physics::resolve(&mut checker, &file.hardware, &mut hardware, &tasks, planner.as_ref());
    task_leaders::resolve(&mut checker, &file.tasks, &mut tasks, &hardware);
    let assets = assets::resolved(&checker, &file.tasks, file.planner.as_ref());
    let view = file.view.or_else(|| file.planner.and_then(|p| p.value.visualization));
    // Only without errors: a mistake in the section may have changed its backend.
    let sound = checker.tree.diags().iter().all(|diag| diag.severity != Severity::Error);
    let served = view.as_ref().filter(|view| sound && view.backend != ViewBackend::None);
    if let Some(view) = served.filter(|view| !view.host.is_loopback()) {
        let what = format!("the live view is open to the network at {}, not encrypted", view.host);
        let diag = Diag::warning(what).note("anyone who reads the traffic has the token, and can command the arms");
        checker.error(view.at, diag.hint("remove `host` and connect through ssh: docs/view.md"));
    }
    endpoints::check(&mut checker, file.metrics.as_ref());
    let share = file.share.as_ref().map(|entry| share::resolve(&mut checker, entry));
    Blueprint {
        name: name.value,
        description: file.description,
        coordinator: file.coordinator,
        arms: hardware.arms,
        tasks,
        planner,
        guard,
        view: view.map(|v| v.value),
        recording: file.recording,
        rpc: file.rpc,
        metrics: file.metrics.map(|metrics| metrics.value),
        share,
        assets,
        source_yaml: String::new(),
        sources: Vec::new(),
    }
}

/// Returns the margin of the collision guard, which needs the planner's robots.
fn guard(checker: &mut Checker<'_>, guard: Option<&Located<GuardConfig>>, planner: bool) -> Option<f64> {
    let config = guard.map_or_else(GuardConfig::default, |guard| guard.value.clone());
    if let Some(guard) = guard.filter(|_| config.enabled && !planner && !checker.incomplete) {
        let diag = Diag::error("the collision guard has no robots: this blueprint has no `planner`");
        checker.error(guard.at, diag.hint("add `planner`, or remove `guard`"));
    }
    (config.enabled && planner).then_some(config.margin)
}
