//! Replays each target's seeds, its corpus, and small changes of both, without an engine: the same every time.

use std::panic::{AssertUnwindSafe, catch_unwind};

use dimos_fuzz::{TARGETS, Target};

/// Changes of each input.
const CHANGES: usize = 24;

/// Changes an input a little.
fn changed(input: &[u8], state: &mut u64) -> Vec<u8> {
    let mut random = |most: usize| {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 33) as usize % most.max(1)
    };
    let mut out = input.to_vec();
    for _ in 0..=random(3) {
        let at = random(out.len());
        match random(5) {
            0 if !out.is_empty() => out[at] ^= 1 << random(8),
            1 if !out.is_empty() => drop(out.remove(at)),
            2 => out.insert(at, random(256) as u8),
            3 => out.truncate(at),
            _ => {
                let end = (at + 1 + random(16)).min(out.len());
                let part = out[at.min(end)..end].to_vec();
                out.splice(at..at, part);
            }
        }
    }
    out
}

fn replay(name: &str) {
    let target: &Target = Target::named(name).unwrap();
    let inputs: Vec<Vec<u8>> = (target.seeds)().into_iter().chain(target.kept()).collect();
    assert!(!inputs.is_empty(), "{name} has no seeds");
    let mut state = 1;
    let mut tried = 0;
    for input in &inputs {
        let changes: Vec<Vec<u8>> = (0..CHANGES).map(|_| changed(input, &mut state)).collect();
        for data in [input.clone()].iter().chain(&changes) {
            tried += 1;
            if let Err(panic) = catch_unwind(AssertUnwindSafe(|| (target.run)(data))) {
                let file = std::env::temp_dir().join(format!("dimos-fuzz-{name}"));
                std::fs::write(&file, data).unwrap();
                println!("{name}: {} bytes, in {}", data.len(), file.display());
                std::panic::resume_unwind(panic);
            }
        }
    }
    println!("{name}: {tried} inputs");
}

macro_rules! replays {
    ($($name:ident)*) => {
        $(#[test]
        fn $name() {
            replay(stringify!($name));
        })*

        #[test]
        fn no_target_is_left_out() {
            let names: Vec<&str> = TARGETS.iter().map(|target| target.name).collect();
            assert_eq!(names, [$(stringify!($name)),*]);
        }
    };
}

replays! {
    blueprint calibration options report urdf xacro srdf mesh points mcap cdr schema request reply decoder controller http
    websocket trajectory timing curve requests frames
}
