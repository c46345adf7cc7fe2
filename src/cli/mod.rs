//! The command line: one file per verb. stdout is data, stderr is diagnostics; exit codes are a contract ([`exit`]).

pub mod adapter;
pub mod arguments;
pub mod arm;
mod ask;
mod attach;
pub mod back_out;
pub mod banner;
pub mod cancel;
mod causes;
pub mod check;
pub mod complete;
pub mod completions;
pub mod daemon;
pub mod demo;
pub mod doctor;
pub mod down;
mod escapes;
pub mod execute;
pub mod exit;
mod fetch;
mod follow;
mod full_speed;
mod goal;
mod going;
mod grip;
pub mod job;
pub mod jog;
mod lasting;
pub mod list_adapters;
pub mod list_blueprints;
pub mod log;
pub mod logs;
pub mod man;
pub mod model;
pub mod motion;
pub mod new;
mod other_users;
pub mod output;
pub mod plan;
pub mod pose;
pub mod preview;
pub mod proxy;
mod recorded_path;
mod redraw;
pub mod replay;
pub mod run;
pub mod run_record;
pub mod schema;
pub mod share;
mod share_child;
pub mod speed;
pub mod state;
pub mod status;
pub mod stop;
mod targets;
pub mod task;
mod text_log;
pub mod top;
mod trajectory_file;
mod typed;
pub mod view;
pub mod world;

use std::process::ExitCode;
use std::sync::OnceLock;

use clap::error::{ContextKind, ContextValue};
use clap::{ArgMatches, CommandFactory, FromArgMatches, Parser, Subcommand};
use rustix::process::{Resource, getrlimit};

use crate::blueprint::{self, Catalog, TaskSpec, TaskTable};
use dimos_hardware::registry::{Absent, AdapterSpec};
use dimos_robot::builtin;

/// Stack that the command line takes at most, and the stack that it has where that of the process is smaller [bytes].
const MIN_STACK: u64 = 4 << 20;
const OWN_STACK: usize = 8 << 20;
const START_WITH: &str = "\
Start with:  dimos demo
Then with an arm:  dimos run coordinator-yourarm, and in a second terminal:  dimos status, dimos state, dimos move arm \
0.3 -0.2 0.5 0 0.4 0
Your own arm:  dimos new";

const NO_SAFETY_FUNCTION: &str = "\
`stop` is an operational stop, not a safety function. Use the arm's own rated stop to protect people.";

/// What is linked into the program, and the parts of the page: `packaging/notices.py --list` writes it.
const LICENCES: &str = include_str!("../../assets/licences.txt");

fn after_help() -> String {
    let codes = exit::Exit::ALL.iter().map(|(exit, meaning)| format!("\n  {:<3}  {meaning}", *exit as u8));
    format!("{START_WITH}\n\nExit codes:{}\n\n{NO_SAFETY_FUNCTION}", codes.collect::<String>())
}

