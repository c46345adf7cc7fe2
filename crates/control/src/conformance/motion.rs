//! Checks of the motion between a target and the task's end.

use super::{Bench, Check};

pub const CHECKS: &[Check] = &[
    Check::new("moves", "With targets it moves the arm, and no command of it is refused.", moves),
    Check::new("claims_its_joints_once", "It claims finite values, for joints of its own, each once a tick.", claims),
    Check::new("goes_on_after_lost_ticks", "Ticks that were skipped make no jump.", lost_ticks),
];

/// Less than this is no motion [rad].
const MOTION: f64 = 1e-3;

fn moves(bench: &mut Bench) -> Result<(), String> {
    bench.stream(1.5)?;
    if let Some(fault) = bench.fault() {
        return Err(fault);
    }
    if bench.moved() < MOTION {
        return Err(format!("it moved no joint by more than {:.6} rad in 1.5 s", bench.moved()));
    }
    Ok(())
}

fn claims(bench: &mut Bench) -> Result<(), String> {
    let mut seen = 0;
    for _ in 0..100 {
        bench.stream(0.01)?;
        let task = bench.task()?;
        for (k, claim) in task.claims.iter().enumerate() {
            let joint = claim.joint;
            if !task.joints.contains(&joint) {
                return Err(format!("it claims joint {joint}, which is not its own"));
            }
            if task.claims.iter().take(k).any(|other| other.joint == joint) {
                return Err(format!("it claims joint {joint} twice in a tick"));
            }
            if !claim.value.is_finite() {
                return Err(format!("it claims {} for joint {joint}", claim.value));
            }
            if task.compliance(joint).is_some_and(|compliance| !compliance.is_finite()) {
                return Err(format!("the compliance of joint {joint} is not finite: {:?}", task.compliance(joint)));
            }
            seen += 1;
        }
    }
    if let Some(fault) = bench.fault() {
        return Err(fault);
    }
    if seen == 0 { Err("it claimed nothing in 1 s of targets".to_owned()) } else { Ok(()) }
}

fn lost_ticks(bench: &mut Bench) -> Result<(), String> {
    for skipped in [1, 3, 5] {
        bench.stream(0.3)?;
        bench.tick(skipped);
        bench.stream(0.3)?;
    }
    bench.fault().map_or(Ok(()), Err)
}
