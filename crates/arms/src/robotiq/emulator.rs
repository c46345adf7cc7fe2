//! The gripper's side of the registers, with simulated fingers: activation, motion, objects, faults. Written from the
//! manual; shares no code with the adapter.

use super::{BAUD, Options};
use dimos_core::clock::Mono;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::registry::{AdapterConfig, EmulatorAddress, Truth};
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::faults::{FaultKind, joined};
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::modbus::{self, NO_REGISTER, Registers};
use dimos_hardware::sim::peripheral_server::{Emulated, PeripheralServer, WIRE_FAULTS, WireFaults};
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::sim::tool_device::ToolDevice;
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::line::LineAddress;
use dimos_hardware::transport::modbus::Framing;

/// The faults that it can play.
pub const PLAYABLE: &[FaultKind] =
    &joined::<10>(&WIRE_FAULTS, &[FaultKind::ErrorCode, FaultKind::Object, FaultKind::GripperBlocked]);
/// Port of Modbus TCP.
const PORT: u16 = 502;
/// Opening of the open gripper [m], and its own positions when open and closed.
const STROKE: f64 = 0.085;
const OPEN: f64 = 3.0;
const CLOSED: f64 = 230.0;
/// Fault codes: an action without activation, and during it.
const NOT_ACTIVATED: u8 = 7;
const DELAYED: u8 = 5;

/// Progress of activation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Activation {
    None,
    Opens,
    Closes,
    Done,
}

/// An emulated gripper.
pub struct Fingers {
    unit: u8,
    framing: Framing,
    gripper: Gripper,
    activation: Activation,
    /// A fault that only activation clears.
    fault: u8,
    /// The registers that were written.
    action: [u16; 3],
    /// The fault of an action that is not possible.
    refused: u8,
    faults: WireFaults,
    advanced_to: Option<Mono>,
}

impl Fingers {
    /// Creates a gripper, half open.
    pub fn new(options: &Options, framing: Framing) -> Self {
        let homed = options.sim.homed;
        Self {
            unit: options.unit,
            framing,
            gripper: Gripper::new(STROKE, 0.15).with_force(20.0),
            activation: if homed { Activation::Done } else { Activation::None },
            fault: 0,
            action: [if homed { 0x0100 } else { 0 }, 0, 0],
            refused: 0,
            faults: WireFaults::new("robotiq_2f85", PLAYABLE, &options.sim.faults),
            advanced_to: None,
        }
    }

    /// Puts an object of this width [m] between the fingers; 0 takes it away.
    pub fn put_object(&mut self, width: f64) {
        self.gripper.put_object(width);
    }

    fn advance(&mut self, now: Mono) {
        let dt = self.advanced_to.map_or(0.0, |before| now.seconds_since(before));
        self.advanced_to = Some(now);
        let faults = &mut self.faults;
        self.gripper.play(|kind| faults.take(kind, now));
        if let Some(fault) = self.faults.take(FaultKind::ErrorCode, now) {
            self.fault = (fault.code & 0x0F) as u8;
            self.gripper.rest();
        }
        self.gripper.advance(dt);
        if !self.gripper.moving() {
            self.activation = match self.activation {
                Activation::Opens => {
                    self.gripper.move_to(0.0);
                    Activation::Closes
                }
                Activation::Closes => {
                    self.gripper.rest();
                    Activation::Done
                }
                other => other,
            };
        }
    }

    /// The supply was off: it has forgotten its activation.
    fn restart(&mut self) {
        (self.activation, self.action, self.fault, self.refused) = (Activation::None, [0; 3], 0, 0);
        self.gripper.rest();
    }

    fn act(&mut self, before: u16) {
        let [request, position, speed_force] = self.action;
        let (active, go) = (request & 0x0100 != 0, request & 0x0800 != 0);
        self.refused = 0;
        if !active {
            (self.activation, self.fault) = (Activation::None, 0);
            return self.gripper.rest();
        }
        if before & 0x0100 == 0 {
            self.activation = Activation::Opens;
            self.gripper.set_speed(1.0);
            return self.gripper.move_to(STROKE);
        }
        if !go {
            return self.gripper.stop();
        }
        match self.activation {
            Activation::None => self.refused = NOT_ACTIVATED,
            Activation::Opens | Activation::Closes => self.refused = DELAYED,
            Activation::Done if self.fault != 0 => {}
            Activation::Done => {
                let [speed, force] = speed_force.to_be_bytes().map(f64::from);
                self.gripper.set_speed((20.0 + 130.0 * speed / 255.0) / 150.0);
                self.gripper.max_force = 20.0 + 215.0 * force / 255.0;
                let count = f64::from(position & 0xFF);
                self.gripper.move_to((CLOSED - count) / (CLOSED - OPEN) * STROKE);
            }
        }
    }

