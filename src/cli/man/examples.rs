//! Examples of the manual pages, for verbs whose help has none.

/// Verbs as typed, and examples of each.
pub(super) const OF_VERBS: &[(&str, &[&str])] = &[
    ("run", &["dimos run coordinator-yourarm", "dimos run xarm6-planner --address arm=192.168.1.185 -d"]),
    ("demo", &["dimos demo", "dimos demo --job > job.yaml"]),
    ("new", &["dimos new", "dimos new my-cell --arm xarm6 --address 192.168.1.185"]),
    ("top", &["dimos top", "dimos top --once"]),
    ("status", &["dimos status", "dimos status -v", "dimos status coordinator-yourarm --json"]),
    ("state", &["dimos state", "dimos state --watch"]),
    ("execute", &["dimos execute", "dimos execute trajectory.csv"]),
    ("preview", &["dimos preview", "dimos preview --out plan.json"]),
    ("world", &["dimos world add table --box 1 1 0.05 --at 0.5 0 -0.03", "dimos world list"]),
    ("world list", &["dimos world list", "dimos world list --json"]),
    (
        "world add",
        &[
            "dimos world add table --box 1 1 0.05 --at 0.5 0 -0.03",
            "dimos world add cup --mesh cup.stl --at 0.4 0.1 0.05",
        ],
    ),
    ("world move", &["dimos world move cup --at 0.4 -0.1 0.05 --rpy 0 0 1.57"]),
    ("world remove", &["dimos world remove cup", "dimos world remove --all"]),
    ("world load", &["dimos world load cell.yaml"]),
    ("world attach", &["dimos world attach cup arm --mass 0.3"]),
    ("world detach", &["dimos world detach cup"]),
    ("do", &["dimos do pick.yaml --check", "dimos do pick.yaml"]),
    ("cancel", &["dimos cancel", "dimos cancel --task traj_arm"]),
    ("speed", &["dimos speed", "dimos speed 30%"]),
    ("pause", &["dimos pause"]),
    ("resume", &["dimos resume"]),
    ("stop", &["dimos stop", "dimos stop left"]),
    ("arm", &["dimos arm reset arm", "dimos arm enable arm", "dimos arm gripper arm close"]),
    ("arm enable", &["dimos arm enable arm"]),
    ("arm disable", &["dimos arm disable arm", "dimos arm disable arm --now"]),
    ("arm reset", &["dimos arm reset arm"]),
    ("arm full-speed", &["dimos arm full-speed arm"]),
    ("arm io", &["dimos arm io arm", "dimos arm io arm --set do0=1"]),
    ("arm payload", &["dimos arm payload arm --mass 0.8 --center 0 0 0.06", "dimos arm payload arm --identify"]),
    ("arm tare", &["dimos arm tare arm"]),
    ("arm tool", &["dimos arm tool arm", "dimos arm tool arm --xyz 0 0 0.12"]),
    ("arm find-port", &["dimos arm find-port", "dimos arm find-port --ask so101"]),
    ("arm setup-motors", &["dimos arm setup-motors so101 --address /dev/ttyACM0"]),
    ("arm configure", &["dimos arm configure so101 --address /dev/ttyACM0"]),
    ("arm calibrate", &["dimos arm calibrate so101 --address /dev/ttyACM0 --file left.json"]),
    ("adapter replay", &["dimos adapter replay ur5e.day", "dimos adapter replay ur5e.day --json"]),
    ("pose", &["dimos pose save above", "dimos pose list", "dimos move arm --named above"]),
    ("pose save", &["dimos pose save above", "dimos pose save above arm"]),
    ("pose list", &["dimos pose list"]),
    ("pose remove", &["dimos pose remove above"]),
    ("jog", &["dimos jog arm"]),
    ("task", &["dimos task list"]),
    ("task list", &["dimos task list", "dimos task list --json"]),
    ("task invoke", &["dimos task invoke follow_leader start"]),
    ("task stream", &["dimos task stream servo_arm targets.csv --hz 100"]),
    ("proxy", &["dimos proxy xarm arm"]),
    ("proxy xarm", &["dimos proxy xarm arm"]),
    ("view", &["dimos view", "dimos view log.mcap", "dimos view builtin:yourarm"]),
    ("share", &["dimos share --listen tls/0.0.0.0:7447"]),
    ("down", &["dimos down", "dimos down coordinator-yourarm"]),
    ("logs", &["dimos logs -f"]),
    ("log", &["dimos log list", "dimos log info --last", "dimos log verify log.mcap"]),
    ("log list", &["dimos log list"]),
    ("log info", &["dimos log info --last", "dimos log info log.mcap --json"]),
    ("log cat", &["dimos log cat log.mcap --topics /joint_states"]),
    ("log doctor", &["dimos log doctor log.mcap"]),
    ("log recover", &["dimos log recover log.mcap --output whole.mcap"]),
    ("log cut", &["dimos log cut log.mcap --from 10s --to 25s --output part.mcap"]),
    ("log verify", &["dimos log verify --last", "dimos log verify log.mcap"]),
    ("log export", &["dimos log export log.mcap --output table.csv"]),
    ("log plot", &["dimos log plot log.mcap --joint arm_joint2 --output joint2.svg"]),
    ("log what-if", &["dimos log what-if log.mcap --set arms.arm.velocity_max=0.5"]),
    ("replay", &["dimos replay --last", "dimos replay log.mcap --rate 4"]),
    ("adapter", &["dimos adapter new servobot --dof 6 --transport serial", "dimos adapter test servobot"]),
    ("adapter test", &["dimos adapter test xarm", "dimos adapter test xarm --address 192.168.1.185"]),
    ("adapter emulate", &["dimos adapter emulate xarm"]),
    ("list-adapters", &["dimos list-adapters", "dimos list-adapters --json"]),
    ("list-blueprints", &["dimos list-blueprints"]),
    ("check", &["dimos check cell.yaml", "dimos check xarm6-planner --set coordinator.tick_rate=250"]),
    ("schema", &["dimos schema > blueprint.schema.json"]),
    ("model", &["dimos model info robot.urdf", "dimos model ik builtin:yourarm --pose 0.3 0 0.4"]),
    ("model info", &["dimos model info robot.urdf", "dimos model info robot.urdf.xacro --xacro-arg prefix:=left_"]),
    ("model tree", &["dimos model tree robot.urdf"]),
    ("model check", &["dimos model check robot.urdf --package robot_description=."]),
    ("model expand", &["dimos model expand robot.urdf.xacro --xacro-arg dof:=7"]),
    ("model fk", &["dimos model fk builtin:yourarm 0.3 -0.2 0.5 0 0.4 0"]),
    ("model ik", &["dimos model ik builtin:yourarm --pose 0.3 0 0.4 --rpy 3.14 0 0"]),
    ("model collide", &["dimos model collide builtin:yourarm 0.3 -0.2 0.5 0 0.4 0"]),
    ("model assets", &["dimos model assets list fr3-planner"]),
    ("model assets list", &["dimos model assets list fr3-planner"]),
    ("model assets fetch", &["dimos model assets fetch fr3-planner"]),
    ("model assets clean", &["dimos model assets clean fr3-planner"]),
    ("doctor", &["dimos doctor"]),
    ("completions", &["dimos completions bash > ~/.local/share/bash-completion/completions/dimos"]),
    ("man", &["dimos man --dir ~/.local/share/man/man1"]),
];

#[cfg(test)]
mod tests {
    use super::*;

    /// Without a redirection, which the shell reads.
    fn words(example: &str) -> impl Iterator<Item = &str> {
        example.split(" > ").next().unwrap_or_default().split(' ')
    }

    #[test]
    fn the_examples_are_what_the_program_reads() {
        let mut wrong = Vec::new();
        for (verb, examples) in OF_VERBS {
            assert!(examples[0].starts_with(&format!("dimos {verb}")), "{verb}");
            for example in *examples {
                let read = crate::cli::command().try_get_matches_from(words(example));
                wrong.extend(read.err().map(|error| format!("{example}: {error}")));
            }
        }
        assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    }
}
