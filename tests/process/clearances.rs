//! The clearance of a plan is a number, also where it is a hair's breadth.

use crate::support::program::Home;

/// A block that slides along a wall.
const URDF: &str = r#"<robot name="slide">
  <link name="base_link"/>
  <link name="block"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <joint name="x" type="prismatic"><parent link="base_link"/><child link="block"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
</robot>"#;

fn home(gap: f64) -> Home {
    let home = Home::new();
    home.write("slide.urdf", URDF);
    let blueprint = format!(
        "name: slide
hardware:
  - {{hardware_id: arm, joints: [x], adapter_type: mock}}
tasks:
  - {{name: traj_arm, type: trajectory, joint_names: {{hardware: arm}}}}
planner:
  padding: 0
  robots:
    - {{name: arm, model_path: slide.urdf, end_effector_link: block, joint_names: [x], coordinator_task_name: traj_arm}}
  world:
    wall: {{shape: {{box: [3, 0.1, 0.3]}}, pose: {{xyz: [0, {}, 0]}}, padding: 0}}
",
        0.1 + gap
    );
    home.write("slide.yaml", &blueprint);
    home
}

#[test]
fn a_clearance_below_1_mm_is_a_number() {
    // What slides along a wall is the worst case: it is close all the way.
    for (gap, part) in [(8e-4, 0.85), (4.2e-5, 0.3)] {
        let home = home(gap);
        let _run = home.run("slide.yaml --no-record");
        for options in ["", "--level exact"] {
            let planned = home.dimos(&format!("plan arm 0.4 {options} --json")).with(0).json();
            let found = planned["summary"]["clearance"].as_f64().unwrap();
            // By a rounding error it may be more.
            assert!(found <= gap + 1e-9 && found >= part * gap, "{found} m of {gap} m {options}");
        }
        let said = home.dimos("plan arm 0.4").with(0).out;
        assert!(!said.contains("clearance 0.0000 m"), "{said}");
        // Covers overlap where the block is, and where it goes: solids do not.
        let fast = home.dimos("plan arm 0.4 --level fast --json").with(0).json();
        assert_eq!(fast["summary"]["level"], "certified", "{fast}");
        home.dimos("move arm 0.4 --speed 1").with(0);
    }
}
