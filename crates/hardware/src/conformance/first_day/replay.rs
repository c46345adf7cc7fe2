//! Plays a report: what the arm sent through the adapter's decoder, and what was sent to it to the emulator, whose
//! messages must be of the same kinds.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use serde::Serialize;
use serde_json::{Value, json};

use super::ERRORS;
use super::report::{Line, Report};
use crate::adapter::{AdapterError, AdapterResult};
use crate::registry::{AdapterConfig, AdapterSpec, EmulatorAddress};
use crate::transport::can::{self, CanAddress, CanEvent, CanFrame, CanPort};
use crate::transport::capture::{self, Chunk};
use crate::transport::serial::SerialLink;
use crate::transport::tcp::{Endpoint, TcpLink};
use crate::transport::udp::UdpLink;
use crate::transport::{Scan, capture::Capture};
use crate::wire::{Message, Place, Wire};
use dimos_core::clock::{Clock, MonotonicClock};

/// Longest pause between two chunks that is kept [µs]: a person thinks longer.
const PAUSE: u64 = 300_000;
/// How long the emulator may still answer after the last chunk of a connection.
const AFTER: Duration = Duration::from_millis(300);
/// Statuses of a kind of message differ if their shares of failures are this far apart.
const SHARE: f64 = 0.2;
/// Part of the arm's bytes that may be damaged.
const DAMAGED: f64 = 0.001;
/// Largest baud rate of a pseudo-terminal; any will do [bit/s].
const BAUD: u32 = 1_000_000;

/// Messages of one kind.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Kind {
    /// How many the arm sent.
    pub arm: usize,
    /// How many the emulator sent to the same requests.
    pub emulator: usize,
    /// How many of the arm's the adapter's decoder does not take.
    pub wrong: usize,
    /// How many had a status other than success: of the arm's, and of the emulator's.
    pub failures: (usize, usize),
    /// What differs.
    pub difference: Option<String>,
}

/// What came of it.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Comparison {
    /// All kinds of messages from the arm, by connection and name.
    pub kinds: BTreeMap<String, Kind>,
    /// Bytes from the arm that are no message, and all of them.
    pub damaged: (usize, usize),
    /// What differs besides messages.
    pub differences: Vec<String>,
}

impl Comparison {
    /// Returns whether nothing differs.
    pub fn same(&self) -> bool {
        self.differences.is_empty() && self.kinds.values().all(|kind| kind.difference.is_none())
    }
}

/// Messages that were found in one side's bytes, and how many bytes are none.
#[derive(Default)]
struct Found {
    messages: Vec<(String, Message)>,
    damaged: usize,
    bytes: usize,
}

/// Decodes what came from the arm.
fn decode(wire: &Wire, lines: &[Line], chunks: &[Chunk]) -> Found {
    let mut found = Found::default();
    for (index, line) in lines.iter().enumerate() {
        let place = Place { connection: &line.name, sent: false };
        let of = || chunks.iter().filter(|chunk| chunk.connection == index && !chunk.sent);
        found.bytes += of().map(|chunk| chunk.bytes.len()).sum::<usize>();
        if line.datagrams {
            of().for_each(|chunk| found.take(wire, place, &chunk.bytes));
        } else {
            let stream: Vec<u8> = of().flat_map(|chunk| chunk.bytes.iter().copied()).collect();
            found.take(wire, place, &stream);
        }
    }
    found
}

impl Found {
    fn take(&mut self, wire: &Wire, place: Place<'_>, bytes: &[u8]) {
        let mut at = 0;
        while let Some(rest) = bytes.get(at..).filter(|rest| !rest.is_empty()) {
            match (wire.scan)(place, rest) {
                // The last one was cut by the end of the connection.
                Scan::More => return,
                Scan::Skip(n) => {
                    self.damaged += n.max(1).min(rest.len());
                    at += n.max(1);
                }
                Scan::Take(n, message) => {
                    if !message.name.is_empty() {
                        self.messages.push((format!("{}: {}", place.connection, message.name), message));
                    }
                    at += n.max(1);
                }
            }
        }
    }
}

