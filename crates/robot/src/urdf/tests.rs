use super::*;
use crate::model::Geometry;

fn report(body: &str) -> String {
    match from_text("t.urdf", body) {
        Ok(model) => format!("{} links, {} joints", model.links.len(), model.joints.len()),
        Err(text) => text,
    }
}

fn robot(body: &str) -> String {
    format!("<robot name=\"t\">{body}</robot>")
}

const TWO: &str = "<link name='a'/><link name='b'/>";

fn joint(kind: &str, inside: &str) -> String {
    robot(&format!("{TWO}<joint name='j' type='{kind}'><parent link='a'/><child link='b'/>{inside}</joint>"))
}

const LIMIT: &str = "<limit lower='-1' upper='2' velocity='3' effort='4'/>";

/// A limit from -1 to 2 with soft limits.
fn soft(inside: &str) -> String {
    format!("{LIMIT}<safety_controller k_velocity='1' {inside}/>")
}

/// Reads a robot without mistakes; its warnings with their hints.
fn warned(text: &str) -> (RobotModel, Vec<String>) {
    let mut tree = Tree::new();
    let source = tree.add_source("t.urdf", text);
    let document = crate::xml::parse(&mut tree, source).unwrap();
    let refuse: &Resolve<'_> = &|uri| Err(uri.to_owned());
    let model = read(&document.root, &mut tree, &Calls::default(), Meshes::Ignore, refuse);
    let all = tree.diags().iter();
    let all = all.map(|d| format!("{} {}", d.message, d.hint.as_deref().unwrap_or_default()));
    (model.unwrap_or_else(|| panic!("{:?}", tree.diags())), all.collect())
}

#[test]
fn a_tree_is_put_in_order() {
    let text = robot(
        "<joint name='j3' type='prismatic'><parent link='c'/><child link='d'/><axis xyz='0 0 2'/>\
           <limit lower='-0.05' upper='0' velocity='1' effort='1'/></joint>\
         <link name='d'/><link name='b'/><link name='a'/><link name='c'/><gazebo/><link name='e'/>\
         <joint name='j1' type='continuous'><parent link='a'/><child link='b'/></joint>\
         <joint name='j2' type='fixed'><parent link='b'/><child link='c'/><origin xyz='1 2 3' rpy='0 0 0.5'/></joint>\
         <joint name='j4' type='revolute'><parent link='a'/><child link='e'/><axis xyz='0 1 0'/>\
           <limit lower='-1' upper='2' velocity='3' effort='4'/><mimic joint='j1' multiplier='2' offset='0.5'/></joint>",
    );
    let model = from_text("t", &text).unwrap();
    let names: Vec<&str> = model.links.iter().map(|l| l.name.as_str()).collect();
    assert_eq!(names, ["a", "b", "c", "d", "e"]);
    let joints: Vec<&str> = model.joints.iter().map(|j| j.name.as_str()).collect();
    assert_eq!(joints, ["j1", "j2", "j3", "j4"]);
    assert!(model.joints.iter().enumerate().all(|(i, j)| j.child == i + 1 && j.parent <= i));
    assert_eq!(model.joints[2].axis.into_inner(), Vector3::z());
    assert_eq!(model.joints[0].limits, Limits::NONE);
    assert_eq!(model.joints[3].mimic, Some(Mimic { leader: 0, multiplier: 2.0, offset: 0.5 }));
    assert_eq!(model.independent_joints(), [0, 2]);
    assert_eq!(model.chain(0, 3), Some(vec![0, 1, 2]));
    assert_eq!(model.chain(1, 4), None);
    // From d up to a, and down to e, which follows j1.
    assert_eq!((model.path(3, 4), model.path(1, 3), model.path(2, 2)), (vec![2, 1, 0, 3], vec![1, 2], vec![]));
    assert_eq!(model.independent_of(&[2, 1, 0, 3]), [2, 0]);
    let at = model.positions(&[("j1".to_owned(), 0.25), ("j3".to_owned(), -0.04)].into());
    assert_eq!(at, [0.25, 0.0, -0.04, 1.0]);
    let tip = model.link_poses(&[0.0, 0.0, -0.04, 0.0])[3];
    assert!((tip.translation.vector - Vector3::new(1.0, 2.0, 2.96)).norm() < 1e-15);
    assert!((tip.rotation.euler_angles().2 - 0.5).abs() < 1e-15);
}

