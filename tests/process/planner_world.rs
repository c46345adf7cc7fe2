//! The planner's world in a run: obstacles that are added, moved and removed, and objects that an arm holds.

use dimos::rpc::Code;
use dimos::rpc::api::{PoseSpec, ShapeSpec, WorldAdd, WorldObject};
use dimos::rpc::client::{Client, ClientError};

use super::planner_run::up;

#[test]
fn the_world_is_changed_while_it_runs() {
    let (home, _run) = up();
    let world = || home.dimos("world list").with(0).out;
    home.write("two.ply", "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n0.1 0 0\n");
    home.write("tetra.obj", "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n");
    for (name, shape) in [
        ("box", "--box 0.1 0.1 0.2"),
        ("ball", "--sphere 0.05"),
        ("can", "--cylinder 0.05 0.3 --padding 0.01"),
        ("mesh", "--mesh tetra.obj"),
        ("cloud", "--cloud two.ply"),
    ] {
        home.dimos(&format!("world add {name} {shape} --at 0.6 0.6 0.6")).with(0);
        assert!(world().contains(name));
        home.dimos(&format!("world move {name} --at 0.6 0.6 0.6 --rpy 0 0 0.785")).with(0);
        assert!(world().contains("0.600 0.600 0.600  0.00 0.00 0.79"), "{}", world());
        // It is really there: the arm's flange cannot be where it is.
        home.dimos(&format!("world move {name} --at 0.38 0.02 0.3")).with(0);
        let hit = home.dimos("plan arm --pose 0.4 0.02 0.3 --rpy 3.14 0 0").with(1);
        assert!(hit.err.contains(&format!("obstacle \"{name}\"")), "{}", hit.err);
        home.dimos(&format!("world move {name} --at -0.6 0.6 0.6")).with(0);
        home.dimos("plan arm --pose 0.4 0.02 0.3 --rpy 3.14 0 0").with(0);
    }
    home.write("no.ply", "hello");
    let refused: &[(&str, i32, &[&str])] = &[
        ("world add a/b --sphere 1 --at 0 0 1", 2, &["name is \"a/b\", must be of letters"]),
        (&format!("world add {} --sphere 1 --at 0 0 1", "a".repeat(65)), 2, &["name has 65 characters"]),
        ("world add tä --sphere 1 --at 0 0 1", 2, &["name is \"tä\", must be of letters"]),
        ("world add bad --sphere -1 --at 0 0 1", 2, &["a size of the shape is -1, must be above 0"]),
        ("world add bad --box 0 1 1 --at 0 0 1", 2, &["a size of the shape is 0"]),
        ("world add bad --sphere 1 --padding -1 --at 0 0 1", 2, &["padding is -1"]),
        ("world add bad --mesh none.stl --at 0 0 1", 2, &["none.stl: "]),
        ("world add bad --cloud no.ply --at 0 0 1", 2, &["no.ply: not a PLY point cloud"]),
        ("world add bad --cloud /dev/zero --at 0 0 1", 2, &["/dev/zero: not a file"]),
        ("world move missing --at 0 0 1", 2, &["UNKNOWN_OBJECT"]),
        ("world remove missing", 2, &["UNKNOWN_OBJECT"]),
        ("world detach box", 1, &["no arm holds box"]),
        ("world attach box amr", 2, &["did you mean `arm`?"]),
        ("world attach box arm --link fingr", 2, &["no link named `fingr`"]),
        ("world attach box arm --touch link9", 2, &["no link named `link9`"]),
    ];
    let before = world();
    refused.iter().for_each(|(arguments, code, words)| drop(home.dimos(arguments).with(*code).says(words)));
    assert_eq!(world(), before, "what is refused changes nothing");
    home.dimos("world remove --all").with(0);
    home.dimos("world list").with(0).says(&["the world is empty"]);
    home.write(
        "kitchen.yaml",
        "shelf: {shape: {box: [0.1, 0.1, 0.1]}, pose: {xyz: [0, 0.5, 0.5]}}\npan: {shape: {mesh: tetra.obj}}\n",
    );
    home.dimos("world load kitchen.yaml").with(0);
    assert!(world().contains("shelf") && world().contains("tetra.obj"));
    home.write("wrong.yaml", "ok: {shape: {sphere: 1}}\nbad: {shape: {box: [0.1, 0.1]}}\n");
    home.dimos("world load wrong.yaml").with(2).says(&["wrong.yaml:2: bad: "]);
    assert!(!world().contains("ok"));
}

