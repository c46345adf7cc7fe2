//! The controller's side of RTDE.

use super::controller::Controller;
use super::fields::{Frame, Input, Output};
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::transport::Scan;

/// One connection's recipes.
#[derive(Default)]
pub(super) struct Rtde {
    outputs: Vec<Output>,
    inputs: Vec<Vec<Input>>,
    /// Names of the inputs that this connection has.
    owned: Vec<String>,
    /// Every how many steps a packet is sent.
    divider: u64,
    started: bool,
    version: u16,
}

/// Puts a packet into `to`.
fn packet(to: &mut Vec<u8>, kind: u8, content: &[u8]) {
    to.extend(((content.len() + 3) as u16).to_be_bytes());
    to.push(kind);
    to.extend(content);
}

impl Controller {
    /// Processes the packet at the front of a connection's bytes.
    pub(super) fn rtde_request(&mut self, who: (usize, u64), bytes: &[u8], answer: &mut Vec<u8>) -> Scan<Delivery> {
        let [high, low, kind, ..] = bytes else { return Scan::More };
        let length = usize::from(u16::from_be_bytes([*high, *low]));
        let Some(content) = bytes.get(3..length) else {
            return if length < 3 { Scan::Skip(1) } else { Scan::More };
        };
        if *kind == b'U' {
            self.take_inputs(who, content);
            return Scan::Take(length, Delivery::Send);
        }
        let controller_version = self.version();
        let rate = self.model.rate();
        let taken: Vec<String> =
            self.sessions.iter().filter(|(other, _)| **other != who).flat_map(|(_, s)| s.rtde.owned.clone()).collect();
        let frame = Frame::empty(self);
        let names = |bytes: &[u8]| -> Vec<String> {
            let text = String::from_utf8_lossy(bytes);
            text.split(',').filter(|name| !name.is_empty()).map(str::to_owned).collect()
        };
        match kind {
            b'V' => packet(answer, b'V', &[u8::from(content == [0, 2] || content == [0, 1])]),
            b'v' => {
                let [major, minor, bugfix] = controller_version;
                let numbers = [major.into(), minor.into(), bugfix as u32, 0];
                packet(answer, b'v', &numbers.map(u32::to_be_bytes).concat());
            }
            b'O' => {
                let (hertz, list) = content.split_at_checked(8).unwrap_or((&[0; 8], &[]));
                let hertz = f64::from_be_bytes(hertz.try_into().unwrap_or_default());
                let outputs: Vec<Option<Output>> =
                    names(list).iter().map(|name| Output::find(name, controller_version)).collect();
                let kinds = outputs.iter().map(|o| o.map_or("NOT_FOUND", |output| output.value(&frame).kind()));
                let text = kinds.collect::<Vec<_>>().join(",");
                let known: Option<Vec<Output>> = outputs.into_iter().collect();
                let id = u8::from(known.is_some());
                if let Some(session) = self.sessions.get_mut(&who) {
                    session.rtde.outputs = known.unwrap_or_default();
                    session.rtde.divider = (rate / hertz.clamp(1.0, rate)).round() as u64;
                }
                packet(answer, b'O', &[&[id][..], text.as_bytes()].concat());
            }
            b'I' => {
                let names = names(content);
                let inputs: Vec<Option<Input>> = names.iter().map(|name| Input::find(name)).collect();
                let kinds = names.iter().zip(&inputs).map(|(name, input)| match input {
                    None => "NOT_FOUND",
                    Some(_) if taken.contains(name) => "IN_USE",
                    Some(input) => input.kind(),
                });
                let text = kinds.collect::<Vec<_>>().join(",");
                let usable = !text.contains("NOT_FOUND") && !text.contains("IN_USE");
                let mut id = 0;
                if let Some(session) = self.sessions.get_mut(&who).filter(|_| usable) {
                    session.rtde.inputs.push(inputs.into_iter().flatten().collect());
                    session.rtde.owned.extend(names);
                    id = session.rtde.inputs.len() as u8;
                }
                packet(answer, b'I', &[&[id][..], text.as_bytes()].concat());
            }
            b'S' | b'P' => {
                let session = self.sessions.get_mut(&who);
                let ready = session.is_some_and(|session| {
                    session.rtde.started = *kind == b'S' && !session.rtde.outputs.is_empty();
                    *kind == b'P' || session.rtde.started
                });
                packet(answer, *kind, &[u8::from(ready)]);
            }
            _ => {}
        }
        if let Some(session) = self.sessions.get_mut(&who).filter(|_| *kind == b'V') {
            session.rtde.version = 2;
        }
        Scan::Take(length, self.delivery())
    }