#[derive(Debug, Parser)]
#[command(name = "dimos", version = crate::VERSION, about = "Runs robot arms from a blueprint", after_help = after_help())]
#[command(arg_required_else_help = true)]
struct Cli {
    /// Talk to runs on another computer: an endpoint (tls/HOST:PORT) or a name in places.yaml; default: $DIMOS_AT.
    /// May also follow the verb
    #[arg(long, value_name = "PLACE")]
    at: Option<String>,
    /// List what is shipped in this program, with licences; the packages have the texts
    #[arg(long)]
    licenses: bool,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Start a run from a blueprint; Ctrl-C shuts it down
    Run(run::Args),
    /// Start a simulated cell of two arms, and print three things to try
    Demo(demo::Args),
    /// Write a blueprint for your arm: asks six questions, or takes the answers as options
    New(new::Args),
    /// Show all runs, or one in full: arms, tasks, timing, faults
    Status(status::Args),
    /// Show joints, gripper, pose and force of a run's arms
    State(state::Args),
    /// Watch all runs on one screen: arms, motions, holds, timing
    Top(top::Args),
    /// Move an arm to joint positions or a pose, and wait for the end
    Move(motion::Args),
    /// Plan a collision-free motion of one or several arms; moves nothing
    Plan(plan::Args),
    /// Show a plan point by point, or write its trajectory to a file
    Preview(preview::Args),
    /// Execute the newest plan, or a trajectory from a file (JSON or CSV), and wait for the end
    Execute(execute::Args),
    /// Edit the planner's obstacles: list, add, move, remove, load, attach, detach
    World(world::Args),
    /// Run a job from a file: motions, gripper, inputs and outputs, loops; reports cycle times
    Do(job::Args),
    /// Retrace the logged path of an arm, back to where it was at rest before
    BackOut(back_out::Args),
    /// Decelerate running motions to rest, and end planning
    Cancel(cancel::Args),
    /// Show or set the speed of all motions: a fraction, as 0.3 or 30%
    Speed(speed::Args),
    /// Pause all motions on their paths
    Pause(speed::PauseArgs),
    /// Continue paused motions
    Resume(speed::PauseArgs),
    /// Hold arms at once and keep them held until `arm reset`: an operational stop
    Stop(stop::Args),
    /// Enable, disable or reset an arm, move its gripper; find, set up and calibrate one without a run
    Arm(arm::Args),
    /// Save where the arms are under a name, for `move --named`; list and remove saved poses
    Pose(pose::Args),
    /// Drive an arm from the keyboard, in the terminal
    Jog(jog::Args),
    /// List tasks, query one, or stream targets to it
    Task(task::Args),
    /// Serve an arm of a run to programs that were written for a vendor's SDK
    Proxy(proxy::Args),
    /// Print the URL of the live view, a page in the browser; or show a log, robot model or blueprint in it
    View(view::Args),
    /// Share a run with other computers, which reach it with --at
    Share(share::Args),
    /// Shut down a run: decelerate, release the arms, close the log
    Down(down::Args),
    /// Show the text log of a run that was started with --daemon, live or dead
    Logs(logs::Args),
    /// List, check, print, cut, repair, export and plot logs
    Log(log::Args),
    /// Add an arm: generate its adapter, test it, run its emulator
    Adapter(adapter::Args),
    /// List the supported arms
    ListAdapters(list_adapters::Args),
    /// List the blueprints that `run` knows by name
    ListBlueprints(list_blueprints::Args),
    /// Validate a blueprint and print the resolved configuration
    Check(check::Args),
    /// Print the JSON Schema of blueprints, for editors
    Schema(schema::Args),
    /// Inspect robot descriptions: joints, limits, shapes, mistakes
    Model(model::Args),
    /// Check this computer: real time, permissions, clock, disk, CAN links
    Doctor(doctor::Args),
    /// Print completions for a shell
    Completions(completions::Args),
    /// Print the manual page, or write one for every verb
    Man(man::Args),
    #[command(about = "Play a log in the terminal, or repeat its motion with an arm")]
    Replay(replay::ReplayArgs),
}

impl Command {
    /// Returns whether the verb can talk to a run on another computer.
    fn talks_to_runs(&self) -> bool {
        match self {
            Self::Status(_) | Self::State(_) | Self::Move(_) | Self::Plan(_) | Self::Preview(_) | Self::Execute(_) => {
                true
            }
            Self::World(_) | Self::Do(_) | Self::BackOut(_) | Self::Cancel(_) | Self::Speed(_) | Self::Pause(_) => true,
            Self::Resume(_) | Self::Stop(_) | Self::Arm(_) | Self::Pose(_) | Self::Jog(_) | Self::Task(_) => true,
            Self::Proxy(_) | Self::Run(_) | Self::View(_) | Self::Down(_) | Self::Logs(_) | Self::Top(_) => true,
            Self::Share(_) | Self::Log(_) | Self::Demo(_) | Self::New(_) => false,
            Self::Adapter(_) | Self::ListAdapters(_) | Self::ListBlueprints(_) | Self::Check(_) | Self::Schema(_) => {
                false
            }
            Self::Model(_) | Self::Doctor(_) | Self::Completions(_) | Self::Man(_) | Self::Replay(_) => false,
        }
    }
}

