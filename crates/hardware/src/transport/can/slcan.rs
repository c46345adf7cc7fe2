//! Serial CAN adapters with slcan, the ASCII protocol of LAWICEL's adapters: every frame is a line, `t` with the
//! identifier, the number of bytes and the bytes in hexadecimal digits, ended by a carriage return.
//!
//! Such an adapter reports no trouble on the bus: missing acknowledgements only show in missing answers. Its replies to
//! commands (a carriage return, or a bell for "no") are ignored, since many models do not reply. The `z` that some send
//! for each frame is counted, and limits the number of waiting frames.

use std::cell::Cell;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::{Duration, Instant};

use rustix::event::PollFlags;
use rustix::io::Errno;
use rustix::termios::{QueueSelector, tcflush};

use super::address::SLCAN_RATES;
use super::{CanEvent, CanFilter, CanFrame, CanPort};
use crate::adapter::{AdapterError, AdapterResult};
use crate::transport::incoming::{Incoming, Scan};
use crate::transport::serial::{broken, open_line, read_line, wait};

/// Rate of the serial line [bit/s]: adapters on USB take any and ignore it.
const BAUD: u32 = 115_200;
/// Maximum line length: an extended frame with eight bytes and a time stamp.
pub(super) const MAX_LINE: usize = 32;
/// Length of a frame's line without its data: `tIIIL`.
const HEAD: usize = 5;
/// A reply that is missing for this time was lost.
const REPLY_LOST: Duration = Duration::from_millis(200);
/// Minimum number of waiting frames when the kernel has no room for more.
const BACKLOG: usize = 16;
const DIGITS: &[u8; 16] = b"0123456789ABCDEF";

/// A port on a serial CAN adapter.
pub struct SlcanPort {
    line: Lines<OwnedFd>,
    filters: Vec<CanFilter>,
    /// Commands that open the channel.
    opening: [u8; 8],
    /// Frames without a reply, whether the adapter replies to frames at all, and when the last one was written.
    unanswered: usize,
    replies: bool,
    written_at: Instant,
}

/// Opens the serial CAN adapter at `path` and its channel with `bit_rate` [bit/s], one of [`SLCAN_RATES`].
pub fn open(device: &str, path: &str, bit_rate: u32, filters: &[CanFilter]) -> AdapterResult<SlcanPort> {
    let failed = |why: &str| AdapterError::Io(format!("cannot open CAN adapter {path} for {device}: {why}"));
    let code = SLCAN_RATES.iter().position(|rate| *rate == bit_rate);
    let code = code.ok_or_else(|| failed(&format!("slcan has no bit rate {bit_rate}")))?;
    let mut line = Lines::new(open_line(device, path, BAUD)?, format!("{device} at {path}"));
    // The first carriage return ends any unfinished line of another program. The rate can only be set on a closed
    // channel.
    let opening = [b'\r', b'C', b'\r', b'S', b'0' + code as u8, b'\r', b'O', b'\r'];
    if !line.put(&opening)? {
        return Err(failed("it takes no bytes"));
    }
    let (filters, written_at) = (filters.to_vec(), Instant::now());
    Ok(SlcanPort { line, filters, opening, unanswered: 0, replies: false, written_at })
}

impl CanPort for SlcanPort {
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize> {
        let taken = self.line.put_frames(frames)?;
        self.unanswered += taken;
        self.written_at = Instant::now();
        Ok(taken)
    }

    fn receive(&mut self) -> AdapterResult<Option<CanEvent>> {
        let (filters, taken) = (&self.filters, Cell::new(0_usize));
        let wanted = |line: &[u8]| match line {
            [b'z' | b'Z'] => {
                taken.set(taken.get() + 1);
                None
            }
            line => decode(line).filter(|frame| CanFilter::any(filters, frame.id)),
        };
        let found = self.line.next(wanted, read_line);
        if taken.get() > 0 {
            (self.replies, self.unanswered) = (true, self.unanswered.saturating_sub(taken.get()));
        }
        let Some(frame) = found? else { return Ok(None) };
        // An adapter that passes on frames has processed earlier lines: the reply was lost.
        if self.unanswered > 0 && self.written_at.elapsed() > REPLY_LOST {
            self.unanswered = 0;
        }
        Ok(Some(CanEvent::Frame(frame)))
    }

    fn fd(&self) -> BorrowedFd<'_> {
        self.line.fd.as_fd()
    }

    /// Returns the number of frames without a reply, for an adapter that replies. For others, the kernel reports when
    /// about 256 bytes wait.
    fn waiting(&self) -> usize {
        let room = || wait(&self.line.fd, PollFlags::OUT, Duration::ZERO).unwrap_or(false);
        if self.replies {
            self.unanswered
        } else if room() {
            0
        } else {
            BACKLOG
        }
    }

    /// Discards what neither the serial line nor the adapter has sent; closing its channel clears the adapter's queue.
    fn discard(&mut self) -> AdapterResult<usize> {
        tcflush(&self.line.fd, QueueSelector::OFlush).map_err(|e| broken(&self.line.peer, e))?;
        self.line.rest.1 = 0;
        self.unanswered = 0;
        let opened = self.line.put(&self.opening)?;
        Ok(if opened { 0 } else { BACKLOG })
    }
}

impl Drop for SlcanPort {
    fn drop(&mut self) {
        // Stops the adapter from sending further.
        let _ = self.line.put(b"C\r");
    }
}