#[test]
fn mistakes_are_reported_with_their_position() {
    let limits = |l: &str| joint("revolute", l);
    let new = |text: String| text.replace("name=\"t\"", "name='t' version='1.2'");
    let long = robot(&(0..600).map(|i| format!("<link name='l{i}'/>")).collect::<String>());
    for (text, what, place) in [
        ("<robt name='x'/>".to_owned(), "the root element is `robt`", "t.urdf:1:2"),
        ("<robot><link name='a'/></robot>".to_owned(), "this `robot` has no `name`", "t.urdf:1:2"),
        (robot(""), "the robot has no links", "t.urdf:1:2"),
        (robot("\n <link/>"), "this `link` has no `name`", "t.urdf:2:3"),
        (robot(TWO), "the links `b` and `a` both have no parent", "t.urdf:1:45"),
        (robot("<link name='a'/>\n<link name='a'/>"), "two links are named `a`", "t.urdf:2:13"),
        (joint("fixed", "").replace("child link='b'", "child link='c'"), "the child link `c` does not exist", ""),
        (joint("fixed", "").replace("parent link='a'", "parent link='aa'"), "the parent link `aa` does not exist", ""),
        (joint("fixd", ""), "unknown joint type", "t.urdf:1"),
        (
            robot(&format!(
                "{TWO}<link name='c'/><joint name='k' type='fixed'><parent link='a'/><child link='b'/></joint>\
                            <joint name='j' type='planar'><parent link='b'/><child link='c'/></joint>"
            )),
            "joints of type `planar` are not supported",
            "",
        ),
        (joint("spherical", ""), "joints of type `spherical` are not supported", ""),
        (joint("revolute", ""), "this revolute joint has no `limit`", ""),
        (joint("fixed", "").replace("name=\"t\"", "name='t' version='1.3'"), "unknown version `1.3`", "t.urdf:1:26"),
        (new(limits("<limit upper='1' velocity='1'/>")), "this limit has no `lower`: version 1.2 needs it", ""),
        (new(limits("<limit lower='-1' velocity='1'/>")), "this limit has no `upper`: version 1.2 needs it", ""),
        (new(limits("<limit lower='-1' upper='1' deceleration='-1'/>")), "the deceleration limit -1 is negative", ""),
        (new(limits(&format!("{LIMIT}<origin quat_xyzw='0 0 0 0'/>"))), "this quaternion is zero", ""),
        (new(limits(&format!("{LIMIT}<origin quat_xyzw='0 0 1'/>"))), "`quat_xyzw` takes 4 numbers, found 3", ""),
        (new(limits(&format!("{LIMIT}<origin rpy='0 0 0' quat_xyzw='0 0 0 1'/>"))), "not both", ""),
        (limits(&soft("soft_lower_limit='3'")), "no position is left for the joint `j`: 3 to 2", "t.urdf:1"),
        (limits(&soft("soft_upper_limit='-1.5'")), "no position is left for the joint `j`: -1 to -1.5", ""),
        (limits(&soft("soft_upper_limit='x'")), "`soft_upper_limit`: `x` is not a number", ""),
        (limits("<limit lower='-1' upper='1'/>"), "this limit has no `velocity`", ""),
        (limits("<limit lower='2' upper='-1' velocity='1'/>"), "the lower limit 2 is above the upper limit -1", ""),
        (limits("<limit lower='-1' upper='1' velocity='-3'/>"), "the velocity limit -3 is negative", ""),
        (limits("<limit lower='nan' upper='1' velocity='3'/>"), "only finite numbers are allowed", ""),
        (limits("<limit lower='1e999' upper='1' velocity='3'/>"), "only finite numbers are allowed", ""),
        (limits("<limit lower='1,5' upper='2' velocity='3'/>"), "is not a number", ""),
        (limits(&format!("{LIMIT}<axis xyz='0 0 0'/>")), "this axis is zero", ""),
        (limits(&format!("{LIMIT}<axis xyz='0 1'/>")), "`xyz` takes 3 numbers, found 2", ""),
        (limits(&format!("{LIMIT}<origin xyz='0 0 x'/>")), "`xyz`: `x` is not a number", ""),
        (limits(&format!("{LIMIT}<mimic joint='k'/>")), "the mimic leader `k` does not exist", ""),
        (limits(&format!("{LIMIT}<mimic joint='j'/>")), "mimic each other in a circle", ""),
        (joint("fixed", "").replace("<parent link='a'/>", ""), "this joint has no `parent`", ""),
        (long, "at most 512 links", ""),
        (robot("<link name='a'><collision><geometry/></collision></link>"), "this geometry is empty", ""),
        (
            robot("<link name='a'><collision><geometry><sphere radius='-1'/></geometry></collision></link>"),
            "the radius of this sphere is -1",
            "",
        ),
    ] {
        let found = report(&text);
        assert!(found.contains(what) && found.contains(place), "{what}\n{text}\n{found}");
    }
}

