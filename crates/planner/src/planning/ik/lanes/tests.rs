use super::*;
use crate::collision::checker::Stop;
use dimos_robot::builtin;
use dimos_robot::model::RobotModel;
use dimos_robot::urdf::from_text;

/// A chain with what arms seldom have: slides, a mimic joint, axes at any angle, a joint without limits.
const ODD: &str = r#"<robot name="odd">
  <link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/><link name="f"/><link name="g"/>
  <link name="h"/><link name="tip"/>
  <joint name="lift" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0.1 0 0.2" rpy="0.3 0.2 -1"/>
    <axis xyz="0 0.6 0.8"/><limit lower="-0.2" upper="0.4" effort="1" velocity="1"/></joint>
  <joint name="round" type="continuous"><parent link="b"/><child link="c"/><origin xyz="0 0.1 0.3" rpy="1 -0.4 2"/>
    <axis xyz="1 0 0"/></joint>
  <joint name="one" type="revolute"><parent link="c"/><child link="d"/><origin xyz="0.3 0 0" rpy="0 1.5707963267948966 0"/>
    <axis xyz="0 0 -1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="two" type="revolute"><parent link="d"/><child link="e"/><origin xyz="0.2 0.1 0" rpy="3.141592653589793 0 0.5"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="half" type="revolute"><parent link="e"/><child link="f"/><origin xyz="0.1 0.1 0.1" rpy="0.2 0.7 0.5"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/><mimic joint="one" multiplier="-0.5" offset="0.2"/></joint>
  <joint name="out" type="prismatic"><parent link="f"/><child link="g"/><origin xyz="0 0 0.1" rpy="0 -1.5707963267948966 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
  <joint name="three" type="revolute"><parent link="g"/><child link="h"/><origin xyz="0 0.05 0.1" rpy="-1.5707963267948966 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="fixed" type="fixed"><parent link="h"/><child link="tip"/><origin xyz="0.05 0.02 0.1" rpy="0.4 0.3 0.2"/></joint>
</robot>"#;

/// All robots in the program and the odd one, each with its last link.
fn robots() -> Vec<(String, RobotModel, usize)> {
    let builtin = builtin::names().filter_map(|name| Some((name, builtin::text(name)?)));
    let model = |(name, text): (&str, &str)| {
        let model = from_text(name, text).unwrap();
        let depth = |link: &usize| model.path(0, *link).len();
        let tip = (0..model.links.len()).max_by_key(depth).unwrap();
        (name.to_owned(), model, tip)
    };
    builtin.chain([("odd", ODD)]).map(model).collect()
}

fn random_q(kinematics: &Kinematics, random: &mut Random) -> Vec<f64> {
    kinematics.limits().iter().map(|l| sample(l.lower, l.upper, random)).collect()
}

#[test]
fn each_lane_has_the_pose_of_its_configuration() {
    for (name, model, tip) in robots() {
        let kinematics = Kinematics::whole(&model).unwrap();
        let mut ik = Ik::new(&kinematics, tip);
        let mut random = Random::new(5);
        for _ in 0..20 {
            let q = random_q(&kinematics, &mut random);
            let pose = ik.pose(&q);
            let mut beside = pose;
            beside.translation.y += 3e-4;
            let mut turned = pose;
            turned.matrix3 = glamx::DMat3::from_rotation_y(3e-4) * pose.matrix3;
            let solver = &mut ik.lanes.as_mut().unwrap().solver;
            let mut lanes: Vec<Lanes> = q.iter().map(|q| Lanes::splat(*q as f32)).collect();
            let mut arrived = |pose: &DAffine3| solver.descend(&columns(pose), true, &mut lanes, 0, Until::All);
            assert_eq!(arrived(&pose), u16::MAX, "{name} at {q:?}");
            assert_eq!([arrived(&beside), arrived(&turned)], [0, 0], "{name} at {q:?}");
        }
    }
}

#[test]
fn a_pose_turned_by_half_a_turn_has_not_been_reached() {
    let (_, model, tip) = robots().pop().unwrap();
    let kinematics = Kinematics::whole(&model).unwrap();
    let mut ik = Ik::new(&kinematics, tip);
    let q = random_q(&kinematics, &mut Random::new(5));
    let mut pose = ik.pose(&q);
    pose.matrix3 *= glamx::DMat3::from_rotation_x(std::f64::consts::PI);
    let solver = &mut ik.lanes.as_mut().unwrap().solver;
    let mut lanes: Vec<Lanes> = q.iter().map(|q| Lanes::splat(*q as f32)).collect();
    assert_eq!(solver.descend(&columns(&pose), true, &mut lanes, 0, Until::All), 0);
}

#[test]
fn every_width_gives_the_same_bits() {
    for (name, model, tip) in robots() {
        let kinematics = Kinematics::whole(&model).unwrap();
        let (joints, offset) = kinematics.chain(tip);
        let limits: Vec<(f64, f64)> = kinematics.limits().iter().map(|l| (l.lower, l.upper)).collect();
        let mut random = Random::new(11);
        let pose = Ik::new(&kinematics, tip).pose(&random_q(&kinematics, &mut random));
        let starts: Vec<Vec<f64>> = (0..LANES).map(|_| random_q(&kinematics, &mut random)).collect();
        let mut ends: Vec<(u16, Vec<[u32; LANES]>)> = Vec::new();
        for width in Width::usable() {
            let mut solver = Solver::new(Chain::new(&joints, &columns(&offset)).unwrap(), &limits, width);
            let lane = |v: usize| Lanes(std::array::from_fn(|lane| starts[lane][v] as f32));
            let mut q: Vec<Lanes> = (0..limits.len()).map(lane).collect();
            let arrived = solver.descend(&columns(&pose), true, &mut q, 40, Until::All);
            ends.push((arrived, q.iter().map(|lanes| lanes.0.map(f32::to_bits)).collect()));
        }
        assert!(ends.iter().all(|end| *end == ends[0]), "{name}");
    }
}

#[test]
fn nearly_every_reachable_pose_is_solved_on_every_arm() {
    for (name, model, tip) in robots() {
        let kinematics = Kinematics::whole(&model).unwrap();
        let mut ik = Ik::new(&kinematics, tip);
        let mut random = Random::new(2);
        let mut unsolved = 0;
        for seed in 0..1000 {
            let (known, near) = (random_q(&kinematics, &mut random), random_q(&kinematics, &mut random));
            let pose = ik.pose(&known);
            let settings = IkSettings { seed, ..IkSettings::default() };
            let Ok(found) = ik.solve(&pose, &near, &settings, |_| true, &Stop::never()) else {
                unsolved += 1;
                continue;
            };
            let reached = ik.pose(&found[0]);
            assert!(reached.translation.distance(pose.translation) < 2e-6, "{name}");
            assert!(reached.matrix3.abs_diff_eq(pose.matrix3, 1e-5), "{name}");
            let inside = |(q, l): (&f64, &dimos_robot::Limits)| *q >= l.lower && *q <= l.upper;
            assert!(found[0].iter().zip(kinematics.limits()).all(inside), "{name}");
        }
        println!("{name}: {unsolved} of 1000 unsolved");
        assert!(unsolved == 0, "{name}: {unsolved} of 1000 unsolved");
    }
}
