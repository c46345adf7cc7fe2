//! Tests of [`super`], against the product of the matrices of all joints.

use nalgebra::{Matrix4, Vector4};

use super::super::test_random;
use super::super::{Source, load};
use super::*;
use dimos_core::arm::test_dh::product;

/// Parameters of a UR5e by the data sheet.
fn sheet() -> Vec<Dh> {
    let quarter = std::f64::consts::FRAC_PI_2;
    let dh = |a, d, alpha| Dh { theta: 0.0, a, d, alpha };
    vec![
        dh(0.0, 0.1625, quarter),
        dh(-0.425, 0.0, 0.0),
        dh(-0.3922, 0.0, 0.0),
        dh(0.0, 0.1333, quarter),
        dh(0.0, 0.0997, -quarter),
        dh(0.0, 0.0996, 0.0),
    ]
}

/// Returns the parameters of an arm whose axes are turned and moved a little from where the data sheet has them, about
/// and along x and y of their frames [rad, m]: as a fit states them. The common normal of two axes that are almost
/// parallel is far away.
fn fitted(turns: [[f64; 2]; 6], shifts: [[f64; 2]; 6]) -> Vec<Dh> {
    let mut frame = Matrix4::identity();
    let axis = |((dh, [tx, ty]), [sx, sy]): ((&Dh, [f64; 2]), [f64; 2])| -> (Vector4<f64>, Vector4<f64>) {
        let tilt = Rotation3::from_scaled_axis(Vector3::new(tx, ty, 0.0)).to_homogeneous();
        let own = frame * Matrix4::new_translation(&Vector3::new(sx, sy, 0.0)) * tilt;
        frame *= product(&[*dh], &[0.0]);
        (own * Vector4::w(), own * Vector4::z())
    };
    let lines: Vec<_> = sheet().iter().zip(turns).zip(shifts).map(axis).collect();
    let (mut dh, mut at) = (Vec::new(), Matrix4::identity());
    for (line, sheet) in lines.iter().skip(1).zip(sheet()) {
        let back = at.try_inverse().unwrap();
        let (p, u): (Vector4<f64>, Vector4<f64>) = (back * line.0, back * line.1);
        let (p, u) = (p.xyz(), u.xyz());
        let sign = if sheet.alpha < 0.0 { -1.0 } else { 1.0 };
        let across = Vector3::z().cross(&u);
        let normal = across.normalize() * sign;
        let d = p.cross(&u).dot(&normal) / across.dot(&normal);
        let a = (p - Vector3::z() * d).dot(&normal);
        dh.push(Dh { theta: normal.y.atan2(normal.x), a, d, alpha: across.dot(&normal).atan2(u.z) });
        at *= product(&dh[dh.len() - 1..], &[0.0]);
    }
    let rest = at.try_inverse().unwrap() * frame;
    dh.push(Dh { theta: rest[(1, 0)].atan2(rest[(0, 0)]), a: 0.0, d: rest[(2, 3)], alpha: 0.0 });
    dh
}

fn model(places: Places) -> RobotModel {
    load(&Source { places, ..Source::new("builtin:ur5e") }).into_model().unwrap()
}

fn names() -> Vec<String> {
    (1..=6).map(|k| format!("joint{k}")).collect()
}

/// Checks flange and links of the model that is corrected to these parameters, and returns how far links are from the
/// data sheet's, at most [m].
fn check(actual: &[Dh]) -> f64 {
    check_on(actual, Isometry3::identity())
}

