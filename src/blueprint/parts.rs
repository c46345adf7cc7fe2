//! What `hardware` sets of an arm's optional parts: the stop input, the load at the flange, the mounting.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::blueprint::resolve::Checker;
use crate::blueprint::schema::HardwareEntry;
use dimos_core::arm::{Load, MAX_DIGITAL, StopInput, UPRIGHT, channel};
use dimos_core::pose;
use dimos_core::written;
use dimos_hardware::check::Checked;
use dimos_hardware::device::Setup;
use dimos_yaml::{Diag, Located, quote};

/// A digital input that holds the arm while it is open. It is an operational stop, not a safety function.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StopInputEntry {
    /// The digital input: `di0`, `di1`, …
    pub input: Located<String>,
    /// Level of the open input. With `low`, a broken wire stops the arm.
    #[serde(default)]
    pub open: InputLevel,
}

/// Level of a digital input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum InputLevel {
    /// No voltage.
    #[default]
    Low,
    /// Voltage.
    High,
}

/// The load at the flange: tool and workpiece together, as far as it does not change during the run.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PayloadEntry {
    /// Mass [kg].
    #[schemars(range(min = 0, max = 1000))]
    pub mass: f64,
    /// Centre of mass in the flange frame [m].
    #[serde(default)]
    pub center: [f64; 3],
    /// Inertia about the centre of mass, along the axes of the flange frame: xx, xy, xz, yy, yz, zz [kg·m²].
    #[serde(default)]
    pub inertia: [f64; 6],
}

/// Orientation of the arm's base.
#[derive(Debug, Clone, Copy, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MountingEntry {
    /// Roll, pitch, yaw of the base relative to an upright one, about fixed axes [rad]: `[3.1416, 0, 0]` hangs from a
    /// ceiling.
    pub rpy: [f64; 3],
}

/// Checks and returns what an entry sets, as far as the arm is known before it is connected.
pub(super) fn resolve(checker: &mut Checker<'_>, entry: &HardwareEntry, arm: &Checked) -> Setup {
    let payload = entry.payload.as_ref();
    if arm.max_payload == Some(0.0)
        && let Some(at) = payload.map(|payload| payload.at).or(entry.mounting.as_ref().map(|mounting| mounting.at))
    {
        let what = format!("the controller of {} takes neither a payload nor a mounting", quote(&entry.adapter_type));
        checker.error(at, Diag::error(what).hint("remove `payload` and `mounting`"));
    }
    let max_payload = arm.max_payload.filter(|most| *most > 0.0);
    Setup {
        stop_input: entry.stop_input.as_ref().and_then(|stop| stop_input(checker, stop, arm.digital_inputs)),
        payload: payload.and_then(|payload| load(checker, payload, max_payload)),
        max_payload,
        gravity: entry.mounting.as_ref().and_then(|mounting| gravity(checker, mounting)),
        tool_velocity: None, // resolved with the arm's model
        efforts: None,
        impedance: arm.impedance,
    }
}

fn load(checker: &mut Checker<'_>, entry: &Located<PayloadEntry>, most: Option<f64>) -> Option<Load> {
    let PayloadEntry { mass, center, inertia } = entry.value;
    let load = Load { mass, center, inertia };
    if let Err(what) = load.within(most) {
        let at = checker.tree.entry(entry.at, "mass").map_or(entry.at, |(_, value)| value);
        checker.error(at, Diag::error(what).hint(Load::TOO_HEAVY));
        return None;
    }
    match load.check() {
        Ok(()) => Some(load),
        Err(what) => {
            checker.error(entry.at, Diag::error(what).hint("give kg, m and kg·m²"));
            None
        }
    }
}

/// Returns the direction of gravity in the base frame.
fn gravity(checker: &mut Checker<'_>, entry: &Located<MountingEntry>) -> Option<[f64; 3]> {
    let rpy = entry.value.rpy;
    if let Err(what) = rpy.into_iter().try_for_each(written::angle) {
        checker.error(entry.at, Diag::error(what).hint("for example `mounting: {rpy: [3.1416, 0, 0]}`"));
        return None;
    }
    let base = pose::from_xyz_rpy([0.0; 3], rpy);
    Some(base.inverse_transform_vector(&UPRIGHT.into()).into())
}

fn stop_input(checker: &mut Checker<'_>, stop: &StopInputEntry, inputs: Option<u8>) -> Option<StopInput> {
    let input = channel(&stop.input, "di");
    if input.is_none() {
        let diag = Diag::error(format!("{} is not a digital input", quote(&stop.input)));
        checker.error(stop.input.at, diag.hint(format!("give `di0` to `di{}`", MAX_DIGITAL - 1)));
    }
    let input = input?;
    if let Some(inputs) = inputs.filter(|inputs| input >= *inputs) {
        let hint = match inputs {
            0 => "the arm has no digital inputs: remove `stop_input`".to_owned(),
            inputs => format!("it has di0 to di{}", inputs - 1),
        };
        checker.error(stop.input.at, Diag::error(format!("the arm has no digital input di{input}")).hint(hint));
        return None;
    }
    Some(StopInput { input, open: stop.open == InputLevel::High })
}
