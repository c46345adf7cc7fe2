use super::*;
use crate::{urdf, xml};

fn robot() -> RobotModel {
    let joint = |n: usize| {
        format!(
            "<joint name='j{n}' type='revolute'><parent link='l{}'/><child link='l{n}'/>\
             <limit lower='-1' upper='1' velocity='1'/></joint>",
            n - 1
        )
    };
    let links: String = (0..5).map(|n| format!("<link name='l{n}'/>")).collect();
    let joints: String = (1..5).map(joint).collect();
    urdf::from_text("t", &format!("<robot name='t'>{links}{joints}</robot>")).unwrap()
}

fn semantics(body: &str) -> (Option<Semantics>, String) {
    let mut tree = Tree::new();
    let source = tree.add_source("t.srdf", format!("<robot name='t'>{body}</robot>"));
    let document = xml::parse(&mut tree, source).unwrap();
    let out = read(&document.root, &robot(), &mut tree, &Calls::default());
    let text = tree.diags().iter().map(|d| dimos_yaml::render(&tree, d, false) + "\n").collect();
    (out, text)
}

#[test]
fn groups_poses_and_pairs_are_read() {
    let (out, text) = semantics(
        "<group name='arm'><chain base_link='l0' tip_link='l2'/></group>\
         <group name='hand'><joint name='j4'/><link name='l3'/></group>\
         <group name='all'><group name='arm'/><group name='hand'/><group name='all'/></group>\
         <group_state name='home' group='arm'><joint name='j1' value='0.5'/><joint name='j2' value='-0.25'/></group_state>\
         <end_effector name='tool' group='hand' parent_link='l2'/>\
         <virtual_joint name='v' type='fixed' parent_frame='w' child_link='l0'/>\
         <disable_collisions link1='l0' link2='l1' reason='Adjacent'/><disable_collisions link1='l0' link2='x'/>",
    );
    let out = out.unwrap();
    assert_eq!(out.group_joints(&robot(), "arm"), Some(vec![0, 1]));
    assert_eq!(out.group_joints(&robot(), "hand"), Some(vec![2, 3]));
    assert_eq!(out.group_joints(&robot(), "all"), Some(vec![0, 1, 2, 3]));
    assert_eq!(out.group_joints(&robot(), "none"), None);
    assert_eq!(out.poses[0].positions, [("j1".to_owned(), 0.5), ("j2".to_owned(), -0.25)]);
    let of = |joints: &[&str]| joints.iter().map(|j| (*j).to_owned()).collect::<Vec<_>>();
    assert_eq!(out.poses_of(&of(&["j2", "j1"])), [("home", vec![-0.25, 0.5])]);
    assert_eq!((out.poses_of(&of(&["j1", "j3"])), out.poses_of(&[])), (vec![], vec![]));
    assert_eq!((out.end_effectors.len(), out.disabled.len()), (1, 1));
    assert!(text.contains("1 pair of") && !text.contains("error"), "{text}");
}

#[test]
fn a_passive_joint_belongs_to_no_group() {
    let arm = "<group name='arm'><chain base_link='l0' tip_link='l4'/></group>";
    let (out, text) = semantics(&format!("{arm}<passive_joint name='j4'/>"));
    assert_eq!((out.unwrap().group_joints(&robot(), "arm"), text.as_str()), (Some(vec![0, 1, 2]), ""));
    let (_, text) = semantics(&format!("{arm}<passive_joint name='j9'/>"));
    assert!(text.contains("this robot has no joint `j9`"), "{text}");
}

#[test]
fn links_without_default_checks_are_allowed_to_touch_all_but_enabled_ones() {
    let (out, text) = semantics(
        "<disable_default_collisions link='l4'/><disable_collisions link1='l0' link2='l4' reason='Never'/>\
         <enable_collisions link1='l1' link2='l4'/>",
    );
    let pairs: Vec<_> = out.unwrap().disabled.iter().map(|p| format!("{} {} {}", p.a, p.b, p.reason)).collect();
    assert_eq!(
        (pairs, text.as_str()),
        (["l0 l4 Never", "l4 l2 Default", "l4 l3 Default"].map(str::to_owned).to_vec(), "")
    );
}

#[test]
fn what_means_something_else_than_intended_is_a_warning() {
    for (body, what) in [
        ("<group name='a'/><group name='a'/>", "two groups are named `a`: the first one counts"),
        (
            "<group name='a'/><group_state name='h' group='a'/><group_state name='h' group='a'/>",
            "two poses of the group `a` are named `h`",
        ),
        ("<group name='a'><group name='a'/></group>", "the group `a` contains itself"),
        (
            "<group name='a'><group name='b'/></group><group name='b'><group name='a'/></group>",
            "its subgroup `b` leads back to it",
        ),
        ("<disable_colisions link1='l0' link2='l1'/>", "did you mean `disable_collisions`?"),
        ("<group name='a'><joints name='j1'/></group>", "the element `joints` is unknown"),
    ] {
        let (out, text) = semantics(body);
        assert!(out.is_some() && text.contains(what) && !text.contains("error"), "{what}\n{text}");
    }
    let (_, text) =
        semantics("<disable_collisions link1='l0' link2='l1'/>\n<disable_collisions link1='l0' link2='x'/>");
    assert!(text.contains("1 pair of `disable_collisions`") && text.contains("t.srdf:2:2"), "{text}");
    let mut tree = Tree::new();
    let source = tree.add_source("t.srdf", "<robot name='other'/>");
    let document = xml::parse(&mut tree, source).unwrap();
    read(&document.root, &robot(), &mut tree, &Calls::default());
    assert!(tree.diags()[0].message.contains("is for the robot `other`; the description is of `t`"));
}

#[test]
fn wrong_names_are_found() {
    for (body, what) in [
        ("<group name='a'><joint name='j9'/></group>", "this robot has no joint `j9`"),
        ("<group name='a'><chain base_link='l2' tip_link='l0'/></group>", "is not below"),
        ("<group_state name='h' group='b'/>", "unknown group `b`"),
        (
            "<group name='a'/><group_state name='h' group='a'><joint name='j1' value='x'/></group_state>",
            "is not a joint position",
        ),
        ("<group/>", "this `group` has no `name`"),
    ] {
        let (_, text) = semantics(body);
        assert!(text.contains(what), "{what}\n{text}");
    }
}
