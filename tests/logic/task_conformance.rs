//! Every row of the task table against the conformance suite, and tasks that are wrong in one way each with the check
//! that says so. A new row needs no further line here.

use std::sync::atomic::{AtomicU64, Ordering};

use dimos::control::conformance::{checks, run};
use dimos::control::task_body::{Claim, Context, OnCancel, OnLoss, Step, Target, TaskBody};
use dimos::control::task_spec::{BuildError, TaskSetup, TaskSpec, TaskTable};
use dimos::control::tasks::{cartesian, velocity};
use dimos::telemetry::Outcome;

use dimos::rt::counting::allocations;

/// What is wrong with a row, check by check.
pub fn failures(row: &TaskSpec) -> Vec<(&'static str, String)> {
    let failed = checks().filter_map(|check| Some((check.name, run(row, check, Some(allocations)).err()?)));
    failed.collect()
}

#[test]
fn every_task_conforms() {
    let table = TaskTable::builtin();
    assert_eq!(table.rows().count(), 7);
    for row in table.rows() {
        let failures = failures(row);
        assert!(failures.is_empty(), "{}: {failures:?}", row.name);
    }
}

const ALLOCATES: u8 = 0;
const NOT_FINITE: u8 = 1;
const FOREIGN_JOINT: u8 = 2;
const CLAIMS_TWICE: u8 = 3;
const DEAF_TO_CANCEL: u8 = 4;
const NEVER_TIMES_OUT: u8 = 5;
const TAKES_BACK: u8 = 6;
const NOT_REPEATABLE: u8 = 7;
const PANICS: u8 = 8;
const MOVES_NOTHING: u8 = 9;
const ENDS_AT_ONCE: u8 = 10;
const ACCEPTS_NOTHING: u8 = 11;

static COUNT: AtomicU64 = AtomicU64::new(0);

/// A velocity task with one mistake.
#[derive(Debug)]
struct Wrong<const MISTAKE: u8> {
    inner: Box<dyn TaskBody>,
    lost: Option<u16>,
    target: [f64; 16],
}

impl<const MISTAKE: u8> Wrong<MISTAKE> {
    const SPEC: TaskSpec = TaskSpec {
        name: "wrong",
        build: |setup| {
            let inner = (velocity::SPEC.build)(setup)?;
            Ok(Box::new(Self { inner, lost: None, target: [0.0; 16] }))
        },
        ..velocity::SPEC
    };
}

impl<const MISTAKE: u8> TaskBody for Wrong<MISTAKE> {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        if MISTAKE == ACCEPTS_NOTHING {
            return Err(Outcome::InvalidTarget(cx.task));
        }
        if let Target::Velocities(velocities) = target {
            self.target = *velocities;
        }
        self.lost = None;
        self.inner.accept(cx, target)
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        assert!(MISTAKE != PANICS, "on purpose");
        if MISTAKE == ENDS_AT_ONCE {
            return Step::End(dimos::telemetry::TaskState::Idle, dimos::telemetry::Reason::None);
        }
        let step = self.inner.compute(cx, claims);
        match MISTAKE {
            ALLOCATES => drop(std::hint::black_box(vec![cx.dt; 8])),
            NOT_FINITE => claims.iter_mut().for_each(|claim| claim.value = f64::NAN),
            FOREIGN_JOINT => claims.iter_mut().take(1).for_each(|claim| claim.joint = 17),
            CLAIMS_TWICE => {
                claims.pop();
                claims.extend(claims.first().copied());
            }
            NEVER_TIMES_OUT | DEAF_TO_CANCEL => {
                claims.clear();
                claims.extend(cx.joints.iter().zip(self.target).map(|(&joint, value)| Claim { joint, value }));
                return if MISTAKE == DEAF_TO_CANCEL { step } else { Step::Continue };
            }
            TAKES_BACK => claims.extend(self.lost.map(|joint| Claim { joint, value: 0.0 })),
            NOT_REPEATABLE => {
                let odd = COUNT.fetch_add(1, Ordering::Relaxed).is_multiple_of(7);
                claims.iter_mut().for_each(|claim| claim.value *= if odd { 0.5 } else { 1.0 });
            }
            MOVES_NOTHING => claims.iter_mut().for_each(|claim| claim.value = 0.0),
            _ => {}
        }
        step
    }

    fn end(&mut self) {
        self.inner.end();
    }

    fn cancel(&mut self) -> OnCancel {
        if MISTAKE == DEAF_TO_CANCEL { OnCancel::Decelerate } else { self.inner.cancel() }
    }

    fn lose(&mut self, joints: &[u16], joint: u16) -> OnLoss {
        self.lost = Some(joint);
        self.inner.lose(joints, joint)
    }
}