    fn status(&self) -> [u16; 3] {
        let (request, go) = (self.action[0], self.action[0] & 0x0800 != 0);
        let activation = match self.activation {
            _ if (10..=15).contains(&self.fault) => 0,
            Activation::None => 0,
            Activation::Opens | Activation::Closes => 1,
            Activation::Done => 3,
        };
        let fingers = match () {
            _ if self.activation != Activation::Done || !go || self.gripper.moving() => 0,
            _ if self.gripper.gripping() => 2,
            _ => 3,
        };
        let status = (request >> 8 & 0x01) as u8 | if go { 0x08 } else { 0 } | activation << 4 | fingers << 6;
        let fault = if self.fault != 0 { self.fault } else { self.refused };
        let count = CLOSED - self.gripper.position / STROKE * (CLOSED - OPEN);
        let current = if self.gripper.moving() { 12 } else { 0 };
        [
            u16::from_be_bytes([status, 0]),
            u16::from_be_bytes([fault, (self.action[1] & 0xFF) as u8]),
            u16::from_be_bytes([count.round().clamp(0.0, 255.0) as u8, current]),
        ]
    }

    fn answer(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<()> {
        self.faults.requested(now);
        self.advance(now);
        modbus::serve(self.framing, self.unit, bytes, now, self, answer)
    }
}

/// Returns which of three registers from `base` on are those from `first` on.
fn spot(base: u16, first: u16, count: usize) -> Result<std::ops::Range<usize>, u8> {
    let start = usize::from(first.checked_sub(base).ok_or(NO_REGISTER)?);
    if start + count <= 3 { Ok(start..start + count) } else { Err(NO_REGISTER) }
}

impl Registers for Fingers {
    /// Its status is in both tables.
    fn read(&mut self, _input: bool, first: u16, count: u16, _now: Mono) -> Result<Vec<u16>, u8> {
        let (registers, base) = if first < 2000 { (self.action, 1000) } else { (self.status(), 2000) };
        let spot = spot(base, first, count.into())?;
        registers.get(spot).map(<[u16]>::to_vec).ok_or(NO_REGISTER)
    }

    fn write(&mut self, first: u16, values: &[u16], _now: Mono) -> Result<(), u8> {
        let before = self.action[0];
        let spot = spot(1000, first, values.len())?;
        self.action.get_mut(spot).ok_or(NO_REGISTER)?.copy_from_slice(values);
        self.act(before);
        Ok(())
    }
}

impl Controller for Fingers {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        self.answer(bytes, now, answer).map(|()| {
            let delivery = self.faults.delivery(now);
            if matches!(delivery, Delivery::PowerLoss(_)) {
                self.restart();
            }
            delivery
        })
    }

    /// The fingers continue, and keep what they hold.
    fn client_gone(&mut self, _now: Mono) {}
}

impl Emulated for Fingers {
    fn faults(&mut self) -> &mut WireFaults {
        &mut self.faults
    }

    fn truth(&mut self, now: Mono) -> Truth {
        self.advance(now);
        let (position, force) = (Some(self.gripper.position), Some(self.gripper.max_force));
        Truth { gripper_position: position, gripper_force: force, ..Truth::default() }
    }
}

/// The gripper at the tool connector of an emulated arm.
pub struct AtTool(pub Fingers, pub fn() -> Mono);

impl ToolDevice for AtTool {
    fn exchange(&mut self, bytes: &[u8], answer: &mut Vec<u8>) {
        let now = (self.1)();
        let _ = self.0.answer(bytes, now, answer);
    }
}

/// An emulator of the gripper.
pub type Server = PeripheralServer<Fingers>;

/// Starts an emulator.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Server> {
    super::check(config)?;
    let options: Options = config.options()?;
    let given = LineAddress::parse(&config.address, BAUD).ok();
    let tcp = options.framing == Some(Framing::Tcp) || matches!(place, EmulatorAddress::Bind(_));
    let framing = match (options.framing, given) {
        (Some(framing), _) => framing,
        (None, Some(address)) => Framing::at(&address, None),
        (None, None) if tcp => Framing::Tcp,
        (None, None) => Framing::Rtu,
    };
    let device = Fingers::new(&options, framing);
    PeripheralServer::start("robotiq_2f85", device, place, PORT, tcp).map_err(|error| match error {
        AdapterError::Rejected(_) => AdapterError::Rejected(format!("{error}\nhint: --pty, or a loopback address")),
        error => error,
    })
}
