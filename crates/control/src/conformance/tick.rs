//! Checks of what the real-time thread and a replay rely on.

use super::{Bench, Check};
use crate::request::Request;

pub const CHECKS: &[Check] = &[
    Check::new(
        "allocates_nothing",
        "No tick takes memory from the allocator, whatever happens to the task.",
        allocates,
    ),
    Check::new("repeats_bit_for_bit", "The same inputs give the same commands: logs can be verified.", repeats),
];

/// Everything that may happen to a task.
fn scenario(bench: &mut Bench) -> Result<(), String> {
    bench.stream(1.0)?;
    if let Some(target) = Bench::not_finite(bench.usual()?) {
        bench.ask(target);
    }
    bench.tick(2);
    bench.stream(0.5)?;
    bench.cancel();
    bench.run(1.0);
    bench.stream(0.5)?;
    bench.interfere(0.1);
    bench.stream(0.5)?;
    bench.ask(Request::Stop { arm: None });
    bench.run(1.0);
    bench.enable()?;
    bench.stream(0.5)?;
    bench.run(3.0);
    Ok(())
}

fn allocates(bench: &mut Bench) -> Result<(), String> {
    scenario(bench)?;
    match bench.allocated() {
        0 => Ok(()),
        count => Err(format!("{count} allocations")),
    }
}

fn repeats(bench: &mut Bench) -> Result<(), String> {
    scenario(bench)?;
    let mut second = bench.again()?;
    scenario(&mut second)?;
    let differs = bench.trace().iter().zip(second.trace()).position(|(a, b)| a != b);
    match differs {
        Some(at) => Err(format!("tick {} came out differently", at / dimos_core::joint::MAX_DOF)),
        None => Ok(()),
    }
}
