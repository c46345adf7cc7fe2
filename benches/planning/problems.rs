//! Planning problems from a file with one JSON record per line, and their robot.

use std::collections::BTreeMap;
use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use dimos::collision::body::{MeshMode, solids};
use dimos::collision::world::{Obstacle, Robot};
use dimos::collision::{Scene, Solid, World};
use dimos::planning::scene::planning_scene::always_touch;
use dimos::robot::Source;
use dimos::robot::kinematics::Kinematics;
use dimos::robot::model::{JointKind, RobotModel};
use glamx::{DAffine3, DQuat, DVec3};
use serde::Deserialize;

/// Geometry of cylinders.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Shapes {
    /// As given.
    True,
    /// As in VAMP: capsules, and boxes in the family `box`.
    Vamp,
}

/// One problem.
#[derive(Debug, Clone, Deserialize)]
pub struct Problem {
    /// Family.
    pub problem: String,
    /// Number in the family.
    pub index: u64,
    joints: Vec<String>,
    start: Vec<f64>,
    goal: Vec<f64>,
    obstacles: Vec<Thing>,
}

#[derive(Debug, Clone, Deserialize)]
struct Thing {
    name: String,
    #[serde(rename = "type")]
    kind: String,
    size: Vec<f64>,
    position: [f64; 3],
    quat_xyzw: [f64; 4],
}

/// Reads problems, at most `limit`.
pub fn load(path: &Path, limit: Option<usize>) -> Result<Vec<Problem>, Box<dyn Error>> {
    let text = fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let lines = text.lines().filter(|l| !l.trim().is_empty()).take(limit.unwrap_or(usize::MAX));
    let read = |(i, line): (usize, &str)| {
        serde_json::from_str(line).map_err(|e| format!("{}:{}: {e}", path.display(), i + 1).into())
    };
    lines.enumerate().map(read).collect()
}

/// A robot loaded for planning.
pub struct Arm {
    model: Arc<RobotModel>,
    solids: Vec<Vec<Solid>>,
    allowed: Vec<(String, String)>,
}

impl Arm {
    /// Loads a URDF, and the allowed collision pairs of an SRDF.
    pub fn load(urdf: &Path, srdf: Option<&Path>, packages: BTreeMap<String, PathBuf>) -> Result<Self, Box<dyn Error>> {
        let source = Source { path: urdf.to_owned(), packages, srdf: srdf.map(Path::to_owned), ..Source::default() };
        let mut loaded = dimos::robot::load(&source);
        let allowed: Vec<_> = std::mem::take(&mut loaded.semantics).disabled_pairs().collect();
        let model = loaded.into_model()?;
        let solids = solids(&model, MeshMode::Hull)?;
        let all = allowed.len();
        let allowed: Vec<_> = allowed.into_iter().filter_map(|pair| own_pair(&model, &pair)).collect();
        if allowed.len() < all {
            println!("note      {} of the SRDF's {all} pairs refer to links of {}", allowed.len(), model.name);
        }
        Ok(Self { model: Arc::new(model), solids, allowed })
    }

    /// Returns the model.
    pub fn model(&self) -> &RobotModel {
        &self.model
    }

    /// Returns the kinematics of a problem's joints: matched by name, otherwise by the name without the prefix shared
    /// by all joints, otherwise by a unique suffix.
    pub fn kinematics(&self, problem: &Problem) -> Result<Kinematics, Box<dyn Error>> {
        let own: Vec<(usize, &str)> =
            self.model.independent_joints().into_iter().map(|j| (j, self.model.joints[j].name.as_str())).collect();
        let prefix = shared_prefix(&own.iter().map(|o| o.1).collect::<Vec<_>>());
        let foreign = shared_prefix(&problem.joints.iter().map(String::as_str).collect::<Vec<_>>());
        let find = |name: &String| {
            let only = |is: &dyn Fn(&str) -> bool| match own.iter().filter(|o| is(o.1)).collect::<Vec<_>>()[..] {
                [one] => Some(one.0),
                _ => None,
            };
            let ends = |suffix: &str| only(&|o| o.ends_with(suffix));
            only(&|o| o == name)
                .or_else(|| only(&|o| o[prefix..] == name[foreign..]))
                .or_else(|| name.match_indices(['_', '/', '-']).find_map(|(at, _)| ends(&name[at..])))
                .ok_or(format!("the robot has no joint {name:?}, nor a unique joint with that suffix"))
        };
        let joints = problem.joints.iter().map(find).collect::<Result<Vec<_>, _>>()?;
        for (i, joint) in joints.iter().enumerate() {
            if let Some(twin) = joints[..i].iter().position(|j| j == joint) {
                let (a, b) = (&problem.joints[twin], &problem.joints[i]);
                return Err(format!("joints {a:?} and {b:?} of the problems match the same joint of the robot").into());
            }
        }
        Ok(Kinematics::new(&self.model, &joints, &self.rest())?)
    }

    /// Returns where joints are that no problem names: prismatic ones belong to a gripper, which is open.
    pub fn rest(&self) -> Vec<f64> {
        let open = |j: &dimos::robot::Joint| if j.kind == JointKind::Prismatic { j.limits.upper } else { 0.0 };
        let mut rest: Vec<f64> = self.model.joints.iter().map(open).collect();
        for (j, joint) in self.model.joints.iter().enumerate() {
            if let Some(mimic) = joint.mimic {
                rest[j] = mimic.multiplier * rest[mimic.leader] + mimic.offset;
            }
        }
        rest
    }

