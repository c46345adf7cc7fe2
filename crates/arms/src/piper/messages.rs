//! The messages of captures: of a frame the identifier (two bytes), then its data.

use super::SPEC;
use super::protocol::{FeedbackFrame, decode};
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::can::CanFrame;
use dimos_hardware::wire::{Message, Place, Wire, no_checksum, whole};

/// How captures of this arm are read.
pub const WIRE: Wire = Wire {
    connections: |address| vec![("bus", (SPEC.address.check)(address).unwrap_or_else(|_| address.to_owned()))],
    scan,
    mend: no_checksum,
};

fn scan(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    let Some((id, data)) = bytes.split_first_chunk() else { return whole(bytes, Message::named("cut").decoded(false)) };
    let frame = CanFrame::new(u16::from_be_bytes(*id), data);
    let name = |what: &str| Message::named(format!("{:03X} {what}", frame.id));
    whole(
        bytes,
        match (place.sent, decode(&frame)) {
            (true, _) => name("command"),
            (_, FeedbackFrame::Damaged) => name("damaged").decoded(false),
            (_, FeedbackFrame::Status(_)) => name("status"),
            (_, FeedbackFrame::Joints(..)) => name("joints"),
            (_, FeedbackFrame::Motor(..)) => name("motor"),
            (_, FeedbackFrame::Driver(..)) => name("driver"),
            (_, FeedbackFrame::Firmware(..)) => name("firmware"),
            (_, FeedbackFrame::Other) => Message::default(),
            _ => name("feedback"),
        },
    )
}
