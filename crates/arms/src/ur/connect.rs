//! Connecting: identifies the arm and compares it with the blueprint. Enables and moves nothing.

use std::f64::consts::TAU;
use std::time::Duration;

use super::Options;
use super::address::Address;
use super::dashboard::Dashboard;
use super::model::Model;
use super::primary::{KINEMATICS, Primary};
use super::protocol::primary::{Configuration, Kinematics};
use super::rtde::Rtde;
use super::session::{Device, POLYSCOPE_X, Session};
use dimos_core::arm::FactoryKinematics;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::JointLimits;
use dimos_hardware::adapter::{AdapterError, AdapterResult};

/// Timeout of the whole connection.
const TOTAL_TIMEOUT: Duration = Duration::from_millis(2800);
/// Timeouts of the first state and of the dashboard.
const FIRST_STATE: Duration = Duration::from_millis(1000);
const DASHBOARD: Duration = Duration::from_millis(800);

/// Connects to the arm at `address`.
pub fn connect(address: &Address, options: &Options) -> AdapterResult<Session> {
    let limit = MonotonicClock.now().after(TOTAL_TIMEOUT);
    let named = |error| name(error, address);
    let mut rtde = Rtde::connect(address, limit).map_err(named)?;
    let (primary, major, configuration, kinematics) = Primary::connect(address, limit, KINEMATICS).map_err(named)?;
    verify(address, options.model, configuration.kind, major)?;
    let left = limit.since(MonotonicClock.now());
    // Without a dashboard the arm does not say its serial number and its family.
    let dashboard = match rtde.software {
        [major, ..] if major >= POLYSCOPE_X => None,
        _ => Dashboard::connect(address, left.min(DASHBOARD)).ok(),
    };
    let (serial, family) = match dashboard {
        Some(mut board) => (board.ask("get serial number").ok(), board.ask("get robot model").ok()),
        None => (None, None),
    };
    let digits = |serial: &String| !serial.is_empty() && serial.bytes().all(|byte| byte.is_ascii_digit());
    let serial = serial.filter(digits);
    let left = limit.since(MonotonicClock.now());
    let first = rtde.next(left.min(FIRST_STATE)).map_err(named)?;
    let [major, minor, bugfix] = rtde.software;
    let device = Device {
        model: options.model,
        software: format!("{major}.{minor}.{bugfix}"),
        serial,
        kinematics: factory(options.model, kinematics),
        warning: renamed(options.model, family.as_deref()),
        limits: narrowed(options.model, options.limits(), &configuration),
    };
    Ok(Session::new(device, address.clone(), rtde, primary, first))
}

/// Returns what to say of an arm that has another name than the blueprint's, and the same joints.
fn renamed(model: Model, family: Option<&str>) -> Option<&'static str> {
    match (model, family?) {
        (Model::Ur5e, "UR7") => Some("the arm is a UR7e, with a payload of 7.5 kg: set `model: ur7e`"),
        (Model::Ur10e, "UR12") => Some("the arm is a UR12e: set `model: ur12e`"),
        (Model::Ur7e, "UR5") => Some("the arm is a UR5e, with a payload of 5 kg: set `model: ur5e`"),
        (Model::Ur12e, "UR10") => Some("the arm is a UR10e: set `model: ur10e`"),
        _ => None,
    }
}

/// Returns the arm's kinematics, beside those of its model.
fn factory(model: Model, found: Option<Kinematics>) -> FactoryKinematics {
    FactoryKinematics {
        nominal: model.dh().to_vec(),
        actual: found.map(|found| found.joints.to_vec()),
        checksum: found.map_or_else(String::new, |found| found.checksum.map(|sum| format!("{sum:08x}")).concat()),
    }
}

/// Adds the address to an error.
fn name(error: AdapterError, address: &Address) -> AdapterError {
    match error {
        AdapterError::Io(text) => AdapterError::Io(format!("ur at {address}: {text}")),
        AdapterError::Timeout(text) => AdapterError::Timeout(format!("ur at {address}: {text}")),
        AdapterError::Protocol(text) => AdapterError::Protocol(format!("ur at {address}: {text}")),
        other => other,
    }
}

/// Checks that the arm is the expected one.
fn verify(address: &Address, model: Model, kind: u32, major: u8) -> AdapterResult<()> {
    if model.is(kind, major) {
        return Ok(());
    }
    let found = Model::of(kind, major);
    let (what, hint) = match found {
        Some(other) => {
            (format!("a {}", other.name()), format!(" Else set the arm's options to {{model: {}}}", other.option()))
        }
        None => (format!("an arm of type {kind} with software {major}"), String::new()),
    };
    Err(AdapterError::Rejected(format!(
        "ur at {address}: expected the model {}, found {what}\nhint: is the address right?{hint}",
        model.name()
    )))
}

/// Returns the limits of the model, narrowed by those of the arm's safety configuration where they make sense.
fn narrowed(model: Model, mut limits: JointLimits, found: &Configuration) -> JointLimits {
    let ranges = limits.position_lower.iter_mut().zip(&mut limits.position_upper).zip(found.ranges);
    for (joint, ((lower, upper), (low, high))) in ranges.enumerate() {
        // Which range a controller reports of an endless joint is not known: a turn each way does not narrow it.
        if model.is_endless(joint) && high - low > 2.0 * TAU - 0.01 {
            continue;
        }
        if low.max(*lower) < high.min(*upper) {
            (*lower, *upper) = (low.max(*lower), high.min(*upper));
        }
    }
    for (top, speed) in limits.velocity_max.iter_mut().zip(found.speeds) {
        if speed > 0.01 {
            *top = top.min(speed);
        }
    }
    limits
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_safety_configuration_narrows_the_limits() {
        let model = Model::Ur5e.limits();
        let mut found = Configuration::default();
        let limits_of = |found: &Configuration| narrowed(Model::Ur5e, Model::Ur5e.limits(), found);
        assert_eq!(limits_of(&found), model, "zeros are no limits");
        found.ranges[2] = (-2.5, 2.0);
        found.ranges[0] = (-9.0, 9.0);
        found.speeds = [1.0, 9.0, 0.0, 3.0, 3.0, 3.0];
        let limits = limits_of(&found);
        assert_eq!((limits.position_lower[2], limits.position_upper[2]), (-2.5, 2.0));
        assert_eq!(limits.position_upper[0], model.position_upper[0]);
        assert_eq!((limits.velocity_max[0], limits.velocity_max[1]), (1.0, model.velocity_max[1]));
    }

    #[test]
    fn an_endless_joint_is_narrowed_by_less_than_a_turn_each_way() {
        for (range, upper) in [((-TAU, TAU), 1000.0), ((-6.34, 6.34), 1000.0), ((-3.0, 3.0), 3.0)] {
            let mut found = Configuration::default();
            (found.ranges[0], found.ranges[5]) = (range, range);
            let limits = narrowed(Model::Ur3e, Model::Ur3e.limits(), &found);
            assert_eq!((limits.position_upper[0], limits.position_upper[5]), (range.1.min(TAU), upper));
        }
    }
}
