//! Connecting: identifies the arm, finds its report ports, and compares it with the blueprint. Enables and moves
//! nothing.

use std::time::Duration;

use super::Options;
use super::address::Address;
use super::condition::Condition;
use super::control::{Control, Purpose};
use super::gripper::{Gripper, ToolGripper};
use super::model::{Identity, Model};
use super::output_gripper::OutputGripper;
use super::protocol::commands::{Command, QUICK, SLOW};
use super::protocol::frame::{Response, WATCHED};
use super::protocol::gripper::{BAUD_INDEX, BAUD_REGISTER, GripperKind, OUTPUTS, Rtu, decode_position};
use super::protocol::identity::{Firmware, decode_serial, decode_version};
use super::protocol::report::{Health, Kind, Motion};
use super::session::{Device, Session};
use super::stream::Stream;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::TcpLink;

/// Timeout of the whole connection.
const TOTAL_TIMEOUT: Duration = Duration::from_millis(3000);
/// Timeouts of the TCP connection, of the version, and of the first report of each kind.
const CONNECT: Duration = Duration::from_millis(1200);
const VERSION: Duration = Duration::from_millis(1000);
const FIRST_REPORT: Duration = Duration::from_millis(1000);
/// Timeout of the second control port, which older boxes refuse.
const SECOND: Duration = Duration::from_millis(300);
/// Timeout of the gripper's first response over it.
const FIRST_TELEGRAM: Duration = Duration::from_millis(1200);

/// Returns the rest of a timeout, at most `most`.
fn left(until: Mono, most: Duration) -> Duration {
    until.since(MonotonicClock.now()).min(most)
}

/// Connects to the arm at `address`, which must be a `model`.
pub fn connect(address: &Address, model: Model, options: &Options) -> AdapterResult<Session> {
    let until = MonotonicClock.now().after(TOTAL_TIMEOUT);
    let named = |error| name(error, address);
    let link = TcpLink::connect("xarm", &address.control, left(until, CONNECT)).map_err(named)?;
    let mut control = Control::new(link);
    let version = ask(&mut control, &Command::Version, left(until, VERSION))?;
    let (identity, firmware) = decode_version(version.data()).ok_or_else(|| {
        AdapterError::Protocol(format!("xarm at {address}: what answers at the control port is not an xArm controller"))
    })?;
    verify(address, model, &identity)?;
    if firmware.at_least(1, 8, 6) {
        control.speak(WATCHED);
    }
    let serial = ask(&mut control, &Command::Serials, left(until, QUICK))?;
    let serial = decode_serial(serial.data()).unwrap_or_else(|| identity.serial.clone());

    let (motion, first) = reports(address, firmware, until)?;
    let mut normal = Stream::connect(address, Kind::Rich, Health::decode, left(until, CONNECT))?;
    let mut condition = Condition::default();
    condition.report(normal.wait(left(until, FIRST_REPORT)).map_err(no_report)?);
    // Register 70 turns the torques of every report but the full one into currents.
    let full = motion.kind() == Kind::Full;
    let currents = !full && ask(&mut control, &Command::ReportsCurrents, QUICK)?.data().first() == Some(&1);
    condition.take(&ask(&mut control, &Command::GetError, QUICK)?);
    // Older firmware does not report it.
    if condition.reduced.is_none()
        && let Ok(answer) = ask(&mut control, &Command::ReducedMode, QUICK)
    {
        condition.take(&answer);
    }
    let (bus, pulses) = find_gripper(&mut control, options.gripper, address, until)?;

    let limits = identity.limits().unwrap_or_else(|| model.limits());
    let device = Device { model, firmware, serial, limits, torques: !currents };
    let gripper: Box<dyn ToolGripper> = match options.gripper {
        kind @ (GripperKind::Lite6 | GripperKind::Vacuum) => Box::new(OutputGripper::new(kind)),
        kind => Box::new(Gripper::new(kind, pulses)),
    };
    Ok(Session::new(device, (control, bus), motion, first, normal, condition, gripper))
}

/// Connects to the reports with joint positions: those of port 30000 if available, otherwise those of port 30003, which
/// every firmware has.
fn reports(address: &Address, firmware: Firmware, until: Mono) -> AdapterResult<(Stream<Motion>, Motion)> {
    let begin = |kind, decode: fn(&[u8]) -> _| -> AdapterResult<_> {
        let mut stream = Stream::connect(address, kind, decode, left(until, FIRST_REPORT))?;
        let first = stream.wait(left(until, FIRST_REPORT)).map_err(no_report)?;
        Ok((stream, first))
    };
    if !firmware.at_least(2, 1, 0) {
        return begin(Kind::Real, Motion::decode_real);
    }
    begin(Kind::Full, Motion::decode_full).or_else(|error| begin(Kind::Real, Motion::decode_real).map_err(|_| error))
}

