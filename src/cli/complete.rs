//! Completion by the shell: at each Tab the script that `dimos completions` prints calls this program with the words
//! typed so far, and it answers with what exists now: blueprints, runs, arms, tasks, named poses, objects, adapters.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::sync::OnceLock;
use std::sync::mpsc::channel;
use std::time::Duration;

use clap::{Arg, Command};
use clap_complete::CompleteEnv;
use clap_complete::engine::{
    ArgValueCandidates, ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter,
};

use super::log;
use super::run_record::RunRecord;
use crate::blueprint::{self, Catalog, Overrides};
use dimos_robot::builtin;
use dimos_rpc::api::{Planner, Poses, State, Status, World};
use dimos_rpc::client::Client;
use dimos_rpc::report::StatusReport;
use dimos_rpc::run_dir::RunDir;

/// Environment variable by which the script asks for completions; its value is the shell.
pub const VARIABLE: &str = "DIMOS_COMPLETE";
/// Maximum wait for the runs: a Tab must not hang with one of them.
const TIMEOUT: Duration = Duration::from_millis(500);

/// Names of the adapters of this program.
static ADAPTERS: OnceLock<Vec<String>> = OnceLock::new();
/// The blueprint that was typed: its arms, and the keys of `--set`.
static TYPED: OnceLock<Typed> = OnceLock::new();

/// What a blueprint has, each followed by `=`.
#[derive(Default)]
struct Typed {
    arms: BTreeSet<String>,
    keys: BTreeSet<String>,
}

/// Answers the shell and exits if it asks for completions. Call it before any thread is started: it removes
/// [`VARIABLE`] from the environment.
pub fn answer(catalog: Catalog<'_>) {
    let _ = ADAPTERS.set(catalog.adapters.names().into_iter().map(|name| name.to_string()).collect());
    if std::env::var_os(VARIABLE).is_some() {
        let words = std::env::args().skip_while(|word| word != "--").skip(1);
        let _ = TYPED.set(Typed::of(words, catalog));
    }
    CompleteEnv::with_factory(|| with_candidates("", super::command())).var(VARIABLE).complete();
}

/// Returns a verb of `parent` with the candidates of each argument's values.
fn with_candidates(parent: &str, command: Command) -> Command {
    let verb = command.get_name().to_owned();
    command.mut_args(|arg| candidates(parent, &verb, arg)).mut_subcommands(|below| with_candidates(&verb, below))
}

fn candidates(parent: &str, verb: &str, arg: Arg) -> Arg {
    let of = |all: fn() -> BTreeSet<String>| {
        ArgValueCandidates::new(move || all().into_iter().map(CompletionCandidate::new).collect())
    };
    let value = arg.get_value_names().and_then(|names| names.first()).map(|name| name.as_str().to_owned());
    match (arg.get_id().as_str(), verb) {
        ("blueprint", _) => arg.add(ArgValueCompleter::new(blueprints as fn(&OsStr) -> Vec<CompletionCandidate>)),
        ("arm", "new") => arg.add(of(adapters)),
        ("model", "new") => arg.add(ArgValueCompleter::new(models as fn(&OsStr) -> Vec<CompletionCandidate>)),
        ("arm" | "arms" | "robot", _) => arg.add(of(arms)),
        ("task", _) => arg.add(of(tasks)),
        ("named", _) => arg.add(of(named_poses)),
        ("through", _) => arg.add(of(waypoints)),
        ("several", _) => arg.add(of(goals)),
        ("act", _) => arg.add(of(|| ["open", "close", "home"].map(str::to_owned).into())),
        ("joint", _) => arg.add(of(joints)),
        ("address", "run" | "check") => {
            arg.add(of(|| TYPED.get().map_or_else(BTreeSet::new, |typed| typed.arms.clone())))
        }
        ("set", "run" | "check") => arg.add(of(|| TYPED.get().map_or_else(BTreeSet::new, |typed| typed.keys.clone()))),
        ("file", _) if parent == "model" => {
            arg.add(ArgValueCompleter::new(models as fn(&OsStr) -> Vec<CompletionCandidate>))
        }
        ("log", _) if arg.get_action().takes_values() => {
            arg.add(ArgValueCompleter::new(logs as fn(&OsStr) -> Vec<CompletionCandidate>))
        }
        ("frame", _) => arg.add(of(frames)),
        ("run" | "attach", _) if arg.get_action().takes_values() => arg.add(of(runs)),
        ("name", "down" | "status") => arg.add(of(runs_and_planners)),
        ("name", "logs") => arg.add(of(recorded_runs)),
        ("name", _) if parent == "pose" => arg.add(of(saved_poses)),
        ("name", "move" | "remove" | "attach" | "detach") => arg.add(of(objects)),
        ("name", "test" | "emulate") => arg.add(of(adapters)),
        _ if value.as_deref() == Some("ADAPTER") => arg.add(of(adapters)),
        _ => arg,
    }
}

