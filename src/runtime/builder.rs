//! A run from a blueprint's name or text, for programs: what `dimos run` does with its arguments.

use super::{Options, Record, Run, StartError};
use crate::assets::{Cache, NoProgress};
use crate::blueprint::{self, Catalog, FindError, Found, Loaded, Overrides, Source};
use dimos_control::task_spec::{TaskSpec, TaskTable};
use dimos_hardware::registry::{AdapterSpec, Registry};
use dimos_planner::planning::request::planner_thread::Solver;
use dimos_rpc::run_dir::RunDir;

/// A run that is not started yet. Settings that are not changed here come from the blueprint.
///
/// ```
/// use dimos::runtime::{Record, Run};
///
/// let run = Run::from_name("coordinator-yourarm")?
///     .sim() // its emulator, whatever address the blueprint gives
///     .set("coordinator.tick_rate", "250")
///     .name("doc-builder")
///     .record(Record::Off)
///     .start()?;
/// assert_eq!(run.status().tick_rate, 250.0);
/// run.stop();
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Builder {
    found: Found,
    overrides: Overrides,
    adapters: Registry,
    tasks: TaskTable,
    options: Options,
}

impl Run {
    /// A run of a blueprint that `dimos list-blueprints` shows, or of a file. Fails where there is none.
    pub fn from_name(name_or_path: &str) -> Result<Builder, FindError> {
        blueprint::find(name_or_path).map(Builder::of)
    }

    /// A run of a blueprint given as YAML text; `name` is the run's, unless the text gives another.
    ///
    /// ```
    /// use dimos::runtime::{Record, Run};
    ///
    /// let blueprint = "
    /// hardware:
    ///   - {hardware_id: left, adapter_type: mock, joints: {prefix: left, count: 6}}
    /// tasks:
    ///   - {name: traj_left, type: trajectory, joint_names: {hardware: left}}
    /// ";
    /// let run = Run::from_yaml("doc-yaml", blueprint).record(Record::Off).start()?;
    /// assert_eq!(run.state().arms[0].joints[0].name, "left_joint1");
    /// # Ok::<(), dimos::runtime::StartError>(())
    /// ```
    pub fn from_yaml(name: &str, text: &str) -> Builder {
        Builder::of(Found { name: name.to_owned(), source: Source::Embedded, bytes: text.as_bytes().to_vec() })
    }
}

impl Builder {
    fn of(found: Found) -> Self {
        Self {
            found,
            overrides: Overrides::default(),
            adapters: dimos_arms::registry(),
            tasks: TaskTable::builtin(),
            options: Options::default(),
        }
    }

    /// Changes a field of the blueprint, like `--set`: `.set("hardware.arm.address", "192.168.1.100")`.
    pub fn set(mut self, path: &str, value: impl std::fmt::Display) -> Self {
        self.overrides.set.push(format!("{path}={value}"));
        self
    }

    /// Replaces all arms by their emulators, like `--sim`.
    pub fn sim(mut self) -> Self {
        self.overrides.sim = true;
        self
    }

    /// Names the run; live runs have different names.
    pub fn name(mut self, name: &str) -> Self {
        self.options.name = Some(name.to_owned());
        self
    }

    /// Sets the destination of the log.
    pub fn record(mut self, record: Record) -> Self {
        self.options.record = record;
        self
    }

    /// Adds adapters; they replace built-in ones of the same name.
    pub fn adapters(mut self, more: &[AdapterSpec]) -> Self {
        self.adapters = dimos_arms::registry().with(more);
        self
    }

    /// Adds task types; they replace built-in ones of the same name.
    pub fn tasks(mut self, more: &[TaskSpec]) -> Self {
        self.tasks = TaskTable::with(more);
        self
    }

    /// Replaces the built-in planner; called on the planner thread.
    pub fn solver(mut self, solver: Solver) -> Self {
        self.options.solver = Some(solver);
        self
    }

    /// Serves the live view, where the blueprint has a robot model or a section `view`. [`Run::view_url`] has its URL.
    pub fn view(mut self) -> Self {
        self.options.view = true;
        self
    }

    /// Where its socket and lock are; the command line looks in [`RunDir::standard`] only.
    pub fn folder(mut self, folder: RunDir) -> Self {
        self.options.folder = folder;
        self
    }

    /// Reads and checks the blueprint; connects to nothing.
    pub fn check(&self) -> Loaded {
        let catalog = Catalog { adapters: &self.adapters, tasks: &self.tasks };
        blueprint::load(&self.found, &self.overrides, catalog)
    }

    /// Fetches the assets that the blueprint uses and that are not in the user's cache yet.
    pub fn fetch(&self) -> Result<(), StartError> {
        let loaded = self.check();
        for asset in loaded.blueprint.iter().flat_map(|blueprint| blueprint.awaited_assets()) {
            Cache::standard().fetch(asset, &mut NoProgress).map_err(|error| StartError::Blueprint {
                what: error.what,
                hint: error.hint.unwrap_or_else(|| "nothing was connected".to_owned()),
            })?;
        }
        Ok(())
    }

    /// Fetches missing assets and starts the run; returns once all arms are connected. On failure everything is stopped
    /// again, and nothing has moved.
    pub fn start(self) -> Result<Run, StartError> {
        self.fetch()?;
        let loaded = self.check();
        match &loaded.blueprint {
            Some(blueprint) => Run::start(blueprint, self.options),
            None => {
                let what = loaded.render(false).trim_end().to_owned();
                Err(StartError::Blueprint { what, hint: "nothing was connected".to_owned() })
            }
        }
    }
}
