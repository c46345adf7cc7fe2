//! A blueprint as it is meant: checked, indices instead of names, SI units.

use serde_json::Value;

use crate::arm::Supervision;
use crate::assets::{Asset, Cache};
use crate::blueprint::assets::Assets;
use crate::blueprint::catalog::Catalog;
use crate::blueprint::limits::JointOverride;
use crate::blueprint::planner::{ViewBackend, ViewConfig};
use crate::blueprint::schema::{BlueprintFile, CoordinatorConfig, HardwareType, OnExit, RecordingConfig, RpcConfig};
use crate::blueprint::task_robots::{self, Base};
use crate::blueprint::{arms, assets, planner_check, planner_files, planner_models, tasks};
use crate::control::task_spec::TaskSpec;
use crate::hardware::registry::AdapterSpec;
use crate::joint::JointLimits;
use crate::planning::config::PlannerConfig;
use crate::robot::Source;
use crate::yaml::{Diag, Located, Lost, NOWHERE, NodeId, Severity, Tree, quote};

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
    /// The live view, given as `view` or as `planner.visualization`.
    pub view: Option<ViewConfig>,
    /// The log.
    pub recording: RecordingConfig,
    /// The socket.
    pub rpc: RpcConfig,
    /// Files that are fetched on first use.
    pub assets: Vec<UsedAsset>,
    /// The whole blueprint as one YAML text, includes and arguments merged in: what the log keeps.
    pub source_yaml: String,
    /// The files it was read from: name and text, the main one first.
    pub sources: Vec<(String, String)>,
}

impl Blueprint {
    /// The assets that it uses and that have not been fetched yet.
    pub fn awaited_assets(&self) -> Vec<&Asset> {
        let cache = Cache::standard();
        self.assets.iter().filter(|a| a.used && !cache.has(&a.asset.sha256)).map(|a| &a.asset).collect()
    }

    /// The names of all joints, arm by arm: what [`Task::joints`] counts.
    pub fn joint_names(&self) -> Vec<&str> {
        self.arms.iter().flat_map(|arm| arm.joints.iter().map(String::as_str)).collect()
    }
}

/// An asset of a blueprint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsedAsset {
    /// What it is.
    pub asset: Asset,
    /// Whether any path of the blueprint leads into it.
    pub used: bool,
}

/// An arm.
#[derive(Debug, Clone)]
pub struct Arm {
    /// Its name.
    pub hardware_id: String,
    /// What kind of hardware it is.
    pub hardware_type: HardwareType,
    /// Its joints' names, base first.
    pub joints: Vec<String>,
    /// The adapter's row.
    pub adapter: AdapterSpec,
    /// The adapter's name.
    pub adapter_type: String,
    /// Where the arm is; `sim` for the emulator; empty where no address is needed.
    pub address: String,
    /// Whether the adapter's emulator replaces the arm.
    pub simulated: bool,
    /// Whether the motors are enabled when the run starts.
    pub auto_enable: bool,
    /// What happens to the motors when the run ends.
    pub on_exit: OnExit,
    /// Whether the blueprint says so, or the default was taken.
    pub on_exit_given: bool,
    /// Figures with which its measurements and its motion are checked.
    pub supervision: Supervision,
    /// The adapter's own options: an object.
    pub options: Value,
    /// The arm's own nominal limits, by its number of joints and its options.
    pub own_limits: JointLimits,
    /// Limits narrower than the arm's own, one entry for each joint.
    pub limits: Vec<JointOverride>,
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
    /// The joints it commands, counted over all arms' joints in the blueprint's order.
    pub joints: Vec<usize>,
    /// The arms those joints belong to.
    pub arms: Vec<usize>,
    /// Who wins a joint: the higher number.
    pub priority: i32,
    /// Whether it is started with the run.
    pub auto_start: bool,
    /// The robot whose end effector it moves, where its type needs one.
    pub robot: Option<TaskRobot>,
}

/// The robot of a task that moves an end effector. Its description has been checked, and is read again for a run.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskRobot {
    /// Its description.
    pub source: Source,
    /// The model's names of the task's joints, in the task's order.
    pub joints: Vec<String>,
    /// The link that is moved.
    pub link: String,
    /// Its base pose if it is a robot of the planner; otherwise everything is in the frame of the model's root.
    pub base: Option<Base>,
}

