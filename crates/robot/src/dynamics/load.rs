//! The load at a flange, found from efforts at rest: gravity's share in them is linear in its mass and its first
//! moment.

use nalgebra::{DMatrix, DVector};

use super::{Dynamics, point_mass};

/// Rounds in which joints with larger residuals count less.
const ROUNDS: usize = 4;
/// A direction of the load that changes the efforts less than this part of the strongest one is not seen.
const SEEN: f64 = 0.02;
/// A residual below this counts as this [Nm]: exact data is no division by zero.
const LEAST: f64 = 1e-6;
/// A lighter load has no centre [kg].
const LIGHT: f64 = 0.02;

/// Efforts of an arm at rest.
#[derive(Debug, Clone, PartialEq)]
pub struct RestingEffort {
    /// Positions of its joints [rad or m].
    pub position: Vec<f64>,
    /// Efforts that hold them [Nm or N].
    pub effort: Vec<f64>,
}

/// A load that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundLoad {
    /// Mass [kg].
    pub mass: f64,
    /// Its centre in the frame of the link [m]; `None` if the mass is below 20 g.
    pub center: Option<[f64; 3]>,
    /// What remains of the efforts of each joint, root mean square [Nm or N]: errors of the model, friction, noise.
    pub residual: Vec<f64>,
}

/// Finds the load of a link. `dynamics` has the arm without that load. With `unloaded`, the efforts of the same arm at
/// the same positions without the load, what the model does not know of the arm is of no account.
///
/// # Errors
/// Values are missing, or the positions do not show mass and centre: the link must be turned about two axes.
pub fn find_load(
    dynamics: &mut Dynamics,
    link: usize,
    loaded: &[RestingEffort],
    unloaded: Option<&[RestingEffort]>,
) -> Result<FoundLoad, String> {
    let dof = dynamics.dof();
    let whole = |list: &[RestingEffort]| {
        list.iter().all(|at| {
            let values = at.position.iter().chain(&at.effort);
            at.position.len() == dof && at.effort.len() == dof && values.into_iter().all(|value| value.is_finite())
        })
    };
    if loaded.is_empty() || !whole(loaded) || unloaded.is_some_and(|list| list.len() != loaded.len() || !whole(list)) {
        return Err(format!("each place needs {dof} positions and {dof} efforts"));
    }
    let rows = loaded.len() * dof;
    let (mut columns, mut wanted) = (DMatrix::zeros(rows, 4), DVector::zeros(rows));
    for (place, at) in loaded.iter().enumerate() {
        let weight = |load: Option<[f64; 3]>, dynamics: &mut Dynamics| {
            let mut efforts = vec![0.0; dof];
            dynamics.set_load(link, load.map(|center| point_mass(1.0, center)).as_ref());
            dynamics.gravity(&at.position, &mut efforts);
            efforts
        };
        let bare = weight(None, dynamics);
        let mass = weight(Some([0.0; 3]), dynamics);
        let moved = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|center| weight(Some(center), dynamics));
        for joint in 0..dof {
            let row = place * dof + joint;
            let without = unloaded.and_then(|list| list.get(place)).map_or(&bare, |at| &at.effort);
            wanted[row] = at.effort[joint] - without[joint];
            columns[(row, 0)] = mass[joint] - bare[joint];
            for (axis, moved) in moved.iter().enumerate() {
                columns[(row, 1 + axis)] = moved[joint] - mass[joint];
            }
        }
    }
    dynamics.set_load(link, None);
    let (found, residual) = solve(&columns, &wanted, dof)?;
    let mass = found[0];
    let center = (mass.abs() >= LIGHT).then(|| [found[1] / mass, found[2] / mass, found[3] / mass]);
    Ok(FoundLoad { mass, center, residual })
}