fn adapters() -> BTreeSet<String> {
    ADAPTERS.get().into_iter().flatten().cloned().collect()
}

/// Returns the blueprints that are run by name, and YAML files.
fn blueprints(typed: &OsStr) -> Vec<CompletionCandidate> {
    let typed_text = typed.to_string_lossy();
    let names = blueprint::names().into_iter().filter(|name| name.starts_with(&*typed_text));
    let is_yaml = |path: &std::path::Path| path.extension().is_some_and(|e| e == "yaml" || e == "yml");
    let files = PathCompleter::any().filter(is_yaml).complete(typed);
    names.map(CompletionCandidate::new).chain(files).collect()
}

/// Returns the built-in robots, and files.
fn models(typed: &OsStr) -> Vec<CompletionCandidate> {
    let text = typed.to_string_lossy();
    let names = builtin::names().map(|name| format!("builtin:{name}")).filter(|name| name.starts_with(&*text));
    names.map(CompletionCandidate::new).chain(PathCompleter::any().complete(typed)).collect()
}

/// Returns the logs where runs keep them, and log files here.
fn logs(typed: &OsStr) -> Vec<CompletionCandidate> {
    let text = typed.to_string_lossy();
    let is_log = |path: &std::path::Path| path.extension().is_some_and(|e| e == "mcap");
    let kept = log::kept().into_iter().filter(|name| name.starts_with(&*text));
    kept.map(CompletionCandidate::new).chain(PathCompleter::any().filter(is_log).complete(typed)).collect()
}

impl Typed {
    /// Reads the blueprint that a command line names.
    fn of(words: impl Iterator<Item = String>, catalog: Catalog<'_>) -> Self {
        let mut words = words.skip_while(|word| word != "run" && word != "check").skip(1);
        let name = words.find(|word| !word.starts_with('-')).filter(|name| !name.is_empty());
        let found = name.and_then(|name| blueprint::find(&name).ok());
        let loaded = found.map(|found| blueprint::load(&found, &Overrides::default(), catalog));
        let Some(blueprint) = loaded.and_then(|loaded| loaded.blueprint) else { return Self::default() };
        let of_arm = ["address", "adapter_type", "auto_enable", "on_exit", "options", "limits"];
        let arms = blueprint.arms.iter().map(|arm| &arm.hardware_id);
        let keys = arms.clone().flat_map(|arm| of_arm.map(|key| format!("hardware.{arm}.{key}=")));
        let tasks = blueprint
            .tasks
            .iter()
            .flat_map(|task| ["priority", "params"].map(|key| format!("tasks.{}.{key}=", task.name)));
        let keys = keys.chain(tasks).chain(["coordinator.tick_rate=", "planner.planning_timeout="].map(str::to_owned));
        Self { arms: arms.map(|arm| format!("{arm}=")).collect(), keys: keys.collect() }
    }
}

fn runs() -> BTreeSet<String> {
    RunDir::standard().runs().unwrap_or_default().into_iter().map(|run| run.name).collect()
}

fn runs_and_planners() -> BTreeSet<String> {
    let planners = super::attach::live().into_iter().map(|planner| planner.name);
    runs().into_iter().chain(planners).collect()
}

fn recorded_runs() -> BTreeSet<String> {
    RunRecord::all().into_iter().map(|record| record.run).chain(runs()).collect()
}

fn arms() -> BTreeSet<String> {
    statuses().into_iter().flat_map(|status| status.arms).map(|arm| arm.hardware_id).collect()
}