#[test]
fn loops_and_second_parents_are_found() {
    let link = |name: &str| format!("<link name='{name}'/>");
    let fixed = |n: &str, p: &str, c: &str| {
        format!("<joint name='{n}' type='fixed'><parent link='{p}'/><child link='{c}'/></joint>")
    };
    let all = link("a") + &link("b") + &link("c");
    let ring = robot(&(all.clone() + &fixed("1", "a", "b") + &fixed("2", "b", "a") + &fixed("3", "a", "c")));
    let two = robot(&(all.clone() + &fixed("1", "a", "b") + &fixed("2", "c", "b")));
    let apart = robot(&(all.clone() + &fixed("1", "b", "c") + &fixed("2", "c", "b")));
    let whole = robot(&(all + &fixed("1", "a", "b") + &fixed("2", "b", "c") + &fixed("3", "c", "a")));
    for (text, what) in [
        (ring, "every link has a parent: the joints form a loop"),
        (two, "the link `b` has two parents"),
        (apart, "is part of a loop that is not connected to the root `a`"),
        (whole, "every link has a parent"),
    ] {
        let found = report(&text);
        assert!(found.contains(what), "{what}\n{found}");
    }
}

#[test]
fn everything_wrong_is_reported_at_once() {
    let text = robot(
        "<link name='a'/><link name='a'/><joint name='j' type='revolute'><parent link='a'/><child link='z'/>\
         <axis xyz='0 0 0'/></joint>",
    );
    let found = report(&text);
    assert_eq!(found.matches("error:").count(), 4, "{found}");
}

#[test]
fn what_exporters_write_is_accepted() {
    // SolidWorks: axis and limits of zero on fixed joints. xArm: empty materials. Franka: no inertia.
    let odd = joint("fixed", "<axis xyz='0 0 0'/><limit lower='0' upper='0' effort='0' velocity='0'/>");
    assert_eq!(report(&odd), "2 links, 1 joints");
    let zero = joint("revolute", "<limit lower='0' upper='1' effort='0' velocity='0'/>");
    assert_eq!(from_text("t", &zero).unwrap().joints[0].limits.velocity, f64::INFINITY);
    let seen = robot(
        "<material name='m'><color rgba='1 0 0.5 1'/></material>\
         <link name='a'><inertial/><visual name='v'><geometry><box size='1 2 3'/></geometry><material name='m'/></visual>\
         <visual><geometry><mesh filename='package://p/x.stl' scale='1 -1 0.001'/></geometry><material/></visual>\
         <visual><geometry/></visual><collision><geometry><capsule radius='1' length='2'/></geometry></collision></link>",
    );
    let model = from_text("t", &seen).unwrap();
    let visuals = &model.links[0].visuals;
    assert_eq!((visuals.len(), visuals[0].color), (2, Some([1.0, 0.0, 0.5, 1.0])));
    let Geometry::Mesh(mesh) = &visuals[1].geometry else { panic!("{visuals:?}") };
    assert_eq!((mesh.uri.as_str(), mesh.scale), ("package://p/x.stl", Vector3::new(1.0, -1.0, 0.001)));
    assert_eq!(model.links[0].collisions[0].geometry, Geometry::Capsule { radius: 1.0, length: 2.0 });
}

#[test]
fn a_floating_root_counts_as_fixed_and_shapes_without_extent_are_left_out() {
    let empty = |shape: &str| format!("<link name='a'><collision><geometry>{shape}</geometry></collision></link>");
    for (text, what) in [
        (joint("floating", ""), "this floating joint at the root counts as fixed"),
        (joint("planar", ""), "this planar joint at the root counts as fixed"),
        (robot(&empty("<box size='0 0.0 0'/>")), "this box has no extent: it is left out"),
        (robot(&empty("<sphere radius='0'/>")), "this sphere has no extent"),
        (robot(&empty("<cylinder radius='0' length='0'/>")), "this cylinder has no extent"),
    ] {
        let (model, found) = warned(&text);
        assert!(found.len() == 1 && found[0].contains(what), "{text}: {found:?}");
        assert!(model.links[0].collisions.is_empty() && model.independent_joints().is_empty());
    }
    // A plate without thickness is a mistake, not an empty shape.
    assert!(report(&robot(&empty("<box size='1 1 0'/>"))).contains("must be positive"));
}

#[test]
fn mimic_chains_are_resolved() {
    let link = |n: usize| format!("<link name='l{n}'/>");
    let follow = |n: usize, whom: &str| {
        format!(
            "<joint name='j{n}' type='revolute'><parent link='l0'/><child link='l{n}'/>{LIMIT}{}</joint>",
            if whom.is_empty() { String::new() } else { format!("<mimic joint='{whom}' multiplier='2' offset='1'/>") }
        )
    };
    let links: String = (0..4).map(link).collect();
    let text = robot(&(links + &follow(1, "j2") + &follow(2, "j3") + &follow(3, "")));
    let model = from_text("t", &text).unwrap();
    assert_eq!(model.joints[0].mimic, Some(Mimic { leader: 2, multiplier: 4.0, offset: 3.0 }));
    assert_eq!(model.independent_joints(), [2]);
}