/// Solves by least squares; each joint counts by what remains of its efforts. Returns that, too.
fn solve(columns: &DMatrix<f64>, wanted: &DVector<f64>, dof: usize) -> Result<(DVector<f64>, Vec<f64>), String> {
    let mut residual: Vec<f64> = vec![1.0; dof];
    let mut found = DVector::zeros(columns.ncols());
    for round in 0..ROUNDS {
        let weight = |row: usize| 1.0 / residual.get(row % dof).copied().unwrap_or(1.0).max(LEAST);
        let weighted = DMatrix::from_fn(columns.nrows(), columns.ncols(), |row, i| columns[(row, i)] * weight(row));
        let right = DVector::from_fn(wanted.len(), |row, _| wanted[row] * weight(row));
        let svd = weighted.svd(true, true);
        let (most, least) = (svd.singular_values.max(), svd.singular_values.min());
        if round == 0 && least < SEEN * most {
            return Err("the places do not show the load: its link must be turned about two axes".to_owned());
        }
        found = svd.solve(&right, 0.0).map_err(ToOwned::to_owned)?;
        let left = columns * &found - wanted;
        for (joint, residual) in residual.iter_mut().enumerate() {
            let own: Vec<f64> = left.iter().skip(joint).step_by(dof).map(|value| value * value).collect();
            *residual = (own.iter().sum::<f64>() / own.len().max(1) as f64).sqrt();
        }
    }
    Ok((found, residual))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::Kinematics;
    use crate::random::Random;
    use crate::{Source, load};

    #[test]
    fn a_load_is_found_from_efforts_with_friction_and_an_unknown_arm_by_comparison() {
        let model = load(&Source { path: "builtin:yourarm".into(), ..Source::default() }).into_model().unwrap();
        let joints: Vec<usize> = (0..6).map(|j| model.joint_index(&format!("joint{}", j + 1)).unwrap()).collect();
        let kinematics = || Kinematics::new(&model, &joints, &model.positions(&Default::default())).unwrap();
        let link = model.link_index("flange").unwrap();
        let (mut known, mut random) = (Dynamics::new(&model, kinematics()), Random::new(4));
        let mut heavier = model.clone();
        heavier.links.iter_mut().filter_map(|link| link.inertial.as_mut()).for_each(|own| own.mass *= 1.07);
        let mut real = Dynamics::new(&heavier, kinematics());
        let mut measure = |dynamics: &mut Dynamics, at: &[Vec<f64>], noise: f64| -> Vec<RestingEffort> {
            at.iter()
                .map(|position| {
                    let mut effort = vec![0.0; 6];
                    dynamics.gravity(position, &mut effort);
                    effort.iter_mut().for_each(|value| *value += random.between(-noise, noise));
                    RestingEffort { position: position.clone(), effort }
                })
                .collect()
        };
        let mut other = Random::new(9);
        let at: Vec<Vec<f64>> = (0..10).map(|_| (0..6).map(|_| other.between(-1.2, 1.2)).collect()).collect();
        known.set_load(link, Some(&point_mass(1.4, [0.01, -0.03, 0.08])));
        let loaded = measure(&mut known, &at, 0.02);
        let found = find_load(&mut known, link, &loaded, None).unwrap();
        let close = |found: &FoundLoad| {
            let center = found.center.unwrap();
            let off = center.iter().zip([0.01, -0.03, 0.08]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            (found.mass - 1.4).abs() < 0.04 && off < 5e-3
        };
        assert!(close(&found), "{found:?}");
        // The arm is heavier than its model: only the difference shows the load.
        let unloaded = measure(&mut real, &at, 0.02);
        real.set_load(link, Some(&point_mass(1.4, [0.01, -0.03, 0.08])));
        let loaded = measure(&mut real, &at, 0.02);
        assert!(!close(&find_load(&mut known, link, &loaded, None).unwrap()));
        let found = find_load(&mut known, link, &loaded, Some(&unloaded)).unwrap();
        assert!(close(&found) && found.residual.iter().all(|left| *left < 0.04), "{found:?}");
        // Nothing there has no centre; one place does not show a load.
        let nothing = find_load(&mut known, link, &unloaded, Some(&unloaded)).unwrap();
        assert!(nothing.mass.abs() < 1e-9 && nothing.center.is_none(), "{nothing:?}");
        let same = vec![loaded[0].clone(); 3];
        assert!(find_load(&mut known, link, &same, None).unwrap_err().contains("turned about two axes"));
        assert!(find_load(&mut known, link, &[], None).is_err());
    }
}
