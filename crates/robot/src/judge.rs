//! Judges a description that can be read: its mesh files and its inertias.

use super::mesh::MeshSizes;
use super::model::Inertial;
use super::{Loaded, RobotModel};
use dimos_yaml::{Diag, Label, quote};

/// Part of the largest moment of inertia that rounded moments may miss the triangle inequality by.
const ROUNDING: f64 = 1e-3;

/// Reports what is wrong with a robot's mesh files and inertias, and what is doubtful. Returns the sizes of the meshes.
pub fn judge(loaded: &mut Loaded, robot: &RobotModel) -> MeshSizes {
    let mut meshes = MeshSizes::default();
    let mistakes = meshes.mistakes(robot, loaded.document.as_ref());
    mistakes.into_iter().for_each(|diag| loaded.report(diag));
    impossible_inertias(robot, loaded);
    meshes
}

/// Warns of inertias that no body has: simulators and dynamics libraries reject them.
fn impossible_inertias(robot: &RobotModel, loaded: &mut Loaded) {
    for link in &robot.links {
        let Some(what) = link.inertial.as_ref().and_then(impossible) else { continue };
        let diag = Diag::warning(format!("the inertia of the link {} is impossible: {what}", quote(&link.name)));
        let at = place_of_inertia(loaded, &link.name);
        loaded.report(at.into_iter().fold(diag, Diag::at));
    }
}

/// Returns what makes an inertia impossible: a negative principal moment, or one above the sum of the others.
fn impossible(inertial: &Inertial) -> Option<String> {
    let mut moments = inertial.inertia.symmetric_eigenvalues();
    moments.as_mut_slice().sort_by(f64::total_cmp);
    let [small, middle, large] = [moments.x, moments.y, moments.z];
    let rounding = ROUNDING * large.abs().max(small.abs());
    if small < -rounding {
        return Some(format!("a principal moment is {small:.3e} kg·m²"));
    }
    (small + middle < large - rounding).then(|| {
        format!("its principal moment {large:.3e} kg·m² is above the sum of the others, {:.3e}", small + middle)
    })
}

fn place_of_inertia(loaded: &Loaded, link: &str) -> Option<Label> {
    let root = &loaded.document.as_ref()?.root;
    let mut links = root.named("link").filter(|element| element.attribute("name").is_some_and(|a| a.value == link));
    Some(links.next()?.child("inertial")?.child("inertia")?.at.label())
}