fn tasks() -> BTreeSet<String> {
    statuses().into_iter().flat_map(|status| status.tasks).map(|task| task.name).collect()
}

fn statuses() -> Vec<StatusReport> {
    of_each_run(|client| client.call(Status {}).ok())
}

fn saved_poses() -> BTreeSet<String> {
    of_each_run(|client| client.call(Poses {}).ok()).into_iter().flat_map(|reply| reply.poses.into_keys()).collect()
}

/// Returns the poses of the blueprints, and the saved ones, which a run without a planner has, too.
fn named_poses() -> BTreeSet<String> {
    let replies = of_each_run(|client| client.call(Planner {}).ok());
    let robots = replies.into_iter().flat_map(|reply| reply.robots);
    robots.flat_map(|robot| robot.named_poses.into_keys()).chain(saved_poses()).collect()
}

fn waypoints() -> BTreeSet<String> {
    named_poses().into_iter().chain(["gripper:open", "gripper:close"].map(str::to_owned)).collect()
}

/// Returns `--goal` of each arm: `ARM=`, and `ARM=named:POSE`.
fn goals() -> BTreeSet<String> {
    let (arms, poses) = (arms(), named_poses());
    let named = |arm: &String| poses.iter().map(|pose| format!("{arm}=named:{pose}")).collect::<Vec<_>>();
    arms.iter().flat_map(|arm| named(arm).into_iter().chain([format!("{arm}=")])).collect()
}

fn joints() -> BTreeSet<String> {
    let arms = of_each_run(|client| client.call(State {}).ok()).into_iter().flat_map(|state| state.arms);
    arms.flat_map(|arm| arm.joints).map(|joint| joint.name).collect()
}

fn frames() -> BTreeSet<String> {
    objects().into_iter().chain(["map", "base", "tool"].map(str::to_owned)).collect()
}

fn objects() -> BTreeSet<String> {
    let replies = of_each_run(|client| client.call(World {}).ok());
    replies.into_iter().flat_map(|reply| reply.objects).map(|object| object.name).collect()
}

/// Asks each live run; those that have not answered within [`TIMEOUT`] are left out.
fn of_each_run<T: Send + 'static>(ask: fn(&mut Client) -> Option<T>) -> Vec<T> {
    let (sender, replies) = channel();
    let live = RunDir::standard().runs().unwrap_or_default();
    for run in live {
        let sender = sender.clone();
        std::thread::spawn(move || {
            if let Some(reply) = Client::connect(&run.name, &run.socket).ok().as_mut().and_then(ask) {
                let _ = sender.send(reply);
            }
        });
    }
    drop(sender);
    let until = std::time::Instant::now() + TIMEOUT;
    let next = || replies.recv_timeout(until.saturating_duration_since(std::time::Instant::now())).ok();
    std::iter::from_fn(next).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the engine offers for the last of these words.
    fn offered(words: &[&str]) -> Vec<String> {
        let mut command = with_candidates("", crate::cli::command());
        let arguments = words.iter().map(|word| (*word).into()).collect();
        let found = clap_complete::engine::complete(&mut command, arguments, words.len() - 1, None).unwrap();
        found.iter().map(|candidate| candidate.get_value().to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn blueprints_and_adapters_are_offered() {
        assert!(offered(&["dimos", "run", "coordinator-x"]).contains(&"coordinator-xarm6".to_owned()));
        let _ = ADAPTERS.set(vec!["xarm".into(), "yourarm".into()]);
        assert_eq!(offered(&["dimos", "adapter", "test", "you"]), ["yourarm"]);
        assert_eq!(offered(&["dimos", "arm", "calibrate", "xa"]), ["xarm"]);
        assert_eq!(offered(&["dimos", "list-ad"]), ["list-adapters"]);
        assert!(offered(&["dimos", "model", "info", "builtin:your"]).contains(&"builtin:yourarm".to_owned()));
        assert_eq!(offered(&["dimos", "arm", "gripper", "arm", "cl"]), ["close"]);
        assert!(offered(&["dimos", "run", "x", "--addr"]).contains(&"--address".to_owned()));
    }
}
