//! `dimos demo` as a newcomer has it: what it prints works as printed.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};

use dimos::rpc::api::World;
use rustix::process::Signal;

use crate::support::program::{Home, Started};
use crate::support::terminal::Terminal;

const UP: &str = "Press Ctrl-C for a controlled stop.";

fn demo(home: &Home) -> Started {
    let demo = home.start("demo");
    demo.until(UP);
    demo
}

/// The commands that it prints, without what they show.
fn tries(said: &str) -> Vec<String> {
    let commands = said.lines().filter_map(|line| line.strip_prefix("  dimos "));
    commands.map(|line| line.split("  ").next().unwrap().trim().to_owned()).collect()
}

/// Where the part is in the planner's world [m].
fn part(home: &Home) -> [f64; 3] {
    let objects = home.client().call(World {}).unwrap().objects;
    let part = objects.into_iter().find(|object| object.name == "part").unwrap();
    assert_eq!(part.held_by, None);
    part.pose.xyz
}

#[test]
fn the_three_things_work_as_printed_and_nothing_moves_before() {
    let home = Home::new();
    let demo = demo(&home);
    let positions = |arm: &str| home.positions(arm);
    let before = ["left", "right"].map(positions);
    let said = demo.err();
    assert!(said.contains("run demo  SIMULATED") && demo.out().is_empty(), "{said}");
    let tries = tries(&said);
    let [job, top, reach] = &tries[..] else { panic!("{said}") };
    std::thread::sleep(std::time::Duration::from_millis(300));
    for (now, then) in ["left", "right"].map(positions).iter().flatten().zip(before.iter().flatten()) {
        assert!((now - then).abs() < 1e-6, "nothing moves before it is asked to");
    }

    // The job moves both arms, and leaves the part where it was.
    let at = part(&home);
    let over = AtomicBool::new(false);
    let travelled = std::thread::scope(|scope| {
        let watching = scope.spawn(|| {
            let mut most = [0.0_f64; 2];
            while !over.load(Ordering::Relaxed) {
                for ((most, arm), then) in most.iter_mut().zip(["left", "right"]).zip(&before) {
                    let moved = positions(arm).iter().zip(then).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    *most = most.max(moved);
                }
                std::thread::sleep(std::time::Duration::from_millis(20));
            }
            most
        });
        // Longer than other verbs take.
        let ended = home.as_typed(job).output().unwrap();
        over.store(true, Ordering::Relaxed);
        assert!(ended.status.success(), "{job}: {}", String::from_utf8_lossy(&ended.stderr));
        watching.join().unwrap()
    });
    assert!(travelled.iter().all(|moved| *moved > 0.5), "{travelled:?}");
    let distance: f64 = part(&home).iter().zip(at).map(|(now, then)| (now - then).powi(2)).sum::<f64>().sqrt();
    assert!(distance < 0.005, "the part is {distance:.4} m from where it was");

    let terminal = Terminal::new(80, 24);
    let watched = terminal.start(&home, top);
    terminal.until("run demo");
    terminal.keys("q");
    watched.wait().with(0);

    home.dimos(reach).with(0).shows(&["COMPLETED"]);
    demo.end(Signal::INT).with(130).says(&["run demo ended; log: "]);
}

#[test]
fn the_page_is_served_and_a_second_demo_says_how_to_end_the_first() {
    let home = Home::new();
    let first = demo(&home);
    let address = first.err().split("http://").nth(1).unwrap().split('/').next().unwrap().to_owned();
    let mut page = TcpStream::connect(&address).unwrap();
    page.write_all(format!("GET / HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").as_bytes()).unwrap();
    let mut answer = Vec::new();
    page.read_to_end(&mut answer).unwrap();
    assert!(answer.starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&answer));

    let said = ["already", &first.pid().to_string(), "dimos down demo", "  dimos do builtin:demo  "];
    home.dimos("demo").with(0).says(&said);
    assert_eq!(home.dimos("demo --json").with(0).json()["pid"], first.pid());
    // Beside another run the commands name the demo.
    let other = home.run("coordinator-mock --no-record");
    let tries = tries(&home.dimos("demo").with(0).err);
    assert!(tries.len() == 3 && tries.iter().all(|command| command.ends_with(" --run demo")), "{tries:?}");
    home.dimos(&tries[2]).with(0);
    other.end(Signal::TERM).with(143);
    home.dimos("down demo").with(0);
    first.wait().with(0);
}

#[test]
fn on_a_terminal_the_url_has_its_token_and_ctrl_c_ends_it() {
    let (home, terminal) = (Home::new(), Terminal::new(100, 40));
    let demo = terminal.start(&home, "demo");
    terminal.until(UP);
    let text = terminal.text();
    let url = text.split("http://").nth(1).unwrap().split_whitespace().next().unwrap();
    assert_eq!(home.dimos("view").with(0).out.trim(), format!("http://{url}"), "{text}");
    terminal.keys("\x03");
    demo.wait().with(130);
}

#[test]
fn it_is_the_cell_of_the_program_whatever_is_in_the_folder() {
    let home = Home::new();
    std::fs::create_dir(home.path().join("blueprints")).unwrap();
    let other = "hardware: [{hardware_id: arm, joints: {prefix: arm, count: 2}, adapter_type: mock}]";
    home.write("blueprints/demo.yaml", other);
    let run = home.run("demo --no-record");
    // A run that bears the name is no demo.
    home.dimos("demo").with(1).says(&["run", "demo", "hint: "]);
    run.end(Signal::TERM).with(143);
    let first = demo(&home);
    assert_eq!(home.status()["arms"].as_array().unwrap().len(), 2);
    home.write("job.yaml", &home.dimos("demo --job").with(0).out);
    home.dimos("do job.yaml --check").with(0).shows(&["no mistakes"]);
    first.end(Signal::TERM).with(143);
}

#[test]
fn a_run_ends_with_the_process_that_it_was_to_end_with() {
    let home = Home::new();
    let mut other = Command::new("sleep").arg("60").spawn().unwrap();
    let pid = other.id();
    let run = home.run(&format!("coordinator-mock --no-record --end-with {pid}"));
    other.kill().unwrap();
    // It ends before anybody collects the exit status of that process.
    run.wait().with(0).says(&["the process of --end-with has ended: decelerating to rest"]);
    other.wait().unwrap();
    home.dimos(&format!("run coordinator-mock --end-with {pid}")).with(2).says(&["no process", "hint: "]);
}
