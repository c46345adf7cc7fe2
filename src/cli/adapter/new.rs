//! `dimos adapter new NAME`: the start of an adapter for a new arm.

mod description;
mod name;
mod templates;
mod write;

use std::fs;
use std::path::{Path, PathBuf};

use serde_json::json;

use super::super::exit::{Exit, Failure, Result};
use super::super::output;
use dimos_core::joint::MAX_DOF;
use dimos_hardware::registry::Registry;
use name::Name;
use templates::{Arm, Source};
use write::Plan;

/// Paths of the table of adapters and of that of robot descriptions in a checkout.
const TABLE: &str = "crates/arms/src/lib.rs";
const ROBOTS: &str = "crates/robot/src/builtin.rs";
/// The checkout that this program was built from, wherever it is now.
const BUILT_FROM: &str = env!("CARGO_MANIFEST_DIR");
/// Where dimos is published, if it is.
const REPOSITORY: &str = env!("CARGO_PKG_REPOSITORY");

/// Arguments of `adapter new`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Writes a crate of its own, DIR/NAME: an adapter, an emulator, tests, a robot description and two \
blueprints; and in its folder `program` a second one, the program `dimos` with that arm. They \
compile, pass the conformance suite, run and plan at once, with a made-up wire format and a \
made-up shape: search for `YOUR ARM`. Nothing is ever written over.

  dimos adapter new acme --dof 6 --transport tcp
  cd acme && cargo test && cargo run -p acme-program -- run coordinator-acme

With --in-tree the same goes into a checkout of dimos: crates/arms/src/NAME, crates/robot/robots and \
blueprints. It prints the lines that you add to the tables of arms and of robots.

docs/adding-an-arm.md goes through it step by step.")]
pub struct Args {
    /// The arm's name, which becomes its `adapter_type`: acme, acme-arm
    pub name: String,
    /// Number of joints (1 to 16)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=MAX_DOF as i64))]
    pub dof: u8,
    /// How the arm is reached
    #[arg(long)]
    pub transport: Transport,
    /// The folder to write the crate's folder into; with --in-tree, the checkout of dimos
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub path: PathBuf,
    /// Write into a checkout of dimos instead of a crate of its own
    #[arg(long)]
    pub in_tree: bool,
    /// The checkout of dimos that the crate is to use, if not the one this program was built from
    #[arg(long, value_name = "DIR", conflicts_with = "in_tree")]
    pub dimos: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// How an arm is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Transport {
    /// A TCP connection; the arm is asked and answers
    Tcp,
    /// A CAN bus; the arm streams its state
    Can,
    /// A serial line of servos, with a gripper; they are asked and answer
    Serial,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    let name = Name::parse(&args.name).map_err(Failure::usage)?;
    if name.is_taken(registry) {
        let what = format!("there is an adapter {} already", name.snake);
        return Err(Failure::usage(what).hint("`dimos list-adapters` shows them; choose another name"));
    }
    let arm = Arm { name, dof: args.dof, transport: args.transport };
    let (plan, lines, next) = if args.in_tree { in_tree(args, &arm)? } else { own_crate(args, &arm)? };
    if let Some(path) = plan.obstacle() {
        let what = format!("{} is there already: nothing was written", path.display());
        return Err(Failure::usage(what).hint("choose another name or --path, or move it away"));
    }
    plan.write().map_err(|e| Failure::new(Exit::Failed, format!("{e}: nothing was written")))?;
    report(args, &arm, &plan, &lines, &next);
    Ok(Exit::Ok)
}

