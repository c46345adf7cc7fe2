//! `dimos model …`: inspect robot descriptions. Needs no run.

mod assets;
pub(super) mod chain;
mod check;
mod collide;
mod dynamics;
mod fk;
mod ik;
mod info;

use std::path::{Path, PathBuf};

use super::exit::{Exit, Failure, Result};
use super::output;
use crate::blueprint::Catalog;
use dimos_robot::urdf::Meshes;
use dimos_robot::{Loaded, RobotModel, Source, load};

/// Arguments of `model`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    /// Show joints, limits, links, shapes and groups
    Info(File),
    /// Draw the tree of links and joints
    Tree(File),
    /// Report every mistake of a description and of its files
    Check(File),
    /// Expand an xacro file to URDF
    Expand(File),
    /// Forward kinematics: pose of a link at joint positions
    Fk(fk::Args),
    /// Inverse kinematics: joint positions for a pose of a link
    Ik(ik::Args),
    /// Efforts of a motion, of gravity, and the mass matrix at joint positions
    Dynamics(dynamics::Args),
    /// Distances of links at joint positions: what touches, what is close
    Collide(collide::Args),
    /// Assets of a blueprint: list, fetch, clean
    Assets(assets::Args),
}

/// A description and its parameters.
#[derive(Debug, clap::Args)]
struct File {
    /// URDF or xacro file, or a built-in robot: builtin:xarm6
    #[arg(value_name = "FILE")]
    file: PathBuf,
    #[command(flatten)]
    with: With,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// What a description is read with.
#[derive(Debug, Default, PartialEq, clap::Args)]
pub(super) struct With {
    /// Folder of a package (repeatable); ROS_PACKAGE_PATH and AMENT_PREFIX_PATH are searched too
    #[arg(long, value_name = "NAME=DIR", value_parser = pair::<'='>)]
    package: Vec<(String, String)>,
    /// Value of an xacro argument (repeatable)
    #[arg(long, value_name = "NAME:=VALUE", value_parser = xacro_arg)]
    xacro_arg: Vec<(String, String)>,
    /// SRDF of the robot: groups, named poses, allowed collision pairs
    #[arg(long, value_name = "FILE")]
    srdf: Option<PathBuf>,
    /// joint_limits.yaml of the robot: accelerations and jerks
    #[arg(long, value_name = "FILE")]
    joint_limits: Option<PathBuf>,
}

/// `NAME=VALUE`
fn pair<const SIGN: char>(text: &str) -> std::result::Result<(String, String), String> {
    match text.split_once(SIGN) {
        Some((name, value)) if !name.is_empty() => Ok((name.to_owned(), value.to_owned())),
        _ => Err(format!("must be NAME{SIGN}VALUE")),
    }
}

/// Parses `NAME:=VALUE`, as in ROS; `NAME=VALUE` works as well.
fn xacro_arg(text: &str) -> std::result::Result<(String, String), String> {
    let (name, value) = pair::<'='>(text).map_err(|_| "must be NAME:=VALUE".to_owned())?;
    Ok((name.strip_suffix(':').unwrap_or(&name).to_owned(), value))
}

impl With {
    /// Returns the description in this file.
    pub fn source(&self, file: &Path, meshes: Meshes) -> Source {
        Source {
            path: file.to_owned(),
            packages: self.package.iter().map(|(name, folder)| (name.clone(), folder.into())).collect(),
            xacro_args: self.xacro_arg.iter().cloned().collect(),
            srdf: self.srdf.clone(),
            joint_limits: self.joint_limits.clone(),
            meshes,
            ..Source::default()
        }
    }
}

impl File {
    fn load(&self, meshes: Meshes) -> Loaded {
        load(&self.with.source(&self.file, meshes))
    }

    /// Returns the robot; prints its mistakes and warnings to stderr.
    fn robot(&self, meshes: Meshes) -> Result<(RobotModel, Loaded)> {
        robot(self.load(meshes), &self.file)
    }

    fn refuse(&self, loaded: &Loaded) -> Failure {
        refuse(loaded, &self.file)
    }
}

/// Returns the robot of a description; prints its mistakes and warnings to stderr.
pub(super) fn robot(mut loaded: Loaded, file: &Path) -> Result<(RobotModel, Loaded)> {
    let Some(model) = loaded.model.take() else { return Err(refuse(&loaded, file)) };
    let text = loaded.render(output::colour(&std::io::stderr()));
    if !text.is_empty() {
        output::note(text.trim_end());
    }
    Ok((model, loaded))
}

/// Returns the failure of a description with mistakes, after printing them; of a file that cannot be read, the reason.
fn refuse(loaded: &Loaded, file: &Path) -> Failure {
    if let Some(diag) = loaded.unreadable() {
        return Failure { hint: diag.hint.clone(), ..Failure::usage(diag.message.clone()) };
    }
    output::note(loaded.render(output::colour(&std::io::stderr())).trim_end());
    has_mistakes(file)
}

/// Returns the failure of a description with mistakes.
fn has_mistakes(file: &Path) -> Failure {
    Failure::usage(format!("{} has mistakes", file.display()))
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    match &args.verb {
        Verb::Info(file) => info::info(file),
        Verb::Tree(file) => info::tree(file),
        Verb::Check(file) => check::run(file),
        Verb::Expand(file) => expand(file),
        Verb::Fk(args) => fk::run(args),
        Verb::Dynamics(args) => dynamics::run(args),
        Verb::Ik(args) => ik::run(args),
        Verb::Collide(args) => collide::run(args),
        Verb::Assets(args) => assets::run(args, catalog),
    }
}

/// Prints the URDF even of a robot with mistakes: it helps to find them.
fn expand(file: &File) -> Result {
    let loaded = file.load(Meshes::Ignore);
    let Some(urdf) = loaded.urdf() else { return Err(file.refuse(&loaded)) };
    let text = loaded.render(output::colour(&std::io::stderr()));
    if !text.is_empty() {
        output::note(text.trim_end());
    }
    if file.json {
        output::json(&serde_json::json!({"urdf": urdf, "files": loaded.files}));
    } else {
        output::line(urdf.trim_end());
    }
    Ok(Exit::Ok)
}