/// Returns the line of a frame and its length; `None` for an identifier over 11 bits.
pub(super) fn encode(frame: &CanFrame) -> Option<([u8; MAX_LINE], usize)> {
    let digit = |value: usize| DIGITS.get(value & 0xF).copied().unwrap_or(b'0');
    let (id, bytes) = (usize::from(frame.id), frame.bytes());
    let head = [b't', digit(id >> 8), digit(id >> 4), digit(id), digit(bytes.len())];
    let data = bytes.iter().flat_map(|byte| [digit(usize::from(byte >> 4)), digit(usize::from(*byte))]);
    let mut line = [0; MAX_LINE];
    line.iter_mut().zip(head.into_iter().chain(data).chain([b'\r'])).for_each(|(to, from)| *to = from);
    (id <= 0x7FF).then_some((line, HEAD + 2 * bytes.len() + 1))
}

/// Parses the frame in a line without its end; `None` for anything else. A time stamp behind it is ignored.
pub(super) fn decode(line: &[u8]) -> Option<CanFrame> {
    let digit = |at: usize| char::from(*line.get(at)?).to_digit(16);
    if line.first() != Some(&b't') {
        return None;
    }
    let id = digit(1)? << 8 | digit(2)? << 4 | digit(3)?;
    let len = digit(4)? as usize;
    let end = HEAD + 2 * len;
    if id > 0x7FF || len > 8 || !(line.len() == end || line.len() == end + 4) {
        return None;
    }
    let mut data = [0; 8];
    for (i, byte) in data.iter_mut().take(len).enumerate() {
        *byte = (digit(HEAD + 2 * i)? << 4 | digit(HEAD + 2 * i + 1)?) as u8;
    }
    Some(CanFrame { id: id as u16, len: len as u8, data })
}

/// Lines in both directions over a non-blocking descriptor.
pub(super) struct Lines<F> {
    pub(super) fd: F,
    /// Name of the other end, for messages.
    peer: String,
    incoming: Incoming,
    /// The rest of a partly written line; it is sent before anything else.
    rest: ([u8; MAX_LINE], usize),
}

impl<F: AsFd> Lines<F> {
    pub(super) fn new(fd: F, peer: String) -> Self {
        Self { fd, peer, incoming: Incoming::new(), rest: ([0; MAX_LINE], 0) }
    }

    /// Writes lines of at most [`MAX_LINE`] bytes in total; `false` if there is no room. A partly written line counts
    /// as written.
    pub(super) fn put(&mut self, bytes: &[u8]) -> AdapterResult<bool> {
        let (rest, len) = self.rest;
        if len > 0 {
            let old = rest.get(..len).unwrap_or_default();
            let n = self.write(old)?;
            self.keep(old, n);
            if n < len {
                return Ok(false);
            }
        }
        let n = self.write(bytes)?;
        if n > 0 {
            self.keep(bytes, n);
        }
        Ok(n > 0 || bytes.is_empty())
    }

    /// Writes frames. Returns for how many there was room.
    pub(super) fn put_frames(&mut self, frames: &[CanFrame]) -> AdapterResult<usize> {
        for (taken, frame) in frames.iter().enumerate() {
            let Some((line, len)) = encode(frame) else {
                return Err(AdapterError::Protocol(format!("{:#x} is no CAN identifier of 11 bits", frame.id)));
            };
            if !self.put(line.get(..len).unwrap_or_default())? {
                return Ok(taken);
            }
        }
        Ok(frames.len())
    }

    /// Returns the first value that `wanted` finds in an arrived line (passed without its end). Reads at most once, so
    /// that a flood of bytes does not block the caller.
    pub(super) fn next<T>(
        &mut self,
        wanted: impl Fn(&[u8]) -> Option<T>,
        read: impl FnOnce(&F, &str, &mut [u8]) -> AdapterResult<usize>,
    ) -> AdapterResult<Option<T>> {
        let Self { fd, peer, incoming, .. } = self;
        let scan = |bytes: &[u8]| match bytes.iter().position(|b| matches!(b, b'\r' | b'\x07')) {
            Some(end) => match bytes.get(..end).and_then(&wanted) {
                Some(found) => Scan::Take(end + 1, found),
                None => Scan::Skip(end + 1),
            },
            // Longer than any line: noise, up to the next end of a line.
            None if bytes.len() > MAX_LINE => Scan::Skip(bytes.len()),
            None => Scan::More,
        };
        if let Some(found) = incoming.next(scan) {
            return Ok(Some(found));
        }
        match incoming.fill(peer, |room| read(fd, peer, room))? {
            0 => Ok(None),
            _ => Ok(incoming.next(scan)),
        }
    }

    fn write(&self, bytes: &[u8]) -> AdapterResult<usize> {
        match rustix::io::write(&self.fd, bytes) {
            Ok(n) => Ok(n),
            Err(Errno::AGAIN | Errno::INTR) => Ok(0),
            Err(e) => Err(broken(&self.peer, e)),
        }
    }

    /// Keeps the part of `bytes` that is not written yet.
    fn keep(&mut self, bytes: &[u8], written: usize) {
        let rest = bytes.get(written..).unwrap_or_default();
        self.rest.0.iter_mut().zip(rest).for_each(|(to, from)| *to = *from);
        self.rest.1 = rest.len().min(MAX_LINE);
    }
}