/// What every check needs: the tree to point into, and what reading had to leave out.
pub(super) struct Checker<'t> {
    pub(super) tree: &'t mut Tree,
    /// The blueprint's own group.
    pub(super) root: NodeId,
    pub(super) lost: Lost,
    pub(super) catalog: Catalog<'t>,
    /// Files that paths may lead into.
    pub(super) assets: Assets,
    /// A file could not be read: names may be missing for that reason.
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

    /// Whether an entry of a list at the top, or all of it, was left out.
    pub(super) fn list_lost(&self, key: &str) -> bool {
        let damaged = |list| self.tree.is_damaged(list) || self.tree.items(list).iter().any(|i| self.lost.dropped(*i));
        self.incomplete || !self.has(self.root, key) || self.tree.get(self.root, key).is_some_and(damaged)
    }

    /// Reports a name that cannot be one.
    pub(super) fn check_name(&mut self, name: &Located<String>, what: &str) -> bool {
        let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
        let problem = match name.value.chars().find(|c| !good(*c)) {
            _ if name.is_empty() => format!("the {what} is empty"),
            Some(' ') => format!("the {what} {} contains a space", quote(name)),
            Some(c) => format!("the {what} {} contains {}", quote(name), quote(&c.to_string())),
            None if name.starts_with('-') => format!("the {what} {} starts with a dash", quote(name)),
            None if name.len() > 64 => format!("the {what} {} is longer than 64 characters", quote(name)),
            None => return true,
        };
        let instead: String = name.value.chars().map(|c| if good(c) { c } else { '_' }).take(64).collect();
        let instead = instead.trim_start_matches('-');
        let hint = match name.value.is_ascii() && instead.chars().any(|c| c.is_ascii_alphanumeric()) {
            true => format!("use letters, digits, `_` and `-`: {instead}"),
            false => "use the letters a to z and A to Z, digits, `_` and `-`".to_owned(),
        };
        self.error(name.at, Diag::error(problem).hint(hint));
        false
    }
}

/// Checks the meaning of a blueprint as typed. What it gives is only of use when nothing was reported.
pub(super) fn resolve(mut checker: Checker<'_>, file: BlueprintFile, default_name: &str) -> Blueprint {
    let root = checker.root;
    let name = file.name.unwrap_or_else(|| default_name.to_owned().into());
    if checker.has(root, "name") {
        let at = if name.at == NOWHERE { root } else { name.at };
        checker.check_name(&Located { at, value: name.value.clone() }, "blueprint's name");
    }
    let found = arms::resolve(&mut checker, &file.hardware);
    let mut tasks = tasks::resolve(&mut checker, &file.tasks, &found);
    checker.assets = Assets::of(file.assets);
    assets::check(&mut checker, &file.tasks, file.planner.as_ref());
    let planner = file.planner.as_ref().map(|planner| {
        let described = planner_models::read(&mut checker, planner);
        planner_check::check(&mut checker, planner, &described, file.view.as_ref(), &file.tasks, &found);
        let config = planner_files::resolve(&checker, planner, &described);
        planner_models::check(&mut checker, planner, &described, &config);
        config
    });
    task_robots::resolve(&mut checker, &file.tasks, &mut tasks, planner.as_ref(), &found);
    let assets = assets::resolved(&checker, &file.tasks, file.planner.as_ref());
    let view = file.view.or_else(|| file.planner.and_then(|p| p.value.visualization));
    // What is wrong comes first: a mistake in the section may be the reason for its backend.
    let sound = checker.tree.diags().iter().all(|diag| diag.severity != Severity::Error);
    if let Some(view) = view.as_ref().filter(|view| sound && view.backend != ViewBackend::None) {
        let diag = Diag::warning("the live view is not in this version: no page will be served");
        checker.error(view.at, diag.hint("leave the section out, or say `backend: none`"));
    }
    Blueprint {
        name: name.value,
        description: file.description,
        coordinator: file.coordinator,
        arms: found.arms,
        tasks,
        planner,
        view: view.map(|v| v.value),
        recording: file.recording,
        rpc: file.rpc,
        assets,
        source_yaml: String::new(),
        sources: Vec::new(),
    }
}