/// The same for a model whose first joint is elsewhere on the base link, as where that link has other axes than the
/// controller's base.
fn check_on(actual: &[Dh], root: Isometry3<f64>) -> f64 {
    let kinematics = FactoryKinematics { nominal: sheet(), actual: Some(actual.to_vec()), checksum: String::new() };
    let mut nominal = model(Places::new());
    nominal.joints[0].origin = root * nominal.joints[0].origin;
    let mut corrected = nominal.clone();
    let places = places(&nominal, &names(), &kinematics).unwrap();
    put(&places, Some(&mut corrected), &mut Document::default());
    let (link, base) = controller_base(&nominal, &names(), &sheet()).unwrap();
    let flange = nominal.link_index("tool0").unwrap();
    let mut random = test_random(7);
    let mut farthest = 0.0_f64;
    for round in 0..500 {
        let q: Vec<f64> = (0..6)
            .map(|_| if round == 0 { 0.0 } else { random() as f64 / (1_u64 << 31) as f64 * 12.0 - 6.0 })
            .collect();
        let named = names().into_iter().zip(q.clone()).collect();
        let (was, is) =
            (nominal.link_poses(&nominal.positions(&named)), corrected.link_poses(&corrected.positions(&named)));
        let own = base.inverse() * is[link].inverse() * is[flange];
        let off = own.to_homogeneous() - product(actual, &q);
        assert!(off.amax() < 1e-7, "at {q:?}: {off}");
        for (was, is) in was.iter().zip(&is) {
            farthest = farthest.max((was.translation.vector - is.translation.vector).norm());
        }
    }
    farthest
}

#[test]
fn the_data_sheet_changes_nothing() {
    let kinematics = FactoryKinematics { nominal: sheet(), actual: Some(sheet()), checksum: String::new() };
    assert_eq!(places(&model(Places::new()), &names(), &kinematics), Ok(Places::new()));
}

#[test]
fn small_differences_of_all_parameters() {
    let mut actual = sheet();
    for (i, dh) in actual.iter_mut().enumerate() {
        let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
        *dh = Dh {
            theta: dh.theta + sign * 0.002,
            a: dh.a + 0.001,
            d: dh.d - sign * 0.0008,
            alpha: dh.alpha + sign * 0.001,
        };
    }
    let farthest = check(&actual);
    assert!((0.001..0.02).contains(&farthest), "{farthest} m");
}

#[test]
fn a_base_link_with_other_axes_than_the_controllers_base() {
    let root = Isometry3::new(Vector3::new(0.3, -0.2, 0.1), Vector3::z() * std::f64::consts::PI);
    let mut actual = sheet();
    (actual[0].theta, actual[1].a, actual[2].alpha) = (0.004, -0.423, 0.002);
    assert!(check_on(&actual, root) < 0.02);
}

#[test]
fn a_flange_that_is_off_its_axis() {
    let mut actual = sheet();
    (actual[5].a, actual[5].alpha) = (0.002, 0.003);
    assert!(check(&actual) < 0.02);
}

#[test]
fn parallel_axes_whose_common_normal_is_far_away() {
    let turns = [[0.0, 0.0], [3e-4, -2e-4], [-4e-4, 1e-3], [8e-4, -5e-4], [2e-4, 4e-4], [0.0, 0.0]];
    let shifts = [[0.0, 0.0], [4e-4, 2e-4], [-8e-4, 5e-4], [6e-4, -7e-4], [-3e-4, 2e-4], [0.0, 0.0]];
    let actual = fitted(turns, shifts);
    assert!(actual[1].d.abs() > 1.0 && actual[2].d.abs() > 1.0, "frames far away: {actual:?}");
    let farthest = check(&actual);
    assert!(farthest < 0.02, "{farthest} m");
}

#[test]
fn a_model_of_another_arm_is_not_corrected() {
    let mut nominal = sheet();
    nominal[1].a = -0.6127;
    let kinematics = FactoryKinematics { nominal, actual: Some(sheet()), checksum: String::new() };
    let why = places(&model(Places::new()), &names(), &kinematics).unwrap_err();
    assert!(why.starts_with("the axis of joint3 is 187.7 mm"), "{why}");
}

#[test]
fn the_description_has_the_same_places_as_the_model() {
    let mut actual = sheet();
    actual[2] = Dh { theta: 0.01, a: -0.39, d: 0.001, alpha: 0.002 };
    let kinematics = FactoryKinematics { nominal: sheet(), actual: Some(actual), checksum: String::new() };
    let places = places(&model(Places::new()), &names(), &kinematics).unwrap();
    let loaded = load(&Source { places, ..Source::new("builtin:ur5e") });
    let text = loaded.urdf().unwrap();
    let again = super::super::urdf::from_text("again", &text).unwrap();
    let model = loaded.into_model().unwrap();
    for (a, b) in model.joints.iter().zip(&again.joints) {
        assert!((a.origin.to_homogeneous() - b.origin.to_homogeneous()).amax() < 1e-6, "{}: {}", a.name, b.origin);
    }
}