#[test]
fn soft_limits_narrow_and_are_said_once() {
    for (kind, inside, range, said) in [
        ("revolute", "soft_lower_limit='-0.5' soft_upper_limit='1'", [-0.5, 1.0], "j to -0.5 … 1 rad"),
        ("prismatic", "soft_upper_limit='1'", [-1.0, 1.0], "j to -1 … 1 m"),
        ("revolute", "soft_lower_limit='0'", [0.0, 2.0], "j to 0 … 2 rad"),
        ("revolute", "soft_lower_limit='-9' soft_upper_limit='9'", [-1.0, 2.0], ""),
        ("revolute", "k_position='3'", [-1.0, 2.0], ""),
        ("continuous", "soft_lower_limit='0' soft_upper_limit='1'", [f64::NEG_INFINITY, f64::INFINITY], ""),
    ] {
        let (model, found) = warned(&joint(kind, &soft(inside)));
        assert_eq!([model.joints[0].limits.lower, model.joints[0].limits.upper], range, "{kind} {inside}");
        assert_eq!(found.len(), usize::from(!said.is_empty()), "{found:?}");
        assert!(found.iter().all(|found| found.contains(said)), "{found:?}");
    }
    let narrowed = soft("soft_upper_limit='1'");
    let two = joint("revolute", &narrowed).replace(
        "</robot>",
        &format!(
            "<link name='c'/><joint name='k' type='revolute'><parent link='b'/><child link='c'/>{narrowed}</joint>\
             </robot>"
        ),
    );
    let (_, found) = warned(&two);
    assert!(found.len() == 1 && found[0].contains("narrow j to -1 … 1 rad, k to -1 … 1 rad"), "{found:?}");
}

#[test]
fn what_a_version_does_not_know_is_said() {
    let old = joint("revolute", &format!("{LIMIT}<origin rpy='0 0 1' quat_xyzw='x'/>"));
    let (model, found) = warned(&old);
    assert!((model.joints[0].origin.rotation.euler_angles().2 - 1.0).abs() < 1e-15);
    assert!(found.len() == 1 && found[0].contains("counts from version 1.1 on"), "{found:?}");
    let (model, found) = warned(&joint("revolute", "<limit velocity='3'/>"));
    assert_eq!((model.joints[0].limits.lower, model.joints[0].limits.upper), (0.0, 0.0));
    assert!(found.len() == 1 && found[0].contains("cannot move: its range is 0 to 0 rad"), "{found:?}");
    let new = joint("revolute", "<limit lower='-1' upper='1'/>").replace("name=\"t\"", "name='t' version='1.2'");
    let (model, found) = warned(&new);
    assert_eq!(model.joints[0].limits.velocity, f64::INFINITY);
    assert!(found.len() == 1 && found[0].contains("`max_velocity`"), "{found:?}");
}

#[test]
fn the_smaller_of_acceleration_and_deceleration_counts() {
    for (rates, expected) in [
        ("acceleration='5' deceleration='2'", Some(2.0)),
        ("acceleration='2' deceleration='5'", Some(2.0)),
        ("deceleration='2'", Some(2.0)),
        ("deceleration='-2'", Some(2.0)),
        ("acceleration='2' deceleration='0'", Some(2.0)),
        ("", None),
    ] {
        let text = joint("revolute", &LIMIT.replace("/>", &format!(" {rates}/>")));
        let (model, found) = warned(&text);
        assert_eq!((model.joints[0].limits.acceleration, found.len()), (expected, 0), "{rates}");
    }
}

#[test]
fn degrees_are_suspected() {
    let range = |lower: &str, upper: &str| {
        let limit = LIMIT.replace("-1", lower).replace("upper='2'", &format!("upper='{upper}'"));
        warned(&joint("revolute", &limit)).1
    };
    let found = range("-180", "180");
    assert!(found.len() == 1 && found[0].contains("is it in degrees?") && found[0].contains("3.1416 rad"), "{found:?}");
    assert_eq!(range("0", "90").len(), 1);
    // Two turns to each side, as of many arms.
    for end in ["6.28318530718", "6.2832"] {
        assert_eq!(range(&format!("-{end}"), end), [""; 0]);
    }
    assert_eq!(warned(&joint("prismatic", &LIMIT.replace("upper='2'", "upper='40'"))).1, [""; 0]);
}