fn ask(control: &mut Control, command: &Command, timeout: Duration) -> AdapterResult<Response> {
    control.ask(command, timeout, |_: Purpose, _| ())
}

/// Adds the blueprint's address to an error about the control port.
fn name(error: AdapterError, address: &Address) -> AdapterError {
    let in_full = |text: String| match address.reports == super::address::REPORT_PORT {
        true => text,
        false => text.replace(&address.control.to_string(), &address.to_string()),
    };
    match error {
        AdapterError::Io(text) => AdapterError::Io(in_full(text)),
        AdapterError::Timeout(text) => AdapterError::Timeout(in_full(text)),
        other => other,
    }
}

fn no_report(error: AdapterError) -> AdapterError {
    match error {
        AdapterError::Timeout(text) => AdapterError::Timeout(format!("{text}: no report that can be understood came")),
        other => other,
    }
}

/// Checks that the arm is the expected one.
fn verify(address: &Address, model: Model, found: &Identity) -> AdapterResult<()> {
    let is = Model::of(found);
    if is == Some(model) {
        return Ok(());
    }
    let (axes, kind) = (found.axes, found.kind);
    let what = match is {
        Some(other) => format!("{} {} with {axes} joints", other.article(), other.name()),
        None => format!("an unknown arm with {axes} joints (kind {kind})"),
    };
    let hint = match is {
        Some(other) if axes == model.axes() => {
            format!("is the address right? Else set the arm's options to {{model: {}}}", other.option())
        }
        Some(other) => {
            let option = other.option();
            format!("is the address right? Else give the arm {axes} joints, and options of {{model: {option}}}")
        }
        None => "is the address right?".to_owned(),
    };
    let (name, joints) = (model.name(), model.axes());
    Err(AdapterError::Rejected(format!(
        "xarm at {address}: expected the model {name} with {joints} joints, found {what}\nhint: {hint}"
    )))
}

/// Checks that the blueprint's gripper answers. Returns its connection, if it is not `control`, and its position
/// [pulses].
fn find_gripper(
    control: &mut Control,
    kind: GripperKind,
    address: &Address,
    until: Mono,
) -> AdapterResult<(Option<Control>, Option<i32>)> {
    if kind == GripperKind::None {
        return Ok((None, None));
    }
    // Another kind of server may be listening at the second port.
    let first = |control: &mut Control, request: Command| {
        let second = || {
            let mut bus = Control::new(TcpLink::connect("xarm", &address.second(), left(until, SECOND))?);
            let answer = ask(&mut bus, &request, left(until, FIRST_TELEGRAM))?;
            AdapterResult::Ok((Some(bus), answer))
        };
        second().or_else(|_| AdapterResult::Ok((None, ask(control, &request, left(until, SLOW))?)))
    };
    let rejected =
        |what: &str, hint: &str| Err(AdapterError::Rejected(format!("xarm at {address}: {what}\nhint: {hint}")));
    if kind.is_on_off() {
        let (bus, answer) = first(control, Command::ReadToolBoard(OUTPUTS))?;
        return match answer.status.invalid() || answer.data().len() < 4 {
            false => Ok((bus, None)),
            true => rejected(
                "the tool board does not say what its outputs are, which open and close the gripper",
                "without a gripper set the arm's options to {gripper: none}",
            ),
        };
    }
    let baud = ask(control, &Command::ReadToolBoard(BAUD_REGISTER), left(until, SLOW))?;
    match baud.data() {
        [_, a, b, c, d, ..] | [a, b, c, d] if i32::from_be_bytes([*a, *b, *c, *d]) == BAUD_INDEX => {}
        _ => {
            return rejected(
                "the tool's RS485 does not run at 2 Mbit/s, which the gripper needs",
                "set the tool's baud rate to 2000000 in the vendor's studio, or the arm's options to {gripper: none}",
            );
        }
    }
    let telegram = Rtu::read_position();
    let (bus, answer) = first(control, Command::Tool(telegram))?;
    match telegram.answered(answer.data()).and_then(decode_position) {
        Some(pulses) => Ok((bus, Some(pulses))),
        None => rejected(
            "no gripper answers at the tool flange",
            "is it fitted? Without one set the arm's options to {gripper: none}",
        ),
    }
}

/// Returns whether this firmware has the parameter for collision detection.
pub fn takes_detection(firmware: Firmware) -> bool {
    firmware.at_least(1, 10, 0)
}

/// Returns whether the controller ends joint velocities after a time. Without this, a velocity lasts until the next
/// command, even after a loss of the connection; such an arm has no velocity mode here.
pub fn ends_velocities(firmware: Firmware) -> bool {
    firmware.at_least(1, 8, 0)
}
