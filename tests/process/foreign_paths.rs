//! `--path` with logs of other programs, and `--onto` with damaged ones: an arm follows the whole motion of one
//! publisher, or nothing.

use rustix::process::Signal;
use serde_json::json;

use crate::foreign_logs::{made, place};
use crate::support::program::Home;

#[test]
fn only_the_whole_motion_of_one_publisher_is_followed() {
    let Some((home, _)) = made() else { return };
    let run = home.run("yourarm-planner");
    home.dimos("move arm 0 -0.3 0.6 0 0.8 0").with(0);
    let follow = |kind: &str| home.dimos(&format!("plan arm --path {}", place(&home, kind)));
    let whole = follow("plain").with(0).err.clone();
    let waypoints = |said: &str| {
        said.lines().find(|line| line.contains("waypoints")).unwrap().split_once(':').unwrap().1.to_owned()
    };
    for kind in [
        "lz4",
        "raw",
        "no_chunks",
        "out_of_order",
        "out_of_order_no_chunks",
        "other_order",
        "split",
        "index_000",
        "restarted",
        "wrong_map",
    ] {
        assert_eq!(waypoints(&follow(kind).with(0).err), waypoints(&whole), "{kind}");
    }
    let others = follow("other_joints").with(0).says(&["left out 200 messages of wheel0, wheel1"]).err;
    assert_eq!(waypoints(&others), waypoints(&whole));
    follow("growing").with(0).says(&["left out 5 messages of arm_joint1, arm_joint2, arm_joint3"]);
    for (kind, code, says) in [
        ("in_parts", 2, "no message has all joints (arm_joint1, arm_joint2, arm_joint3"),
        ("two_publishers", 2, "within 1 ms: two publishers write /joint_states"),
        ("slow_publishers", 2, "two publishers write /joint_states"),
        ("uneven_publishers", 2, "two publishers write /joint_states"),
        ("two_channels", 2, "two publishers write /joint_states in turn"),
        ("joint_twice", 2, "has arm_joint3 twice"),
        ("whole_turn", 2, "a whole turn"),
        ("gap", 5, "while nothing was recorded for 5.0 s"),
        ("elsewhere", 2, "joint states are on /robot/joint_states"),
        ("chunk_crc", 5, "dimos log cut in/chunk_crc.mcap --to 0.5"),
        ("first_crc", 5, "dimos log recover"),
        ("flipped", 5, "nothing has moved"),
        ("broken", 5, "nothing has moved"),
        ("length", 5, "nothing has moved"),
        ("cut", 5, "it ends at byte"),
        ("bad_message", 5, "nothing has moved"),
        ("split_missing", 5, "split_missing_2.mcap"),
        ("split_empty", 5, "is empty"),
        ("partly", 5, "nothing has moved"),
        ("swallowed", 5, "nothing has moved"),
        ("hidden", 5, "19 of 200 messages are missing"),
        ("unrelated", 2, "several logs"),
    ] {
        follow(kind).with(code).says(&[says, "hint: "]);
    }
    // The part before the damage, as the hint says.
    home.dimos("log cut in/chunk_crc.mcap --to 0.5 -o part.mcap").with(0);
    home.dimos("plan arm --path part.mcap").with(0);
    // A table whose rows are not in order of time.
    let rows: Vec<String> =
        (0..100).map(|k| format!("{},{},-0.3,0.6,0,0.8,0", f64::from(k) * 0.02, f64::from(k) * 0.002)).collect();
    let heading = "time,arm_joint1,arm_joint2,arm_joint3,arm_joint4,arm_joint5,arm_joint6";
    home.write("a.csv", &format!("{heading}\n{}\n", rows.join("\n")));
    let ordered = waypoints(&home.dimos("plan arm --path a.csv").with(0).err);
    let turned: Vec<String> = rows.iter().skip(50).chain(&rows[..50]).cloned().collect();
    home.write("b.csv", &format!("{heading}\n{}\n", turned.join("\n")));
    let said = home.dimos("plan arm --path b.csv").with(0).says(&["the rows were not in order of time"]).err;
    assert_eq!(waypoints(&said), ordered);
    // A jump in a table is no motion, and names twice are no table.
    let mut jumping = rows.clone();
    jumping[50] = format!("1.0,{},-0.3,0.6,0,0.8,0", 1.6);
    home.write("jump.csv", &format!("{heading}\n{}\n", jumping.join("\n")));
    let point = |time: f64, q: f64| json!({"time_from_start": time, "positions": [q, -0.3, 0.6, 0.0, 0.8, 0.0]});
    let names: Vec<String> = (1..=6).map(|i| format!("arm_joint{i}")).collect();
    let points = |list: &[(f64, f64)]| list.iter().map(|(time, q)| point(*time, *q)).collect::<Vec<_>>();
    let table =
        |names: &[String], list: &[(f64, f64)]| json!({"joint_names": names, "points": points(list)}).to_string();
    home.write("jump.json", &table(&names, &[(0.0, 0.0), (0.02, 0.9), (0.04, 0.91)]));
    home.write("turns.json", &table(&names, &[(0.0, 0.0), (0.05, 0.3), (0.1, 0.0), (0.15, 0.3), (0.2, 0.0)]));
    for (file, says) in
        [("jump.csv", "no joint is faster"), ("jump.json", "no joint is faster"), ("turns.json", "twice")]
    {
        home.dimos(&format!("plan arm --path {file}")).with(2).says(&["arm_joint1 goes from", says, "hint: "]);
    }
    home.write("slow.json", &format!("\u{feff}{}", table(&names, &[(0.0, 0.0), (1.0, 0.3), (2.0, 0.0), (3.0, 0.3)])));
    home.dimos("plan arm --path slow.json").with(0);
    let twice: Vec<String> = names.iter().take(5).chain(&names[..1]).cloned().collect();
    home.write("twice.json", &table(&twice, &[(0.0, 0.0), (1.0, 0.3)]));
    home.dimos("plan arm --path twice.json").with(2).says(&["no joint arm_joint6"]);
    let seven: Vec<String> = names.iter().chain(&names[..1]).cloned().collect();
    home.write("seven.json", &table(&seven, &[(0.0, 0.0), (1.0, 0.3)]));
    home.dimos("plan arm --path seven.json").with(2).says(&["joint_names has arm_joint1 twice"]);
    run.end(Signal::INT).with(130);
}

