//! The primary interface: who the controller is, what its errors are, and why a program fails.

use super::Reader;
use dimos_core::arm::Dh;
use dimos_hardware::transport::Scan;

/// Types of packets, of messages and of parts of the state that are used here.
const STATE: u8 = 16;
const MESSAGE: u8 = 20;
const KINEMATICS: u8 = 5;
const CONFIGURATION: u8 = 6;
const VERSION: u8 = 3;
const ERROR: u8 = 6;
const EXCEPTION: u8 = 10;
/// Shortest packet, the longest one that is decoded, and the longest one there may be.
const SHORTEST: usize = 5;
const DECODED: usize = 4096;
const LONGEST: usize = 1 << 20;
/// Types of packets are below this.
const KINDS: u8 = 64;
/// Levels of errors, from which on one is kept: 2 is a warning, which every protective stop has.
pub const WARNING: i32 = 2;
/// Added to the level of an error for the vendor's developers.
const DEVELOPER: i32 = 128;

/// What the configuration says.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Configuration {
    /// Lowest and highest position of each joint [rad].
    pub ranges: [(f64, f64); 6],
    /// Top speed of each joint [rad/s].
    pub speeds: [f64; 6],
    /// Type of the robot.
    pub kind: u32,
}

/// The arm's own Denavit-Hartenberg parameters, measured at the factory.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Kinematics {
    /// Checksum of each joint's parameters.
    pub checksum: [u32; 6],
    /// The parameters, from the base.
    pub joints: [Dh; 6],
}

impl Kinematics {
    /// Largest length [m] and angle [rad] that can be true: axes that are almost parallel have their common normal far
    /// away.
    const LARGEST: (f64, f64) = (1e6, 10.0);

    fn is_possible(&self) -> bool {
        let (far, wide) = Self::LARGEST;
        let is_possible =
            |dh: &Dh| dh.a.abs() < far && dh.d.abs() < far && dh.theta.abs() < wide && dh.alpha.abs() < wide;
        self.joints.iter().all(is_possible) && self.joints.iter().any(|dh| dh.a != 0.0 || dh.d != 0.0)
    }
}

/// What a state says of the arm. The controller sends these parts on a new connection, and when they change.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct About {
    /// Limits and type.
    pub configuration: Option<Configuration>,
    /// Dimensions.
    pub kinematics: Option<Kinematics>,
}

/// A packet that matters here. Only an exception allocates.
#[allow(clippy::large_enum_variant, reason = "a box would allocate in the cycle of reads")]
#[derive(Debug, Clone, PartialEq)]
pub enum Packet {
    /// Version of the controller's software: major, minor, bugfix.
    Version(u8, u8, i32),
    /// A state with a configuration or with kinematics.
    About(About),
    /// An error.
    Error {
        /// C code.
        code: i32,
        /// A argument.
        argument: i32,
        /// Level, from 0 (debug) to 5 (critical).
        level: i32,
    },
    /// A program failed at this line, counted from 1.
    Exception {
        /// Line.
        line: i32,
        /// What is wrong.
        text: String,
    },
    /// Anything else.
    Other,
}

/// Scans for the next packet.
pub fn scan(bytes: &[u8]) -> Scan<Packet> {
    let [a, b, c, d, kind, ..] = bytes else { return Scan::More };
    let size = i32::from_be_bytes([*a, *b, *c, *d]) as usize;
    if !(SHORTEST..=LONGEST).contains(&size) || *kind >= KINDS {
        return Scan::Skip(1);
    }
    if size > DECODED {
        return Scan::Skip(size);
    }
    match bytes.get(5..size) {
        None => Scan::More,
        Some(content) => Scan::Take(size, decode(*kind, content)),
    }
}

fn decode(kind: u8, content: &[u8]) -> Packet {
    match kind {
        STATE => about(content).map_or(Packet::Other, Packet::About),
        MESSAGE => message(&mut Reader::new(content)).unwrap_or(Packet::Other),
        _ => Packet::Other,
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).trim_matches(['\0', ' ']).to_owned()
}

/// Decodes a message; `None` for one that is cut off or does not matter.
fn message(reader: &mut Reader<'_>) -> Option<Packet> {
    reader.take(9); // time and source
    let packet = match reader.u8() {
        VERSION => {
            let length = reader.u8();
            reader.take(length.into());
            Packet::Version(reader.u8(), reader.u8(), reader.i32())
        }
        ERROR => {
            let (code, argument, level) = (reader.i32(), reader.i32(), reader.i32());
            Packet::Error { code, argument, level: if level >= DEVELOPER { level - DEVELOPER } else { level } }
        }
        EXCEPTION => {
            let (line, _) = (reader.i32(), reader.i32());
            Packet::Exception { line, text: text(reader.rest()) }
        }
        _ => return None,
    };
    reader.ok.then_some(packet)
}

/// Finds configuration and kinematics among the parts of a state; `None` without either.
fn about(content: &[u8]) -> Option<About> {
    let (mut reader, mut about) = (Reader::new(content), About::default());
    loop {
        let (length, kind) = (reader.u32(), reader.u8());
        let body = reader.take((length as usize).saturating_sub(5));
        if !reader.ok || length < 5 {
            break;
        }
        let mut body = Reader::new(body);
        match kind {
            CONFIGURATION => about.configuration = configuration(&mut body),
            KINEMATICS => about.kinematics = kinematics(&mut body),
            _ => {}
        }
    }
    (about != About::default()).then_some(about)
}