/// Plays a report with an arm's decoder and emulator. `progress` gets the part that was played, until `interrupted`.
pub fn replay(
    report: &Report,
    chunks: &[Chunk],
    row: &AdapterSpec,
    progress: &mut dyn FnMut(f64),
    interrupted: &dyn Fn() -> bool,
) -> AdapterResult<Comparison> {
    let wire = row.wire.ok_or(AdapterError::Unsupported)?;
    let all = decode(&wire, &report.connections, chunks);
    // What goes wrong on purpose is decoded, and not played: the emulator has no hand at its E-stop.
    let end = report.steps.iter().find(|step| step.step == ERRORS).map_or(u64::MAX, |step| step.time.0);
    let until = chunks.iter().position(|chunk| chunk.at >= end).unwrap_or(chunks.len());
    let chunks = chunks.get(..until).unwrap_or_default();
    let arm = decode(&wire, &report.connections, chunks);
    let played = play(report, chunks, row, &wire, progress, interrupted)?;
    let emulator = decode(&wire, &report.connections, &played.chunks);

    let mut comparison = Comparison { damaged: (all.damaged, all.bytes), ..Comparison::default() };
    let kinds = &mut comparison.kinds;
    for (name, message) in &all.messages {
        kinds.entry(name.clone()).or_default().wrong += usize::from(message.wrong.is_some());
    }
    for (name, message) in &arm.messages {
        let kind = kinds.entry(name.clone()).or_default();
        kind.arm += 1;
        kind.failures.0 += usize::from(message.status != 0);
    }
    for (name, message) in &emulator.messages {
        let kind = kinds.entry(name.clone()).or_default();
        kind.emulator += 1;
        kind.failures.1 += usize::from(message.status != 0);
    }
    kinds.values_mut().for_each(|kind| kind.difference = difference(kind));
    if all.damaged as f64 > DAMAGED * all.bytes as f64 {
        comparison.differences.push(format!("{} of {} bytes from the arm are no message", all.damaged, all.bytes));
    }
    if all.messages.is_empty() {
        comparison.differences.push("the report has no message from the arm".to_owned());
    }
    Ok(comparison)
}

fn difference(kind: &Kind) -> Option<String> {
    let share = |failures: usize, of: usize| failures as f64 / of.max(1) as f64;
    let (arm, emulator) = (share(kind.failures.0, kind.arm), share(kind.failures.1, kind.emulator));
    match kind {
        Kind { wrong, .. } if *wrong > 0 => Some(format!("the adapter's decoder does not take {wrong} of them")),
        Kind { arm: 0, emulator: 0, .. } => None, // only while things went wrong
        Kind { emulator: 0, .. } => Some("only the arm sends it".to_owned()),
        Kind { arm: 0, .. } => Some("only the emulator sends it".to_owned()),
        _ if (arm - emulator).abs() > SHARE => Some(format!(
            "{:.0} % of the arm's report a failure, {:.0} % of the emulator's",
            100.0 * arm,
            100.0 * emulator
        )),
        _ => None,
    }
}

/// One connection to the emulator.
enum Player {
    Tcp(TcpLink),
    Serial(SerialLink),
    Can(Box<dyn CanPort>),
    Udp(UdpLink, Option<SocketAddr>),
}

impl Player {
    /// Opens the connection that had this name in the report.
    fn open(row: &AdapterSpec, line: &Line, peer: &str) -> AdapterResult<Self> {
        const WAIT: Duration = Duration::from_secs(2);
        let wrong = AdapterError::Protocol;
        Ok(match (row.transport, line.datagrams) {
            ("serial", _) => Self::Serial(SerialLink::connect("the emulator", peer, BAUD, WAIT)?),
            ("can", _) => Self::Can(can::open("the emulator", &CanAddress::parse(peer).map_err(wrong)?, &[])?),
            (_, true) => {
                let here = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), line.port.unwrap_or_default());
                let udp = UdpLink::bind(here, &line.name).map_err(|e| AdapterError::Io(format!("{here}: {e}")))?;
                udp.set_nonblocking(true).map_err(|e| AdapterError::Io(e.to_string()))?;
                Self::Udp(udp, None)
            }
            _ => {
                let address = peer.trim_start_matches("tcp:");
                Self::Tcp(TcpLink::connect("the emulator", &Endpoint::parse(address, 1).map_err(wrong)?, WAIT)?)
            }
        })
    }

    /// Sends bytes of the report. An emulator that closed a connection takes none; that shows in what it sends.
    fn send(&mut self, bytes: &[u8]) {
        match self {
            Self::Tcp(link) => drop(link.send(bytes)),
            Self::Serial(link) => drop(link.send(bytes)),
            Self::Udp(udp, Some(peer)) => drop(udp.send_to(bytes, *peer)),
            Self::Udp(_, None) => {}
            Self::Can(port) => {
                if let Some((id, data)) = bytes.split_first_chunk() {
                    drop(port.send(&[CanFrame::new(u16::from_be_bytes(*id), data)]));
                }
            }
        }
    }

    /// Takes what has come; the capture keeps it.
    fn take(&mut self) {
        let all = |bytes: &[u8]| Scan::Take(bytes.len(), ());
        match self {
            Self::Tcp(link) => while link.poll(all).is_ok_and(|some| some.is_some()) {},
            Self::Serial(link) => while link.receive(Duration::ZERO, all).is_ok() {},
            Self::Udp(udp, peer) => {
                let mut room = [0; 4096];
                while let Ok((_, source)) = udp.recv_from(&mut room) {
                    *peer = Some(source);
                }
            }
            Self::Can(port) => while matches!(port.receive(), Ok(Some(CanEvent::Frame(_) | CanEvent::Trouble(_)))) {},
        }
    }
}