#[test]
fn half_of_a_motion_is_not_followed() {
    const CHUNK: u8 = 0x06;
    for compression in ["zstd", "none"] {
        let home = Home::new();
        let run = home.run(&format!("coordinator-yourarm --set recording.compression={compression}"));
        home.dimos("move arm 0.2 -0.3 0.6 0 0.8 0").with(0);
        home.dimos("move arm 0 -0.3 0.6 0 0.8 0").with(0);
        run.end(Signal::INT).with(130);
        let whole = std::fs::read(&home.logs()[0]).unwrap();
        let (mut at, mut chunks) = (8, Vec::new());
        while let Some(length) = whole.get(at + 1..at + 9) {
            let length = u64::from_le_bytes(length.try_into().unwrap()) as usize;
            if whole[at] == CHUNK {
                chunks.push(at + 9 + length / 2);
            }
            at += 9 + length;
        }
        let mut damaged = whole.clone();
        let middle = chunks[chunks.len() / 2];
        damaged[middle] ^= 0x55;
        std::fs::write(home.path().join("damaged.mcap"), &damaged).unwrap();
        std::fs::write(home.path().join("cut.mcap"), &whole[..middle]).unwrap();
        for (log, why) in [("damaged", "damaged at byte"), ("cut", "it ends at byte")] {
            let onto = home.dimos(&format!("replay {log}.mcap --onto coordinator-yourarm --no-record"));
            onto.with(5).says(&[why, "nothing has moved", "hint: "]);
            home.dimos(&format!("log verify {log}.mcap")).with(5);
            home.dimos(&format!("log info {log}.mcap")).with(5).shows(&[log]).says(&[why]);
            for verb in ["export -o a.csv", "plot -o a.svg", "recover -o a.mcap", "cat"] {
                home.dimos(&format!("log {verb} {log}.mcap")).with(5).says(&[why]);
            }
            ["a.csv", "a.mcap"].iter().for_each(|file| std::fs::remove_file(home.path().join(file)).unwrap());
        }
        let followed = home.dimos("replay --last --onto coordinator-yourarm --no-record").with(0);
        followed.shows(&["COMPLETED"]);
        // An attachment that is damaged is named.
        let name = whole.windows(16).position(|bytes| bytes == b"coordinator.json").unwrap();
        let mut damaged = whole.clone();
        damaged[name + 200] ^= 0x01;
        std::fs::write(home.path().join("damaged.mcap"), &damaged).unwrap();
        home.dimos("replay damaged.mcap --onto coordinator-yourarm")
            .with(2)
            .says(&["its coordinator.json is damaged (byte"]);
    }
}
