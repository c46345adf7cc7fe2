//! `dimos world`: the planner's obstacles, and the objects that arms hold.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::arguments::{Target, angle, finite, length};
use super::arm::parts::payload_text;
use super::exit::{Exit, Failure, Result};
use super::output::{self, Table, done, fixed};
use dimos_core::{bounded, pose};
use dimos_robot::mesh::Size;
use dimos_rpc::api::{
    Attach, Detach, GRASP_REACH, PoseSpec, ShapeSpec, World, WorldAdd, WorldEntry, WorldMove, WorldObject, WorldRemove,
};
use dimos_rpc::client::Client;

/// Arguments of `world`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// What to do
    #[command(subcommand)]
    pub command: Command,
}

/// Verbs of `world`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// List the objects
    List(ListArgs),
    /// Add an obstacle
    Add(AddArgs),
    /// Move an obstacle
    Move(MoveArgs),
    /// Remove an obstacle, or all
    Remove(RemoveArgs),
    /// Add the objects of a YAML file: a map of names as under `planner.world`
    Load(LoadArgs),
    /// Attach an object to an arm at its current pose
    Attach(AttachArgs),
    /// Detach an object; it stays at its current pose
    Detach(DetachArgs),
}

/// Arguments of `world list`.
#[derive(Debug, clap::Args)]
pub struct ListArgs {
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// A pose on the command line.
#[derive(Debug, Clone, clap::Args)]
pub struct PoseArgs {
    /// Position in the frame `map`: x, y, z [m]
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true, required = true)]
    pub at: Vec<f64>,
    /// Roll, pitch, yaw about fixed axes [rad]
    #[arg(long, value_names = ["R", "P", "Y"], num_args = 3, value_parser = angle, allow_negative_numbers = true)]
    pub rpy: Option<Vec<f64>>,
}

impl PoseArgs {
    fn pose(&self) -> PoseSpec {
        let rpy = self.rpy.as_deref().and_then(|rpy| rpy.try_into().ok());
        PoseSpec { xyz: self.at.as_slice().try_into().unwrap_or_default(), rpy, quat: None }
    }
}

/// Arguments of `world add`.
#[derive(Debug, clap::Args)]
#[command(override_usage = "\
dimos world add NAME --at X Y Z [--rpy R P Y] SHAPE [OPTIONS]
       SHAPE: --box X Y Z | --sphere RADIUS | --cylinder RADIUS LENGTH
            | --mesh FILE | --cloud FILE")]