/// Sends to the emulator what was sent to the arm, at the same pace. Returns what came back, with the connections of
/// the report.
fn play(
    report: &Report,
    chunks: &[Chunk],
    row: &AdapterSpec,
    wire: &Wire,
    progress: &mut dyn FnMut(f64),
    interrupted: &dyn Fn() -> bool,
) -> AdapterResult<Capture> {
    let start = row.emulate.ok_or(AdapterError::Unsupported)?;
    let mut config = AdapterConfig {
        hardware_id: row.name.to_owned(),
        address: String::new(),
        dof: report.dof,
        options: report.options.clone(),
    };
    if config.options.is_null() {
        config.options = json!({});
    }
    if let Some(sim) = config.options.as_object_mut().map(|all| all.entry("sim").or_insert_with(|| json!({}))) {
        // The planned ways are those of the arm: they begin where it was.
        if let Some(sim) = sim.as_object_mut() {
            sim.entry("initial_positions").or_insert_with(|| json!(report.pose));
        }
    }
    let emulator = match start(&config, &EmulatorAddress::InProcess) {
        Ok(emulator) => emulator,
        Err(_) => {
            // Its pose has other joints, such as a gripper's: the emulator's own pose.
            if let Some(sim) = config.options.get_mut("sim").and_then(Value::as_object_mut) {
                sim.remove("initial_positions");
            }
            start(&config, &EmulatorAddress::InProcess)?
        }
    };
    let peers = (wire.connections)(&emulator.address());
    let peer = |line: &Line| peers.iter().find(|(name, _)| *name == line.name).map(|(_, peer)| peer.clone());
    capture::start();
    let mut players: Vec<Option<Player>> = Vec::new();
    let began = MonotonicClock.now();
    let (mut due, mut last) = (0, chunks.first().map_or(0, |chunk| chunk.at));
    for (i, chunk) in chunks.iter().enumerate() {
        due += chunk.at.saturating_sub(last).min(PAUSE);
        last = chunk.at;
        while began.after(Duration::from_micros(due)) > MonotonicClock.now() {
            players.iter_mut().flatten().for_each(Player::take);
            let left = began.after(Duration::from_micros(due)).since(MonotonicClock.now());
            std::thread::sleep(left.min(Duration::from_millis(1)));
        }
        if interrupted() {
            break;
        }
        // In the order in which they were opened: an arm sends to a port that it was given before.
        while players.len() <= chunk.connection {
            let Some(line) = report.connections.get(players.len()) else { break };
            // One that has the same name has ended, after its answers: the emulator may be slower than the arm.
            let same = |i: usize| report.connections.get(i).is_some_and(|old| old.name == line.name);
            if !line.datagrams && players.iter().enumerate().any(|(i, player)| player.is_some() && same(i)) {
                due += AFTER.as_micros() as u64;
                take_all(&mut players, AFTER);
                players.iter_mut().enumerate().filter(|(i, _)| same(*i)).for_each(|(_, player)| *player = None);
            }
            let address = peer(line).ok_or_else(|| AdapterError::Protocol(format!("no connection {:?}", line.name)))?;
            players.push(Some(Player::open(row, line, &address)?));
        }
        if chunk.sent
            && let Some(player) = players.get_mut(chunk.connection).and_then(Option::as_mut)
        {
            player.send(&chunk.bytes);
        }
        if i % 64 == 0 {
            progress(i as f64 / chunks.len() as f64);
        }
    }
    take_all(&mut players, AFTER);
    drop(players);
    Ok(capture::finish())
}

/// Takes what comes for this time.
fn take_all(players: &mut [Option<Player>], time: Duration) {
    let end = MonotonicClock.now().after(time);
    while MonotonicClock.now() < end {
        players.iter_mut().flatten().for_each(Player::take);
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_only_one_side_sends_or_refuses_is_a_difference() {
        let of = |arm, emulator, failures| difference(&Kind { arm, emulator, failures, ..Kind::default() });
        assert_eq!(of(1, 0, (0, 0)).as_deref(), Some("only the arm sends it"));
        assert_eq!(of(0, 1, (0, 0)).as_deref(), Some("only the emulator sends it"));
        assert!(of(10, 10, (5, 0)).unwrap().contains("50 % of the arm's report a failure, 0 %"));
        assert_eq!(of(10, 12, (1, 0)), None);
        assert_eq!(of(0, 0, (0, 0)), None);
    }
}