/// The whole program, with what another crate adds to it.
///
/// ```no_run
/// use std::process::ExitCode;
/// use dimos::hardware::registry::AdapterSpec;
///
/// # mod acme { pub const SPEC: dimos::hardware::registry::AdapterSpec = dimos::arms::mock::SPEC; }
/// fn main() -> ExitCode {
///     let blueprint = "hardware: [{hardware_id: arm, adapter_type: acme, joints: {prefix: arm, count: 6}}]";
///     dimos::cli::Program::new().adapter(acme::SPEC).blueprint("coordinator-acme", blueprint).main()
/// }
/// ```
#[derive(Debug, Clone, Default)]
pub struct Program {
    adapters: Vec<AdapterSpec>,
    tasks: Vec<TaskSpec>,
    absent: Vec<Absent>,
    blueprints: Vec<(&'static str, &'static str)>,
    robots: Vec<(&'static str, &'static str)>,
    verbs: Vec<Verb>,
}

/// A verb of another crate.
#[derive(Debug, Clone)]
struct Verb {
    command: clap::Command,
    run: fn(&ArgMatches) -> exit::Result,
}

/// The verbs of the crate that embeds this one.
static VERBS: OnceLock<Vec<Verb>> = OnceLock::new();

fn verbs() -> &'static [Verb] {
    VERBS.get().map(Vec::as_slice).unwrap_or_default()
}

impl Program {
    /// The program as it is.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds an adapter; it wins over a built-in one of the same name.
    pub fn adapter(mut self, row: AdapterSpec) -> Self {
        self.adapters.push(row);
        self
    }

    /// Adds a task type; it wins over a built-in one of the same name. `docs/adding-a-task.md` has a complete one.
    pub fn task(mut self, row: TaskSpec) -> Self {
        self.tasks.push(row);
        self
    }

    /// Names an adapter that this build does not have, and the way to get it.
    pub fn absent(mut self, row: Absent) -> Self {
        self.absent.push(row);
        self
    }

    /// Adds a blueprint that is run by name, wherever the program is started: its name, and its text in YAML.
    pub fn blueprint(mut self, name: &'static str, text: &'static str) -> Self {
        self.blueprints.push((name, text));
        self
    }

    /// Adds a robot description that blueprints and `model` name `builtin:NAME`: its name, and its text, a URDF.
    pub fn robot(mut self, name: &'static str, text: &'static str) -> Self {
        self.robots.push((name, text));
        self
    }

    /// Adds a verb, such as `calibrate`: its name, help and arguments, and what it does. A [`exit::Failure`] is printed
    /// with its hint and ends with its exit code. The name must be none of this program's.
    pub fn verb(mut self, command: clap::Command, run: fn(&ArgMatches) -> exit::Result) -> Self {
        self.verbs.push(Verb { command, run });
        self
    }

    /// Runs the command line: what `main` does.
    pub fn main(self) -> ExitCode {
        // A second program in the same process keeps the verbs of the first.
        let _ = VERBS.set(self.verbs);
        blueprint::embed(self.blueprints);
        builtin::embed(self.robots);
        let adapters = dimos_arms::registry().with(&self.adapters).lacking(&self.absent);
        command_line(Catalog { adapters: &adapters, tasks: &TaskTable::with(&self.tasks) })
    }
}

/// The command line: verbs, options, help texts. For man pages, completions and tests.
pub fn command() -> clap::Command {
    with_verbs(verbs())
}

fn with_verbs(verbs: &[Verb]) -> clap::Command {
    Cli::command().subcommands(verbs.iter().map(|verb| verb.command.clone()))
}

/// Returns the added verb that the arguments name, and its own arguments.
fn added<'a>(verbs: &'a [Verb], arguments: &'a ArgMatches) -> Option<(&'a Verb, &'a ArgMatches)> {
    let (name, own) = arguments.subcommand()?;
    Some((verbs.iter().find(|verb| verb.command.get_name() == name)?, own))
}

/// Runs the command line with adapters besides the built-in ones. [`Program`] can add more than that.
pub fn main_with(adapters: &[AdapterSpec]) -> ExitCode {
    command_line(Catalog::from(&dimos_arms::registry().with(adapters)))
}

/// Runs the command line, on a stack of its own where that of the process may not grow (`ulimit -s 64`).
fn command_line(catalog: Catalog<'_>) -> ExitCode {
    if getrlimit(Resource::Stack).current.is_none_or(|most| most >= MIN_STACK) {
        return answer(catalog);
    }
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().name("dimos".into()).stack_size(OWN_STACK);
        match thread.spawn_scoped(scope, || answer(catalog)).map(std::thread::ScopedJoinHandle::join) {
            Ok(answered) => answered.unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
            Err(e) => {
                output::note(format_args!("error: no thread with a stack of its own: {e}"));
                ExitCode::from(exit::Exit::Failed as u8)
            }
        }
    })
}

