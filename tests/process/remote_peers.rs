//! `adapter_type: remote` with peers that do not speak its protocol correctly: each ends the start with one error.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::Duration;

use dimos::recording::replay::attachment;

use super::remote_shim::BLUEPRINT;
use crate::support::program::Home;

const DESCRIPTION: &str = r#"{"id":1,"version":1,"dof":6,"native_rate":100,"info":{"vendor":"V","model":"M"},
 "limits":{"position_lower":[-1,-1,-1,-1,-1,-1],"position_upper":[1,1,1,1,1,1],"velocity_max":[1,1,1,1,1,1]}}"#;

/// A peer that answers the first request with the first of `replies`, and so on, and then nothing more; it remembers
/// what it was asked.
fn peer(replies: Vec<String>) -> (String, std::thread::JoinHandle<Vec<String>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let thread = std::thread::spawn(move || {
        let (mut stream, _): (TcpStream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        let mut asked = Vec::new();
        let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
        for reply in replies {
            asked.extend(lines.next().and_then(Result::ok));
            let _ = stream.write_all(format!("{}\n", reply.replace('\n', "")).as_bytes());
        }
        asked.extend(lines.map_while(Result::ok));
        let _ = stream.read(&mut [0]);
        asked
    });
    (address, thread)
}

#[test]
fn peers_that_are_something_else_end_the_start_with_one_clear_line() {
    let reading = r#"{"id":2,"state":{"time":1,"read_joint_positions":[0,0,0,0,0]}}"#;
    let cases: &[(&[&str], &str)] = &[
        (&["HTTP/1.1 400 Bad Request"], "does not speak this protocol"),
        (&[r#"{"id":1,"version":3,"dof":6}"#], "speaks version 3 of the protocol, this program versions 1 to 2"),
        (&[&DESCRIPTION.replace("\"dof\":6", "\"dof\":7").replace("1]", "1,1]")], "expected 6 joints, the arm says 7"),
        (&[&DESCRIPTION.replace("\"V\"", "null")], "its description"),
        (&[&DESCRIPTION.replace("[-1,-1,-1,-1,-1,-1]", "[]")], "limits must have 6 values each"),
        (
            &[&DESCRIPTION.replace("\"native_rate\":100", "\"native_rate\":100,\"gap_tolerance\":2")],
            "gap_tolerance must be 0 to 1 s",
        ),
        (
            &[&DESCRIPTION.replace("\"native_rate\":100", "\"native_rate\":100,\"after_gap\":\"waits\"")],
            "its description",
        ),
        (&[r#"{"id":1,"error":"io","text":"no arm there"}"#], "no arm there"),
        (&[], "accepts the connection, but does not say what it is"),
        (&[DESCRIPTION], "did not answer within"),
        (&[DESCRIPTION, reading], "position has 5 values for 6 joints"),
        (&[DESCRIPTION, &reading.replace("0,0]", "0,NaN,0]")], "does not speak this protocol"),
        (&[DESCRIPTION, r#"{"id":2,"error":"io","text":"its bus is down"}"#], "its bus is down"),
    ];
    for (replies, part) in cases {
        let home = Home::new();
        let (address, thread) = peer(replies.iter().map(|r| (*r).to_owned()).collect());
        home.write("remote.yaml", &BLUEPRINT.replace("ADDRESS", &address));
        let ended = home.dimos("run remote.yaml").with(3).says(&["error: arm: ", part, "hint: "]);
        assert_eq!(ended.err.lines().filter(|l| l.starts_with("error: ")).count(), 1, "{}", ended.err);
        assert!(ended.took < Duration::from_secs(5), "{:?}", ended.took);
        let asked = thread.join().unwrap();
        assert!(asked.iter().all(|a| a.contains(r#""do":"hello""#) || a.ends_with(r#""do":"cycle"}"#)), "{asked:?}");
    }
    let home = Home::new();
    home.write("remote.yaml", &BLUEPRINT.replace("ADDRESS", "unix:/nowhere/arm.sock"));
    home.dimos("run remote.yaml").with(3).says(&["there is no such socket", "hint: start the process that serves"]);
    home.write("remote.yaml", &BLUEPRINT.replace("ADDRESS", "10.0.0.1:7450"));
    home.dimos("run remote.yaml").with(2).says(&["no authentication", "ssh -L 7450:127.0.0.1:7450 10.0.0.1"]);
}

/// A gap in its commands is bridged as the arm itself says, not as the row of a remote arm, of which nothing is known.
#[test]
fn an_arm_says_itself_what_gaps_it_bridges() {
    for (option, expected) in [
        ("options: {sim: {controller: {gap_tolerance: 0.04}}}", (40_000_000, "decelerates")),
        ("options: {}", (0, "rests_at_setpoint")),
    ] {
        let home = Home::new();
        let blueprint = BLUEPRINT
            .replace("'ADDRESS'", "sim")
            .replace("accept_zero_pose: true", &format!("accept_zero_pose: true, {option}"));
        home.write("remote.yaml", &blueprint);
        let run = home.run("remote.yaml");
        home.dimos("down").with(0);
        run.wait().with(0);
        let log = home.logs().pop().unwrap();
        let coordinator = attachment(&log, "coordinator.json").unwrap().unwrap();
        let coordinator: serde_json::Value = serde_json::from_slice(&coordinator).unwrap();
        let supervision = &coordinator["arms"][0]["supervision"];
        assert_eq!(supervision["gap_tolerance"]["nanos"], expected.0, "{supervision:#}");
        assert_eq!(supervision["after_gap"], expected.1, "{supervision:#}");
    }
}
