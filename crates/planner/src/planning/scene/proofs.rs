//! Proofs that pairs of links stay apart, kept in a folder: one small file a pair, named by the hash of all that the
//! proof depends on. What changes any of that, such as another mesh, has another name; files are never trusted beyond
//! their own form, and one that cannot be read or written costs a proof.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use dimos_core::bounded;
use glamx::{DAffine3, DVec3};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::collision::Solid;
use crate::collision::proven_apart::{LinkMotion, Middle, ProvenApart, candidates};
use crate::collision::shape::{Core, Mesh};
use crate::collision::world::Robot;

/// Of the files and of how proofs are made: a new version replaces all of them.
const VERSION: u32 = 2;

/// A proof, or that none was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Kept {
    version: u32,
    /// The name of the file.
    hash: String,
    /// What the pair keeps [m].
    distance: Option<f64>,
}

/// Returns the pairs of a robot's links that are proven apart; `planned`: the joints whose limits hold.
pub(super) fn of_robot(robot: &Robot, planned: &[String], folder: Option<&Path>) -> Vec<ProvenApart> {
    let prove = |motion: LinkMotion| {
        let hash = hash(&motion);
        let file = folder.map(|folder| folder.join(format!("{hash}.json")));
        let distance = file.as_deref().and_then(|file| read(file, &hash)).unwrap_or_else(|| {
            let distance = motion.prove();
            if let Some(file) = &file {
                // Without the file the next start proves again.
                let _ = write(file, &Kept { version: VERSION, hash: hash.clone(), distance });
            }
            distance
        });
        Some(ProvenApart { links: motion.links, distance: distance? })
    };
    candidates(robot, planned).into_iter().filter_map(prove).collect()
}

/// Returns what a file keeps: that no distance is proven, or one.
fn read(file: &Path, hash: &str) -> Option<Option<f64>> {
    let kept: Kept = serde_json::from_str(&bounded::read_text(file, bounded::SMALL).ok()?).ok()?;
    let fits = kept.version == VERSION && kept.hash == hash;
    (fits && kept.distance.is_none_or(|distance| distance > 0.0)).then_some(kept.distance)
}

/// Writes a file as a whole: another program reads the old one or the new one.
fn write(file: &Path, kept: &Kept) -> io::Result<()> {
    let folder = file.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder)?;
    let new: PathBuf = folder.join(format!("{}.{}", kept.hash, std::process::id()));
    fs::write(&new, serde_json::to_string(kept)?)?;
    fs::rename(&new, file)
}