fn answer(catalog: Catalog<'_>) -> ExitCode {
    // First of all: it changes the environment, and no thread may read that meanwhile.
    complete::answer(catalog);
    set_threads_of_the_network();
    let typed = typed::as_parsed(std::env::args_os());
    if typed.len() == 2 && typed.last().is_some_and(|word| word == "--licenses") {
        return licenses();
    }
    let json = typed.iter().take_while(|word| *word != "--").any(|word| word == "--json");
    let parsed = command().try_get_matches_from(&typed).map_err(|mut error| {
        if let Some(hint) = typed::pose_hint(&typed) {
            error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![hint.into()]));
        }
        error
    });
    let result = match parsed {
        Ok(arguments) => dispatch(&arguments, catalog),
        // `--help` and `--version`.
        Err(error) if !error.use_stderr() => {
            output::written(error.print());
            Ok(exit::Exit::Ok)
        }
        Err(error) if json => Err(usage_failure(&error)),
        // Usage errors end here, with 2.
        Err(error) => error.exit(),
    };
    let exit = result.unwrap_or_else(|failure| {
        match json {
            // Not on stdout, which may have data already: a motion that was aborted has its report there.
            true => output::note(escapes::in_json(&failure.to_json().to_string())),
            false => output::failure(&failure),
        }
        failure.exit
    });
    match output::finish() {
        Ok(()) => ExitCode::from(exit as u8),
        Err(failure) => {
            output::failure(&failure);
            let exit = if exit == exit::Exit::Ok { failure.exit } else { exit };
            ExitCode::from(exit as u8)
        }
    }
}

/// Prints the parts of this program and their licences.
fn licenses() -> ExitCode {
    output::line(format_args!("dimos {}: Apache-2.0\n{}", crate::VERSION, LICENCES.trim_end()));
    match output::finish() {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => ExitCode::from(failure.exit as u8),
    }
}

/// Sets how many threads the network has, unless the user has, or a program that embeds this one runs threads already.
fn set_threads_of_the_network() {
    let (name, value) = crate::share::THREADS;
    if !name.is_empty() && std::env::var_os(name).is_none() {
        dimos_rt::host::set_variable(name, value);
    }
}

fn dispatch(arguments: &ArgMatches, catalog: Catalog<'_>) -> exit::Result {
    match added(verbs(), arguments) {
        Some((verb, own)) => (verb.run)(own),
        None => built_in(&Cli::from_arg_matches(arguments).unwrap_or_else(|error| error.exit()), catalog),
    }
}

/// Returns a usage error of the parser as a failure: its message without the usage, its tip as the hint.
fn usage_failure(error: &clap::Error) -> exit::Failure {
    let text = error.render().to_string();
    let line = |prefix: &str| text.lines().find_map(|line| line.trim().strip_prefix(prefix)).map(str::to_owned);
    let what: Vec<&str> = text.lines().take_while(|line| !line.trim().is_empty()).map(str::trim).collect();
    let what = what.join(" ");
    exit::Failure::usage(what.trim_start_matches("error: ")).maybe_hint(line("tip: ").or_else(|| line("hint: ")))
}