    fn robot(&self, kinematics: &Arc<Kinematics>) -> Robot {
        Robot {
            name: String::new(),
            model: self.model.clone(),
            kinematics: kinematics.clone(),
            solids: self.solids.clone(),
            base: DAffine3::IDENTITY,
            padding: 0.0,
            apart: 0.0,
            proven: Vec::new(),
            allowed: self.allowed.clone(),
        }
    }

    /// Allows pairs of links that touch in every configuration, as a run does; prints and returns them.
    pub fn allow_always_touching_pairs(&mut self, kinematics: &Arc<Kinematics>) -> Vec<[String; 2]> {
        let pairs = always_touch(&self.robot(kinematics));
        for [a, b] in &pairs {
            println!("note      {a} and {b} touch in every configuration: not checked");
            self.allowed.push((a.clone(), b.clone()));
        }
        pairs
    }

    /// Returns the scene of a problem.
    pub fn scene(
        &self,
        kinematics: &Arc<Kinematics>,
        problem: &Problem,
        shapes: Shapes,
    ) -> Result<Arc<Scene>, Box<dyn Error>> {
        let mut world = World::new();
        world.add_robot(self.robot(kinematics))?;
        for thing in &problem.obstacles {
            let solid = solid(thing, &problem.problem, shapes)?;
            world.add(Obstacle { name: thing.name.clone(), solid, padding: 0.0 })?;
        }
        Ok(world.snapshot())
    }
}

impl Problem {
    /// Returns it in the text format of VAMP's program: lengths [m], angles about x, y, z [rad]. As in VAMP, cylinders
    /// are capsules, and boxes in the family `box`.
    pub fn text(&self) -> Result<String, Box<dyn Error>> {
        let words = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let mut text = format!("P {} {} {} {}\n", self.problem, self.index, words(&self.start), words(&self.goal));
        for thing in &self.obstacles {
            // VAMP's angles are about the fixed axes x, y, z: about z first, if the axes turn along.
            let (c, b, a) = DQuat::from_array(thing.quat_xyzw).normalize().to_euler(glamx::EulerRot::ZYX);
            let place = format!("{} {}", words(&thing.position), words(&[a, b, c]));
            let line = match (thing.kind.as_str(), thing.size.as_slice()) {
                ("sphere", [r]) => format!("S {place} {r}"),
                ("box", size) => format!("B {place} {}", words(&size.iter().map(|s| s / 2.0).collect::<Vec<_>>())),
                ("cylinder", [r, l]) if self.problem == "box" => format!("B {place} {}", words(&[*r, *r, l / 2.0])),
                ("cylinder", [r, l]) => format!("C {place} {r} {l}"),
                (kind, _) => return Err(format!("VAMP has no {kind:?}").into()),
            };
            text += &line;
            text.push('\n');
        }
        Ok(text)
    }

    /// Returns its start and goal.
    pub fn ends(&self) -> (&[f64], &[f64]) {
        (&self.start, &self.goal)
    }
}

fn solid(thing: &Thing, family: &str, shapes: Shapes) -> Result<Solid, Box<dyn Error>> {
    let turn = DQuat::from_array(thing.quat_xyzw).normalize();
    let at = DAffine3::from_rotation_translation(turn, DVec3::from(thing.position));
    let made = match (thing.kind.as_str(), thing.size.as_slice(), shapes) {
        ("box", &[x, y, z], _) => Solid::cuboid(DVec3::new(x, y, z), at),
        ("sphere", &[r], _) => Solid::sphere(r, at),
        ("cylinder", &[r, l], Shapes::True) => Solid::cylinder(r, l, at),
        ("cylinder", &[r, l], _) if family == "box" => Solid::cuboid(DVec3::new(2.0 * r, 2.0 * r, l), at),
        ("cylinder", &[r, l], _) => Solid::capsule(r, l, at),
        _ => return Err(format!("{:?} is a {:?} with sizes {:?}", thing.name, thing.kind, thing.size).into()),
    };
    Ok(made?)
}

/// Returns a pair of links by the model's names: matched by name, otherwise by a unique suffix.
fn own_pair(model: &RobotModel, (a, b): &(String, String)) -> Option<(String, String)> {
    let own = |name: &String| {
        let ends = |suffix: &str| match model.links.iter().filter(|l| l.name.ends_with(suffix)).collect::<Vec<_>>()[..]
        {
            [one] => Some(one.name.clone()),
            _ => None,
        };
        let exact = model.link_index(name).map(|_| name.clone());
        exact.or_else(|| name.match_indices(['_', '/', '-']).find_map(|(at, _)| ends(&name[at..])))
    };
    Some((own(a)?, own(b)?))
}

/// Parses `NAME=DIR` arguments.
pub fn packages(arguments: &[String]) -> Result<BTreeMap<String, PathBuf>, Box<dyn Error>> {
    let mut named = BTreeMap::new();
    for argument in arguments {
        let (name, folder) = argument.split_once('=').ok_or(format!("{argument:?} is not NAME=DIR"))?;
        named.insert(name.to_owned(), folder.into());
    }
    Ok(named)
}

/// Returns the length of the prefix that all names share, up to a separator.
fn shared_prefix(names: &[&str]) -> usize {
    let first = names.first().copied().unwrap_or_default();
    let ends = first.match_indices(['_', '/', '-']).map(|(at, _)| at + 1);
    ends.filter(|&end| names.iter().all(|n| n.starts_with(&first[..end]))).max().unwrap_or(0)
}