/// The next commands, and the purpose of each.
type Next = Vec<(String, &'static str)>;

/// A line to add to a source file by hand.
#[derive(Debug, serde::Serialize)]
struct Line {
    file: PathBuf,
    /// The list in the file that takes the line; empty: the file's own level.
    list: &'static str,
    line: String,
}

fn own_crate(args: &Args, arm: &Arm) -> Result<(Plan, Vec<Line>, Next)> {
    if !args.path.is_dir() {
        return Err(Failure::usage(format!("--path: there is no folder {}", args.path.display())));
    }
    let folder = args.path.join(&arm.name.kebab);
    let files = arm.own_crate(&dimos(args.dimos.as_deref())?);
    let new = files.into_iter().map(|(path, text)| (folder.join(path), text)).collect();
    let run = format!("cargo run -p {}-program -- run", arm.name.kebab);
    let next = vec![
        (format!("cd {} && cargo test", shown(&folder)), "its bytes, and the conformance suite"),
        (format!("{run} {}", arm.blueprint()), "with its emulator"),
        (format!("{run} {}", arm.planner()), "the same with a planner, for `plan arm --named home`"),
        ("grep -rn 'YOUR ARM' src robots".to_owned(), "what to change; the URDF has no gripper"),
        ("git init && git add -A".to_owned(), "with the Cargo.lock of the first build: the same versions everywhere"),
    ];
    Ok((Plan { new, folders: vec![folder] }, Vec::new(), next))
}

fn in_tree(args: &Args, arm: &Arm) -> Result<(Plan, Vec<Line>, Next)> {
    let root = &args.path;
    if !is_checkout(root) {
        let what = format!("--in-tree: {} is no checkout of dimos", root.display());
        return Err(Failure::usage(what).hint("give the one to write into: --path DIR"));
    }
    let name = &arm.name.snake;
    let lines = vec![
        Line { file: root.join(TABLE), list: "", line: format!("pub mod {name};") },
        Line { file: root.join(TABLE), list: "TABLE", line: format!("{name}::SPEC,") },
        Line { file: root.join(ROBOTS), list: "robots!", line: format!("{name:?},") },
    ];
    let new = arm.in_tree().into_iter().map(|(path, text)| (root.join(path), text)).collect();
    let folder = root.join("crates/arms/src").join(name);
    let next = vec![
        (
            "DIMOS_REGENERATE=1 cargo test --test logic blueprint_reference".to_owned(),
            "brings the generated pages up to date",
        ),
        ("cargo test --test logic conformance::".to_owned(), "every arm of the table, this one too"),
        (format!("cargo run -- run {}", arm.blueprint()), "with its emulator"),
        (
            format!("cargo run -- run {}", arm.planner()),
            "the same with a planner: `cargo run -- plan arm --named home`",
        ),
        (
            format!("grep -rn 'YOUR ARM' crates/arms/src/{name} crates/robot/robots/{name}.urdf"),
            "what to change; the URDF has no gripper",
        ),
    ];
    Ok((Plan { new, folders: vec![folder] }, lines, next))
}

/// Where a crate finds dimos.
fn dimos(given: Option<&Path>) -> Result<Source> {
    let path = match given {
        Some(path) if is_checkout(path) => path,
        Some(path) => return Err(Failure::usage(format!("--dimos: {} is no checkout of dimos", path.display()))),
        // What `cargo install --git` builds from is cargo's own, and may be gone tomorrow.
        None if is_checkout(Path::new(BUILT_FROM)) && !BUILT_FROM.contains("/git/checkouts/") => Path::new(BUILT_FROM),
        None if !REPOSITORY.is_empty() => return Ok(Source::Repository(REPOSITORY.to_owned())),
        None => {
            let what = "the crate needs the source of dimos, and the one this program was built from is gone";
            return Err(Failure::usage(what).hint("give a checkout of it: --dimos DIR"));
        }
    };
    let full = fs::canonicalize(path).ok().and_then(|path| path.to_str().map(str::to_owned));
    match full {
        Some(full) => Ok(Source::Checkout(full)),
        None => Err(Failure::usage(format!("--dimos: the path {} cannot be written down", path.display()))),
    }
}

fn is_checkout(folder: &Path) -> bool {
    let manifest = fs::read_to_string(folder.join("Cargo.toml")).unwrap_or_default();
    manifest.lines().any(|line| line.trim() == "name = \"dimos\"") && folder.join(TABLE).is_file()
}

/// A path as a shell takes it.
fn shown(path: &Path) -> String {
    let text = path.strip_prefix(".").unwrap_or(path).display().to_string();
    let plain = |c: char| c.is_ascii_alphanumeric() || "/._-+".contains(c);
    if text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

fn report(args: &Args, arm: &Arm, plan: &Plan, lines: &[Line], next: &Next) {
    let name = |path: &Path| path.strip_prefix(".").unwrap_or(path).display().to_string();
    let written: Vec<String> = plan.new.iter().map(|(path, _)| name(path)).collect();
    if args.json {
        output::json(&json!({
            "adapter": arm.name.snake,
            "blueprint": arm.blueprint(),
            "planner": arm.planner(),
            "written": written,
            "add": lines,
            "next": next.iter().map(|(command, _)| command).collect::<Vec<_>>(),
        }));
        return;
    }
    written.iter().for_each(|path| output::line(format_args!("wrote   {path}")));
    for Line { file, list, line } in lines {
        let list = if list.is_empty() { String::new() } else { format!(", in {list}") };
        output::line(format_args!("add to  {}{list}: {line}", name(file)));
    }
    output::line("");
    output::line("next:");
    let width = next.iter().map(|(command, _)| command.len()).max().unwrap_or_default();
    next.iter().for_each(|(command, why)| output::line(format_args!("  {command:width$}  # {why}")));
}