fn built_in(cli: &Cli, catalog: Catalog<'_>) -> exit::Result {
    if cli.licenses {
        return Err(exit::Failure::usage("--licenses is given alone").hint("dimos --licenses"));
    }
    if cli.at.is_some() && !cli.command.talks_to_runs() {
        let failure = exit::Failure::usage("this verb works on this computer only");
        return Err(failure.hint("omit --at; through ssh it works there"));
    }
    arguments::set_place(cli.at.clone());
    let registry = catalog.adapters;
    match &cli.command {
        Command::Run(args) => run::run(args, catalog),
        Command::Demo(args) => demo::run(args, catalog),
        Command::New(args) => new::run(args, catalog),
        Command::Status(args) => status::run(args),
        Command::State(args) => state::run(args),
        Command::Top(args) => top::run(args),
        Command::Move(args) => motion::run(args),
        Command::Plan(args) => plan::run(args),
        Command::Preview(args) => preview::run(args),
        Command::Execute(args) => execute::run(args),
        Command::World(args) => world::run(args),
        Command::Do(args) => job::run(args, catalog),
        Command::BackOut(args) => back_out::run(args),
        Command::Cancel(args) => cancel::run(args),
        Command::Pose(args) => pose::run(args),
        Command::Speed(args) => speed::run(args),
        Command::Pause(args) => speed::pause(args, true),
        Command::Resume(args) => speed::pause(args, false),
        Command::Stop(args) => stop::run(args),
        Command::Arm(args) => arm::run(args, registry),
        Command::Jog(args) => jog::run(args),
        Command::Task(args) => task::run(args),
        Command::Proxy(args) => proxy::run(args),
        Command::View(args) => view::run(args, catalog),
        Command::Share(args) => share::run(args),
        Command::Down(args) => down::run(args),
        Command::Log(args) => log::run(args, catalog),
        Command::Logs(args) => logs::run(args),
        Command::Adapter(args) => adapter::run(args, registry),
        Command::ListAdapters(args) => list_adapters::run(args, registry),
        Command::ListBlueprints(args) => list_blueprints::run(args, catalog),
        Command::Check(args) => check::run(args, catalog),
        Command::Doctor(args) => doctor::run(args),
        Command::Completions(args) => completions::run(args),
        Command::Man(args) => man::run(args),
        Command::Model(args) => model::run(args, catalog),
        Command::Schema(args) => schema::run(args, catalog),
        Command::Replay(args) => replay::run(args, catalog),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A program with one verb, to read its arguments.
    #[derive(Debug, Parser)]
    struct Only<A: clap::Args> {
        #[command(flatten)]
        args: A,
    }

    fn read<A: clap::Args>(line: &str) -> Result<A, clap::Error> {
        Only::try_parse_from(["dimos"].into_iter().chain(line.split_whitespace())).map(|only| only.args)
    }

    #[test]
    fn the_command_line_is_sound() {
        Cli::command().debug_assert();
        Only::<run::Args>::command().debug_assert();
    }

    #[test]
    fn verbs_of_another_crate_are_found_and_hide_no_others() {
        let calibrate = clap::Command::new("calibrate").arg(clap::Arg::new("arm").required(true));
        let run = |arguments: &ArgMatches| -> exit::Result {
            let arm = arguments.get_one::<String>("arm").map_or("", String::as_str);
            Err(exit::Failure::usage(format!("no arm {arm}")))
        };
        let verbs = [Verb { command: calibrate, run }];
        with_verbs(&verbs).debug_assert();
        let parse = |line: &str| with_verbs(&verbs).try_get_matches_from(line.split_whitespace());
        let arguments = parse("so101 calibrate left").unwrap();
        let (verb, own) = added(&verbs, &arguments).unwrap();
        assert_eq!((verb.run)(own), Err(exit::Failure::usage("no arm left")));
        assert_eq!(parse("so101 calibrate").unwrap_err().exit_code(), 2);
        let arguments = parse("so101 stop left").unwrap();
        assert!(added(&verbs, &arguments).is_none() && Cli::from_arg_matches(&arguments).is_ok());
    }

    #[test]
    fn arguments_of_run_are_read() {
        let args: run::Args = read("a --set x.y=1 --set z= --duration 1m30s --record f.mcap --name n --sim").unwrap();
        assert_eq!(args.changes.set, [("x.y".into(), "1".into()), ("z".into(), String::new())]);
        assert_eq!(args.duration, Some(std::time::Duration::from_secs(90)));
        assert_eq!((args.blueprint.as_str(), args.name.as_deref(), args.changes.sim.is_some()), ("a", Some("n"), true));
        for wrong in [
            "",
            "a --set x",
            "a --set =1",
            "a --address arm",
            "a --address arm=",
            "a --address arm=10.0.0.1 --sim",
            "a --duration soon",
            "a --duration -1s",
            "a --duration 0s",
            "a --record f --no-record",
        ] {
            assert_eq!(read::<run::Args>(wrong).unwrap_err().exit_code(), 2, "{wrong:?}");
        }
    }
}