#[test]
fn what_an_arm_holds_goes_with_it() {
    let (home, _run) = up();
    // A rod that hangs from the flange.
    home.dimos("plan arm 0.1 -0.3 0.6 0 0.8 0 --json").with(0);
    let at: Vec<f64> = home.dimos("preview --json").with(0).json()["end_effectors"]["arm"][0]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_f64().unwrap())
        .collect();
    home.dimos(&format!("world add rod --cylinder 0.01 0.3 --at {} {} {}", at[0] + 0.02, at[1], at[2] - 0.2)).with(0);
    home.dimos("world attach rod arm --touch link6").with(0);
    for refused in
        ["world attach rod arm", "world move rod --at 0 0 1", "world remove rod", "world add rod --sphere 1 --at 0 0 1"]
    {
        home.dimos(refused).with(1).says(&["arm holds rod", "hint: `dimos world detach rod`"]);
    }
    // It would be put into a block that the arm itself does not come near to.
    let (turn, reach) = (0.8_f64, (at[0] + 0.02).hypot(at[1]));
    let (x, y) = (reach * turn.cos(), reach * turn.sin());
    home.dimos(&format!("world add block --box 0.1 0.1 0.04 --at {x} {y} 0.04")).with(0);
    let rod_hits = ["link \"arm/rod\"", "obstacle \"block\""];
    home.dimos("plan arm 0.8 -0.3 0.6 0 0.8 0").with(1).says(&rod_hits);
    home.dimos("world remove --all").with(0);
    assert!(home.dimos("world list").with(0).out.contains("arm flange"), "what is held is not removed");
    home.dimos("move arm 1.0 -0.3 0.6 0 0.8 0").with(0);
    home.dimos("world detach rod").with(0);
    let world = home.dimos("world list --json").with(0).json();
    let rod = &world["objects"][0];
    assert!(rod["held_by"].is_null(), "{rod}");
    // It was carried about the arm's axis by 1 rad, and stays there.
    let [x, y] = [0, 1].map(|axis| rod["pose"]["xyz"][axis].as_f64().unwrap());
    let (from, to) = ((at[0] + 0.02).hypot(at[1]), x.hypot(y));
    assert!((from - to).abs() < 2e-3 && (y.atan2(x) - at[1].atan2(at[0] + 0.02) - 1.0).abs() < 0.02, "{rod}");
    home.dimos("move arm 0.2 -0.3 0.6 0 0.8 0").with(0);
    let world = home.dimos("world list --json").with(0).json();
    assert_eq!(&world["objects"][0], rod);
    home.dimos("world remove rod").with(0);
}

#[test]
fn the_world_has_at_most_a_thousand_objects() {
    let (home, _run) = up();
    let mut client = home.client();
    let add = |client: &mut Client, name: String| {
        let (shape, pose) = (ShapeSpec::Sphere(0.01), PoseSpec { xyz: [5.0, 0.0, 5.0], ..PoseSpec::default() });
        client.call(WorldAdd(WorldObject { name, shape, pose, padding: 0.0, held_by: None }))
    };
    let before = client.call(dimos::rpc::api::World {}).unwrap().objects.len();
    for n in before..1000 {
        add(&mut client, format!("ball{n}")).unwrap();
    }
    match add(&mut client, "one_more".into()) {
        Err(ClientError::Refused(error)) => assert_eq!(error.code, Code::TooLarge, "{error}"),
        other => panic!("{other:?}"),
    }
    // One of them is replaced, and a place is free after a removal.
    add(&mut client, "ball999".into()).unwrap();
    home.dimos("world remove ball999").with(0);
    add(&mut client, "one_more".into()).unwrap();
    let world: String = (0..1001).map(|n| format!("    ball{n}: {{shape: {{sphere: 0.01}}}}\n")).collect();
    home.write("full.yaml", &format!("include: [lab.yaml]\nplanner:\n  world:\n{world}"));
    home.dimos("check full.yaml").with(2).says(&["(limit 1000)", "full.yaml:1003", "hint: "]);
}