#[track_caller]
fn caught(row: &TaskSpec, by: &str, saying: &str) {
    let failures = failures(row);
    let found = failures.iter().find(|(check, _)| *check == by);
    assert!(found.is_some_and(|(_, why)| why.contains(saying)), "{by} should say {saying:?}: {failures:?}");
}

#[test]
fn every_mistake_of_a_body_is_found_by_its_check() {
    caught(&Wrong::<ALLOCATES>::SPEC, "allocates_nothing", "allocations");
    caught(&Wrong::<NOT_FINITE>::SPEC, "claims_its_joints_once", "claims NaN");
    caught(&Wrong::<FOREIGN_JOINT>::SPEC, "claims_its_joints_once", "not its own");
    caught(&Wrong::<CLAIMS_TWICE>::SPEC, "claims_its_joints_once", "twice");
    caught(&Wrong::<DEAF_TO_CANCEL>::SPEC, "comes_to_rest_on_cancel", "after a cancel");
    caught(&Wrong::<NEVER_TIMES_OUT>::SPEC, "comes_to_rest_without_targets", "still moves");
    caught(&Wrong::<TAKES_BACK>::SPEC, "gives_way_to_a_stronger_task", "took the joint back");
    caught(&Wrong::<NOT_REPEATABLE>::SPEC, "repeats_bit_for_bit", "came out differently");
    caught(&Wrong::<PANICS>::SPEC, "moves", "on purpose");
    caught(&Wrong::<MOVES_NOTHING>::SPEC, "moves", "moved no joint");
    caught(&Wrong::<ENDS_AT_ONCE>::SPEC, "takes_its_targets_only", "Idle");
    caught(&Wrong::<ACCEPTS_NOTHING>::SPEC, "takes_its_targets_only", "InvalidTarget");
}

/// A Cartesian task that takes any numbers for a twist.
#[derive(Debug)]
struct Gullible(Box<dyn TaskBody>);

impl TaskBody for Gullible {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let _ = self.0.accept(cx, target);
        Ok(())
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        self.0.compute(cx, claims)
    }

    fn end(&mut self) {
        self.0.end();
    }
}

#[test]
fn every_mistake_of_a_row_is_found_by_its_check() {
    let gullible = TaskSpec {
        build: |setup| Ok(Box::new(Gullible((cartesian::EEF_TWIST.build)(setup)?))),
        ..cartesian::EEF_TWIST
    };
    caught(&gullible, "refuses_what_is_not_finite", "Accepted");
    caught(&TaskSpec { name: "Stick 1", ..velocity::SPEC }, "row_is_complete", "no name");
    caught(&TaskSpec { takes: &[], ..velocity::SPEC }, "row_is_complete", "takes no target");
    caught(
        &TaskSpec { takes: &[dimos::control::task_body::TargetKind::Positions], ..velocity::SPEC },
        "moves",
        "moved no",
    );
    fn lenient(setup: &TaskSetup<'_>) -> Result<Box<dyn TaskBody>, BuildError> {
        let params = (velocity::SPEC.params.default)();
        (velocity::SPEC.build)(&TaskSetup { params: &params, ..*setup })
    }
    caught(&TaskSpec { build: lenient, ..velocity::SPEC }, "unknown_parameters_are_refused", "deny_unknown_fields");
}
