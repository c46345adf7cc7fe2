//! A log in several files of which one is missing, empty or no log: every verb says so, and no arm follows the rest.

use std::path::PathBuf;

use rustix::process::Signal;

use crate::support::program::Home;

/// Kind of a chunk record.
const CHUNK: u8 = 0x06;

/// A run whose log has at least four files.
fn recorded() -> (Home, Vec<PathBuf>) {
    let home = Home::new();
    let run = home.run("coordinator-yourarm --set recording.split_after=1 --record x.mcap");
    for _ in 0..3 {
        home.dimos("move arm 0.4 -0.3 0.6 0 0.8 0").with(0);
        home.dimos("move arm 0 -0.3 0.6 0 0.8 0").with(0);
    }
    run.end(Signal::INT).with(130);
    let parts: Vec<PathBuf> =
        (1..).map(|n| home.path().join(format!("x_{n}.mcap"))).take_while(|p| p.exists()).collect();
    assert!(parts.len() >= 3, "{parts:?}");
    (home, parts)
}

/// Checks that every verb says what is missing; the files are named by the first or by their folder.
fn judge(home: &Home, says: &str) {
    for log in ["x.mcap", "set"] {
        home.dimos(&format!("log info {log}")).with(5).says(&[says]);
        home.dimos(&format!("log doctor {log}")).with(5).shows(&[says, "not whole"]);
        home.dimos(&format!("log verify {log}")).with(5).says(&[says]);
        home.dimos(&format!("log what-if {log} --set rate=90")).with(5).says(&[says]);
        home.dimos(&format!("replay {log} --rate 1000000 --json")).with(5).says(&[says]);
        for verb in ["cat", "export -o a.csv", "export --rosbag2 bag", "plot -o a.svg", "cut -o a.mcap"] {
            home.dimos(&format!("log {verb} {log}")).with(5).says(&[says]);
        }
        ["a.csv", "a.mcap"].iter().for_each(|file| std::fs::remove_file(home.path().join(file)).unwrap());
        std::fs::remove_dir_all(home.path().join("bag")).unwrap();
        let onto = home.dimos(&format!("replay {log} --onto coordinator-yourarm --no-record"));
        onto.with(5).says(&[says, "nothing has moved"]);
    }
}

/// Puts the files into a folder, too.
fn collect(home: &Home) {
    let set = home.path().join("set");
    let _ = std::fs::remove_dir_all(&set);
    std::fs::create_dir(&set).unwrap();
    let logs = std::fs::read_dir(home.path()).unwrap().map(|entry| entry.unwrap().path());
    for log in logs.filter(|path| path.extension().is_some_and(|ending| ending == "mcap")) {
        std::fs::copy(&log, set.join(log.file_name().unwrap())).unwrap();
    }
}

#[test]
fn a_log_without_one_of_its_files_is_not_whole() {
    let (home, parts) = recorded();
    collect(&home);
    for log in ["x.mcap", "set"] {
        home.dimos(&format!("log info {log}")).with(0).shows(&["complete"]);
        home.dimos(&format!("log verify {log}")).with(0).shows(&["reproducible"]);
    }
    let (middle, last) = (&parts[0], parts.last().unwrap());
    let bytes = std::fs::read(middle).unwrap();
    for (contents, says) in [
        (None, "x_1.mcap is missing: the log continues in x_2.mcap".to_owned()),
        (Some(&b""[..]), "x_1.mcap is empty".to_owned()),
        (Some(&b"this is no log"[..]), "x_1.mcap is not an MCAP file".to_owned()),
    ] {
        match contents {
            None => std::fs::remove_file(middle).unwrap(),
            Some(contents) => std::fs::write(middle, contents).unwrap(),
        }
        collect(&home);
        judge(&home, &says);
    }
    // What is before it is whole.
    home.dimos("log cut x.mcap --to 0.5 -o part.mcap").with(0);
    std::fs::remove_file(home.path().join("part.mcap")).unwrap();
    std::fs::write(middle, &bytes).unwrap();
    // The file before the last one names it.
    let end = std::fs::read(last).unwrap();
    std::fs::remove_file(last).unwrap();
    collect(&home);
    judge(&home, &format!("{} is missing", last.file_name().unwrap().display()));
    std::fs::write(last, end).unwrap();
    // Of a folder, the first one may be missing, too.
    collect(&home);
    std::fs::remove_file(home.path().join("set/x.mcap")).unwrap();
    home.dimos("log info set").with(5).says(&["x.mcap is missing: the log continues in x_1.mcap"]);
}

#[test]
fn the_list_says_which_logs_are_damaged() {
    let home = Home::new();
    let run = home.run("coordinator-yourarm --set recording.split_after=1");
    std::thread::sleep(std::time::Duration::from_secs(3));
    run.end(Signal::INT).with(130);
    let state = || home.dimos("log list --json").with(0).json()[0]["state"].as_str().unwrap().to_owned();
    assert_eq!(state(), "complete");
    let logs = home.logs();
    let (first, second) = (std::fs::read(&logs[0]).unwrap(), std::fs::read(&logs[1]).unwrap());
    // A byte in the middle of the largest chunk.
    let (mut at, mut chunks) = (8, Vec::new());
    while let Some(length) = first.get(at + 1..at + 9) {
        let length = u64::from_le_bytes(length.try_into().unwrap()) as usize;
        chunks.extend((first[at] == CHUNK).then_some((length, at + 9 + length / 2)));
        at += 9 + length;
    }
    let mut flipped = first.clone();
    flipped[chunks.iter().max().unwrap().1] ^= 0x55;
    std::fs::write(&logs[0], flipped).unwrap();
    assert_eq!(state(), "damaged");
    std::fs::write(&logs[0], &first).unwrap();
    std::fs::remove_file(&logs[1]).unwrap();
    assert_eq!(state(), "damaged");
    std::fs::write(&logs[1], second).unwrap();
    assert_eq!(state(), "complete");
}