#[command(group = clap::ArgGroup::new("shape").required(true).args(["cuboid", "sphere", "cylinder", "mesh", "cloud"]))]
pub struct AddArgs {
    /// Name of the object; replaces an object of the same name
    pub name: String,
    /// A box: edge lengths [m]
    #[arg(long = "box", value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true)]
    pub cuboid: Option<Vec<f64>>,
    /// A sphere: radius [m]
    #[arg(long, value_name = "RADIUS", value_parser = length, allow_negative_numbers = true)]
    pub sphere: Option<f64>,
    /// A cylinder along z: radius and length [m]
    #[arg(long, value_names = ["RADIUS", "LENGTH"], num_args = 2, value_parser = length, allow_negative_numbers = true)]
    pub cylinder: Option<Vec<f64>>,
    /// A mesh file: STL, OBJ or DAE
    #[arg(long, value_name = "FILE")]
    pub mesh: Option<PathBuf>,
    /// A point cloud file: PLY
    #[arg(long, value_name = "FILE")]
    pub cloud: Option<PathBuf>,
    /// Pose
    #[command(flatten)]
    pub at: PoseArgs,
    /// Padding on all sides [m]
    #[arg(long, value_name = "METRES", value_parser = length, allow_negative_numbers = true, default_value_t = 0.0)]
    pub padding: f64,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `world move`.
#[derive(Debug, clap::Args)]
pub struct MoveArgs {
    /// Name of the object
    pub name: String,
    /// New pose
    #[command(flatten)]
    pub at: PoseArgs,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `world remove`.
#[derive(Debug, clap::Args)]
pub struct RemoveArgs {
    /// Name of the object
    #[arg(required_unless_present = "all")]
    pub name: Option<String>,
    /// Remove all objects
    #[arg(long, conflicts_with = "name")]
    pub all: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `world load`.
#[derive(Debug, clap::Args)]
pub struct LoadArgs {
    /// The file
    pub file: PathBuf,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `world attach`.
#[derive(Debug, clap::Args)]
pub struct AttachArgs {
    /// Name of the object
    pub name: String,
    /// Arm that holds it, by its name in the planner
    #[arg(value_name = "ARM")]
    pub robot: String,
    /// Link that holds it; default: the end-effector link
    #[arg(long)]
    pub link: Option<String>,
    /// Further links that may touch it
    #[arg(long, value_name = "LINK")]
    pub touch: Vec<String>,
    /// Largest distance of its surface from the tool centre point [m]; default: 0.2, any with --link
    #[arg(long, value_name = "METRES", value_parser = length, allow_negative_numbers = true)]
    pub within: Option<f64>,
    /// Its mass [kg]: the arm's controller is set to carry it, and reads it back
    #[arg(long, value_name = "KG", value_parser = finite, allow_negative_numbers = true)]
    pub mass: Option<f64>,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `world detach`.
#[derive(Debug, clap::Args)]
pub struct DetachArgs {
    /// Name of the object
    pub name: String,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    match &args.command {
        Command::List(a) => list(&mut a.target_run.connect()?, a.target_run.json)?,
        Command::Add(a) => {
            let object = WorldObject {
                name: a.name.clone(),
                shape: shape(a)?,
                pose: a.at.pose(),
                padding: a.padding,
                held_by: None,
            };
            let mut client = a.target_run.connect()?;
            let replaced = replaced(&mut client, &[&a.name])?;
            client.call(WorldAdd(object.clone()))?;
            note_doubts([&object]);
            let how = if replaced.is_empty() { "added" } else { "replaced" };
            done(format_args!("{} {how}", a.name), json!({how: [a.name]}), a.target_run.json);
        }
        Command::Move(a) => {
            a.target_run.connect()?.call(WorldMove { name: a.name.clone(), pose: a.at.pose() })?;
            done(format_args!("{} moved", a.name), json!({"moved": a.name}), a.target_run.json);
        }
        Command::Remove(a) => {
            a.target_run.connect()?.call(WorldRemove { name: a.name.clone() })?;
            let what = a.name.as_deref().unwrap_or("all objects that no arm holds");
            done(format_args!("{what} removed"), json!({"removed": a.name, "all": a.all}), a.target_run.json);
        }
        Command::Load(a) => {
            // Reads the whole file first: a mistake in its last object changes nothing.
            let objects = load(&a.file)?;
            let mut client = a.target_run.connect()?;
            let names: Vec<&str> = objects.iter().map(|object| object.name.as_str()).collect();
            let replaced = replaced(&mut client, &names)?;
            for object in &objects {
                client.call(WorldAdd(object.clone()))?;
            }
            note_doubts(&objects);
            let added: Vec<&str> = names.iter().filter(|name| !replaced.iter().any(|r| r == *name)).copied().collect();
            let objects = if added.len() == 1 { "object" } else { "objects" };
            let text = format!("{} {objects} added, {} replaced", added.len(), replaced.len());
            done(text, json!({"added": added, "replaced": replaced}), a.target_run.json);
        }
        Command::Attach(a) => {
            let (name, robot) = (a.name.clone(), a.robot.clone());
            let (link, touch_links) = (a.link.clone(), a.touch.clone());
            // What is farther away is not at the fingers.
            let within = a.within.or(a.link.is_none().then_some(GRASP_REACH));
            let attach = Attach { name, robot, link, touch_links, mass: a.mass, within };
            let reply = a.target_run.connect()?.call(attach)?;
            if a.target_run.json {
                output::json(&reply);
            } else {
                output::line(format_args!("{} is held by {}", a.name, a.robot));
                match &reply.payload {
                    Some(load) => output::line(format_args!("payload {}", payload_text(load))),
                    None if a.mass.is_some() => output::note("the arm's controller takes no payload: it was not set"),
                    None => {}
                }
            }
        }
        Command::Detach(a) => {
            a.target_run.connect()?.call(Detach { name: a.name.clone() })?;
            done(format_args!("{} detached", a.name), json!({"detached": a.name}), a.target_run.json);
        }
    }
    Ok(Exit::Ok)
}

/// Warns of meshes with a doubtful unit.
fn note_doubts<'a>(objects: impl IntoIterator<Item = &'a WorldObject>) {
    for object in objects {
        if let Some(doubt) = object.doubt() {
            output::note(format_args!("warning: {doubt}"));
        }
        let ShapeSpec::Mesh(path) = &object.shape else { continue };
        let size = Size::read(Path::new(path)).ok();
        if let Some(doubt) = size.and_then(|size| size.doubt_of_object(&object.name, Path::new(path))) {
            let hint = doubt.hint.map(|hint| format!("\nhint: {hint}")).unwrap_or_default();
            output::note(format_args!("warning: {}{hint}", doubt.message));
        }
    }
}

/// Returns those of these names that objects in the world have.
fn replaced(client: &mut Client, names: &[&str]) -> Result<Vec<String>> {
    let there = client.call(World {})?.objects.into_iter().map(|object| object.name);
    Ok(there.filter(|name| names.contains(&name.as_str())).collect())
}

fn shape(args: &AddArgs) -> Result<ShapeSpec> {
    Ok(match args {
        AddArgs { cuboid: Some(size), .. } => ShapeSpec::Box(size.as_slice().try_into().unwrap_or_default()),
        AddArgs { sphere: Some(radius), .. } => ShapeSpec::Sphere(*radius),
        AddArgs { cylinder: Some(size), .. } => ShapeSpec::Cylinder(size.as_slice().try_into().unwrap_or_default()),
        AddArgs { mesh: Some(file), .. } => ShapeSpec::Mesh(full_path(file)?),
        AddArgs { cloud: Some(file), .. } => ShapeSpec::Cloud(full_path(file)?),
        _ => return Err(Failure::usage("the object has no shape")),
    })
}

/// Returns an absolute path: the run may have another working directory.
fn full_path(file: &Path) -> Result<String> {
    let path = file.canonicalize().map_err(|e| Failure::usage(format!("{}: {e}", file.display())))?;
    Ok(path.display().to_string())
}

/// Returns the objects of a file. Paths in it are relative to its folder.
fn load(file: &Path) -> Result<Vec<WorldObject>> {
    let wrong = |what: String| Failure::usage(format!("{}: {what}", file.display()));
    let text = bounded::read_text(file, bounded::SMALL).map_err(|e| wrong(e.to_string()))?;
    let folder = file.parent().unwrap_or(Path::new(""));
    // Converted to JSON: a shape is written as in a blueprint, `shape: {box: […]}`.
    let typed: BTreeMap<String, Value> = serde_yaml::from_str(&text).map_err(|e| match e.location() {
        Some(at) => Failure::usage(format!("{}:{}:{}: {e}", file.display(), at.line(), at.column())),
        None => wrong(e.to_string()),
    })?;
    let line_of = |name: &str| {
        let starts = format!("{name}:");
        text.lines().position(|line| line.trim_start().starts_with(&starts)).unwrap_or(0) + 1
    };
    let (mut objects, mut mistakes) = (BTreeMap::new(), Vec::new());
    for (name, value) in typed {
        match entry(&name, value, folder) {
            Ok(entry) => drop(objects.insert(name, entry)),
            Err(why) => mistakes.push((line_of(&name), format!("{name}: {why}"))),
        }
    }
    if !mistakes.is_empty() {
        mistakes.sort();
        let each: Vec<String> =
            mistakes.iter().map(|(line, why)| format!("{}:{line}: {why}", file.display())).collect();
        let hint = "an object is written as under `planner.world` in a blueprint; nothing was added";
        return Err(Failure::usage(each.join("\n")).hint(hint));
    }
    Ok(objects.into_iter().map(|(name, entry)| entry.named(name)).collect())
}

/// Returns an object of a file in this folder, with whole paths; or what is wrong with it.
fn entry(name: &str, value: Value, folder: &Path) -> std::result::Result<WorldEntry, String> {
    let mut entry = serde_json::from_value::<WorldEntry>(value).map_err(|e| e.to_string())?;
    if let ShapeSpec::Mesh(path) | ShapeSpec::Cloud(path) = &mut entry.shape {
        *path = full_path(&folder.join(&path)).map_err(|failure| failure.what)?;
    }
    WorldAdd(entry.clone().named(name.to_owned())).valid().map(|()| entry)
}

fn list(client: &mut Client, json: bool) -> Result<()> {
    let world = client.call(World {})?;
    if json {
        output::json(&world);
        return Ok(());
    }
    let mut table = Table::new(&["NAME", "?SHAPE", "~SIZE m", ">XYZ m", ">?RPY rad", ">?PADDING m", "?HELD BY"]);
    let three = |values: [f64; 3], decimals| values.map(|v| fixed(v, decimals)).join(" ");
    for object in &world.objects {
        let (kind, size) = match &object.shape {
            ShapeSpec::Box(size) => ("box", size.map(|v| fixed(v, 3)).join(" ")),
            ShapeSpec::Sphere(radius) => ("sphere", format!("r {}", fixed(*radius, 3))),
            ShapeSpec::Cylinder([r, l]) => ("cylinder", format!("r {}, {} long", fixed(*r, 3), fixed(*l, 3))),
            ShapeSpec::Mesh(path) => ("mesh", path.clone()),
            ShapeSpec::Cloud(path) => ("cloud", path.clone()),
        };
        let PoseSpec { xyz, quat, rpy } = object.pose;
        let rpy = match pose::to_xyz_rpy(&pose::from_written(xyz, quat, rpy)).1 {
            [0.0, 0.0, 0.0] => "-".to_owned(),
            turned => three(turned, 2),
        };
        let held = object.held_by.as_ref().map_or_else(|| "-".into(), |[robot, link]| format!("{robot} {link}"));
        let padding = fixed(object.padding, 3);
        table.row([object.name.clone(), kind.into(), size, three(xyz, 3), rpy, padding, held]);
    }
    if world.objects.is_empty() {
        output::note("the world is empty: add an object with `dimos world add`");
    } else {
        table.print();
        if world.objects.iter().any(|object| object.held_by.is_some()) {
            output::note("the pose of a held object is in the frame of the link that holds it, all others in `map`");
        }
    }
    Ok(())
}