fn configuration(body: &mut Reader<'_>) -> Option<Configuration> {
    let ranges = std::array::from_fn(|_| (body.f64(), body.f64()));
    let speeds = std::array::from_fn(|_| (body.f64(), body.f64()).0);
    body.take(5 * 8 + 4 * 6 * 8 + 2 * 4);
    let found = Configuration { ranges, speeds, kind: body.u32() };
    body.ok.then_some(found)
}

/// Checksums, then theta, a, d, alpha of all joints.
fn kinematics(body: &mut Reader<'_>) -> Option<Kinematics> {
    let checksum = std::array::from_fn(|_| body.u32());
    let mut list = || -> [f64; 6] { std::array::from_fn(|_| body.f64()) };
    let (theta, a, d, alpha) = (list(), list(), list(), list());
    #[allow(clippy::indexing_slicing, reason = "four lists of six")]
    let joints = std::array::from_fn(|i| Dh { theta: theta[i], a: a[i], d: d[i], alpha: alpha[i] });
    let found = Kinematics { checksum, joints };
    (body.ok && found.is_possible()).then_some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(kind: u8, content: &[u8]) -> Vec<u8> {
        [&(5 + content.len() as i32).to_be_bytes()[..], &[kind], content].concat()
    }

    fn said(kind: u8, body: &[u8]) -> Packet {
        let bytes = packet(MESSAGE, &[&[0; 8][..], &[253, kind], body].concat());
        match scan(&bytes) {
            Scan::Take(size, found) if size == bytes.len() => found,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn messages() {
        let version = said(VERSION, b"\x09URControl\x05\x0b\0\0\0\x02\0\0\0\x0901-01-2022");
        assert_eq!(version, Packet::Version(5, 11, 2));
        let error = said(ERROR, b"\0\0\0\x99\0\0\0\x01\0\0\0\x82\0\0\0\0\0\0\0\0text");
        assert_eq!(error, Packet::Error { code: 153, argument: 1, level: 2 });
        let wrong = said(EXCEPTION, b"\0\0\0\x07\0\0\0\x02compile_error_name_not_found:x:");
        assert_eq!(wrong, Packet::Exception { line: 7, text: "compile_error_name_not_found:x:".into() });
        assert_eq!(said(0, b"text"), Packet::Other);
        assert_eq!(said(ERROR, b"\0\0"), Packet::Other, "cut off");
    }

    #[test]
    fn the_configuration_is_found_behind_other_parts() {
        let mut body = Vec::new();
        (0..6).for_each(|j| [-f64::from(j), f64::from(j)].iter().for_each(|v| body.extend(v.to_be_bytes())));
        (0..6).for_each(|j| [f64::from(j) / 2.0, 9.0].iter().for_each(|v| body.extend(v.to_be_bytes())));
        body.extend([0; 5 * 8 + 4 * 6 * 8 + 8]);
        body.extend([0, 0, 0, 7, 0, 0, 0, 1]);
        assert_eq!(body.len() + 5, 445, "the vendor's own size");
        let part = |kind: u8, body: &[u8]| [&(5 + body.len() as u32).to_be_bytes()[..], &[kind], body].concat();
        let state = packet(STATE, &[part(0, &[1; 42]), part(CONFIGURATION, &body), part(7, &[])].concat());
        let Scan::Take(_, Packet::About(about)) = scan(&state) else { panic!("no configuration") };
        let found = about.configuration.unwrap();
        assert_eq!((found.kind, found.ranges[2], found.speeds[4]), (7, (-2.0, 2.0), 2.0));
        assert_eq!(scan(&packet(STATE, &part(0, &[1; 42]))), Scan::Take(52, Packet::Other));
        assert_eq!(scan(&packet(STATE, &[0, 0, 9, 9, 0])), Scan::Take(10, Packet::Other), "a part that is cut off");
    }

    #[test]
    fn kinematics_are_those_of_six_joints() {
        let mut body: Vec<u8> = (1..=6_u32).flat_map(u32::to_be_bytes).collect();
        (1..=24).for_each(|i| body.extend(f64::from(i).mul_add(0.25, 0.0).to_be_bytes()));
        body.extend([0; 4]);
        let part = |body: &[u8]| [&(5 + body.len() as u32).to_be_bytes()[..], &[KINEMATICS], body].concat();
        assert_eq!(part(&body).len(), 225, "the vendor's own size");
        let of = |body: &[u8]| match scan(&packet(STATE, &part(body))) {
            Scan::Take(_, Packet::About(about)) => about.kinematics,
            _ => None,
        };
        let found = of(&body).unwrap();
        assert_eq!(found.checksum, [1, 2, 3, 4, 5, 6]);
        assert_eq!(found.joints[1], Dh { theta: 0.5, a: 2.0, d: 3.5, alpha: 5.0 });
        assert_eq!(of(&body[..200]), None, "cut off");
        body[24..32].copy_from_slice(&f64::NAN.to_be_bytes());
        assert_eq!(of(&body), None);
        assert_eq!(of(&[0; 220]), None, "an arm has dimensions");
    }

    #[test]
    fn long_packets_are_skipped_as_a_whole() {
        let bytes = packet(STATE, &[0; 9000]);
        assert_eq!(scan(&bytes[..100]), Scan::Skip(9005));
        let absurd = [&(1_i32 << 21).to_be_bytes()[..], &[STATE, 0]].concat();
        assert_eq!(scan(&absurd), Scan::Skip(1));
    }

    #[test]
    fn packets_come_in_pieces_and_among_noise() {
        let bytes = packet(25, &[1, 2, 3]);
        assert_eq!(scan(&bytes[..7]), Scan::More);
        assert_eq!(scan(&[0xFF, 0, 0, 0, 1, 2]), Scan::Skip(1));
        assert_eq!(scan(&bytes), Scan::Take(8, Packet::Other));
    }
}