/// Returns the hash of all that a proof depends on.
fn hash(motion: &LinkMotion) -> String {
    let mut all = Sha256::new();
    all.update(VERSION.to_le_bytes());
    for solids in &motion.solids {
        all.update((solids.len() as u64).to_le_bytes());
        solids.iter().for_each(|solid| add_solid(&mut all, solid));
    }
    match &motion.middle {
        Middle::Fixed(second) => add_frame(&mut all, second),
        Middle::Turns { joint, second, range } => {
            add_frame(&mut all, joint);
            add_frame(&mut all, second);
            add(&mut all, range);
        }
    }
    all.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn add(all: &mut Sha256, numbers: &[f64]) {
    numbers.iter().for_each(|x| all.update(x.to_bits().to_le_bytes()));
}

fn add_frame(all: &mut Sha256, frame: &DAffine3) {
    add(all, &frame.to_cols_array());
}

fn add_solid(all: &mut Sha256, solid: &Solid) {
    add_frame(all, &solid.frame);
    add(all, &[solid.radius]);
    let mut points = |kind: u8, points: &[DVec3]| {
        all.update([kind]);
        all.update((points.len() as u64).to_le_bytes());
        points.iter().for_each(|p| add(all, &p.to_array()));
    };
    // The triangles of a mesh, in the order of its tree: one after the other they say all of it.
    let mesh = |mesh: &Mesh| mesh.triangles().all().concat();
    match &solid.core {
        Core::Point => points(0, &[]),
        Core::Segment { half } => points(1, &[DVec3::splat(*half)]),
        Core::Box { half } => points(2, &[*half]),
        Core::Cylinder { half, radius } => points(3, &[DVec3::new(*radius, *radius, *half)]),
        Core::Hull(hull) => match hull.surface() {
            Some(own) => points(4, &mesh(own)),
            None => points(5, hull.polyhedron().points()),
        },
        Core::Mesh(own) => points(6, &mesh(own)),
        Core::Cloud(cloud) => points(7, cloud.points()),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::collision::body::{MeshMode, solids};
    use dimos_robot::Source;
    use dimos_robot::kinematics::Kinematics;

    /// A box of these extents as triangles, as an OBJ file.
    fn cuboid([x, y, z]: [f64; 3]) -> String {
        let corner = |k: usize| {
            let sign = |bit: usize| if k >> bit & 1 == 1 { 0.5 } else { -0.5 };
            format!("v {} {} {}\n", x * sign(0), y * sign(1), z * sign(2))
        };
        let corners: String = (0..8).map(corner).collect();
        let faces = [[1, 3, 4, 2], [5, 6, 8, 7], [1, 2, 6, 5], [3, 7, 8, 4], [1, 5, 7, 3], [2, 4, 8, 6]];
        faces.iter().fold(corners, |all, [a, b, c, d]| format!("{all}f {a} {b} {c}\nf {a} {c} {d}\n"))
    }

    /// Three links: the last turns past the first, this far apart [m].
    fn robot(folder: &Path, gap: f64) -> Robot {
        for (name, size) in [("a", [0.2, 0.2, 0.1]), ("b", [0.05, 0.05, 0.02]), ("c", [0.4, 0.06, 0.08])] {
            fs::write(folder.join(format!("{name}.obj")), cuboid(size)).unwrap();
        }
        let link = |name: &str| {
            format!(
                "<link name=\"{name}\"><collision><geometry><mesh filename=\"{name}.obj\"/></geometry></collision></link>"
            )
        };
        let joint = |parent: &str, child: &str, at: f64, axis: &str| {
            format!(
                "<joint name=\"to_{child}\" type=\"continuous\"><parent link=\"{parent}\"/><child link=\"{child}\"/>\
                 <origin xyz=\"0 0 {at}\"/><axis xyz=\"{axis}\"/></joint>"
            )
        };
        let between = joint("a", "b", 0.05, "0 0 1") + &joint("b", "c", 0.04 + gap, "0 0 1");
        let text = format!("<robot name=\"r\">{}{}{}{between}</robot>", link("a"), link("b"), link("c"));
        let file = folder.join("r.urdf");
        fs::write(&file, text).unwrap();
        let model = dimos_robot::load(&Source { path: file, ..Source::default() }).into_model().unwrap();
        Robot {
            name: String::new(),
            kinematics: Arc::new(Kinematics::whole(&model).unwrap()),
            solids: solids(&model, MeshMode::default()).unwrap(),
            model: Arc::new(model),
            base: DAffine3::IDENTITY,
            padding: 0.0,
            apart: 0.0,
            allowed: Vec::new(),
            proven: Vec::new(),
        }
    }

    #[test]
    fn a_pair_that_stays_close_is_proven_once_and_a_changed_mesh_is_proven_again() {
        let (folder, proofs) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let names = || {
            let mut all: Vec<_> =
                fs::read_dir(proofs.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
            all.sort();
            all
        };
        let of = |robot: &Robot| of_robot(robot, &[], Some(proofs.path()));
        let close = robot(folder.path(), 8e-4);
        let found = of(&close);
        assert_eq!(found, [ProvenApart { links: [0, 2], distance: 5e-4 }]);
        let first = names();
        assert_eq!(first.len(), 1);
        // The file is believed, whatever a proof would say.
        let file = proofs.path().join(&first[0]);
        let text = fs::read_to_string(&file).unwrap();
        fs::write(&file, text.replace("0.0005", "0.0004")).unwrap();
        assert_eq!(of(&close)[0].distance, 4e-4);
        // One that is damaged, or of another version, is replaced.
        for other in ["", "{", &text.replace("\"version\":2", "\"version\":0"), &text.replace("0.0005", "-1.0")] {
            fs::write(&file, other).unwrap();
            assert_eq!(of(&close), found, "{other}");
            assert_eq!(fs::read_to_string(&file).unwrap(), text);
        }
        // That nothing is proven is kept, too.
        assert_eq!(of(&robot(folder.path(), 0.021)), [ProvenApart { links: [0, 2], distance: 0.02 }]);
        assert_eq!(of(&robot(folder.path(), -1e-3)), []);
        assert_eq!(names().len(), 3);
        // Without a folder, and with one that cannot be written, the proof is the same.
        assert_eq!(of_robot(&close, &[], None), found);
        assert_eq!(of_robot(&close, &[], Some(&file)), found);
    }
}