    /// Takes the values of a data packet.
    fn take_inputs(&mut self, who: (usize, u64), content: &[u8]) {
        let [id, values @ ..] = content else { return };
        let Some(session) = self.sessions.get(&who) else { return };
        let Some(recipe) = usize::from(*id).checked_sub(1).and_then(|i| session.rtde.inputs.get(i)).cloned() else {
            return;
        };
        if recipe.iter().map(|input| input.length()).sum::<usize>() != values.len() {
            return;
        }
        let (mut rest, mut masks) = (values, (0_u64, 0_u8, false));
        for input in recipe {
            let Some((bytes, more)) = rest.split_at_checked(input.length()) else { return };
            rest = more;
            let whole = |bytes: &[u8]| bytes.iter().fold(0_u64, |all, byte| all << 8 | u64::from(*byte));
            let number = if bytes.len() <= 8 { whole(bytes) } else { 0 };
            let outputs = &mut self.outputs;
            match input {
                Input::Int(n) => {
                    self.exchanged.int_in.iter_mut().skip(n).take(1).for_each(|r| *r = number as u32 as i32)
                }
                Input::Double(n) => {
                    self.exchanged.double_in.iter_mut().skip(n).take(1).for_each(|r| *r = f64::from_bits(number));
                }
                Input::DigitalMask(_) => masks.0 = number,
                Input::Digital(first) => {
                    let (mask, bits) = (masks.0 << first, number << first);
                    outputs.digital = outputs.digital & !mask | bits & mask;
                }
                Input::AnalogMask => masks.1 = number as u8,
                Input::AnalogType => outputs.voltage = outputs.voltage & !masks.1 | number as u8 & masks.1,
                Input::Analog(n) => {
                    let voltage = outputs.voltage >> n & 1 == 1;
                    let fraction = f64::from_bits(number).clamp(0.0, 1.0);
                    let value = if voltage { 10.0 * fraction } else { 0.004 + 0.016 * fraction };
                    if masks.1 >> n & 1 == 1 {
                        outputs.analog.iter_mut().skip(n).take(1).for_each(|output| *output = value);
                    }
                }
                Input::SliderMask => masks.2 = number != 0,
                Input::Slider if masks.2 => self.slider = f64::from_bits(number).clamp(0.0, 1.0),
                Input::Slider | Input::Bit | Input::Bits | Input::Force => {}
            }
        }
    }

    /// Puts the next state into `to`, if the connection gets one now.
    pub(super) fn rtde_report(&mut self, who: (usize, u64), to: &mut Vec<u8>) -> Option<Delivery> {
        let session = self.sessions.get_mut(&who)?;
        session.reports += 1;
        if !session.rtde.started || !session.reports.is_multiple_of(session.rtde.divider.max(1)) {
            return Some(Delivery::Send);
        }
        let measured = self.arm.measured();
        let pose = self.pose(measured.positions.first_chunk().copied().unwrap_or_default());
        let frame = Frame { controller: self, measured, pose };
        let outputs = self.sessions.get(&who).map(|session| &session.rtde.outputs);
        to.extend([0, 0, b'U', 1]);
        outputs.into_iter().flatten().for_each(|output| output.value(&frame).write(to));
        let length = (to.len() as u16).to_be_bytes();
        to.iter_mut().zip(length).for_each(|(byte, of)| *byte = of);
        Some(self.delivery())
    }

    /// Faults of the wire, for the next reply or state.
    fn delivery(&mut self) -> Delivery {
        let delivery = self.arm.delivery();
        match delivery {
            Delivery::PowerLoss(_) => self.lose_power(),
            Delivery::Send if self.arm.take_fault(FaultKind::Frozen).is_some() => return Delivery::Frozen,
            _ => {}
        }
        delivery
    }

    /// Faults of the wire that also affect the other ports.
    pub(super) fn lasting(&self) -> Delivery {
        if self.arm.fault_lasts(FaultKind::Silent) { Delivery::Silent } else { Delivery::Send }
    }

    /// Version of the software.
    pub(super) fn version(&self) -> [u8; 3] {
        self.software
    }
}
