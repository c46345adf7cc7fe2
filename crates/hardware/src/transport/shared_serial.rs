//! A serial line that several arms of a run share: the port is opened once, and one exchange at a time has the line, in
//! the order in which they came. A broken line is broken for all of them.

use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, Weak};
use std::time::Duration;

use super::Scan;
use super::request_reply::ByteLink;
use super::serial::SerialLink;
use crate::adapter::{AdapterError, AdapterResult};
use dimos_core::sync::lock;

/// The open lines of this process.
static LINES: Mutex<Vec<Weak<Line>>> = Mutex::new(Vec::new());

/// An arm's share of a line. The last one that is dropped closes the port.
#[derive(Debug)]
pub struct SharedLink {
    line: Arc<Line>,
}

#[derive(Debug)]
struct Line {
    /// The device behind all links to it.
    device: PathBuf,
    baud: u32,
    /// The port, or why it is broken.
    link: Mutex<AdapterResult<SerialLink>>,
    /// The number of the next exchange, and of the one that has the line.
    turns: Mutex<(u64, u64)>,
    turned: Condvar,
}

/// The line is free for the next exchange when this is dropped.
struct Turn<'a>(&'a Line);

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        lock(&self.0.turns).1 += 1;
        self.0.turned.notify_all();
    }
}

impl Line {
    /// Waits until the exchanges before this one have ended. Each has timeouts.
    fn turn(&self) -> Turn<'_> {
        let mut turns = lock(&self.turns);
        let own = turns.0;
        turns.0 += 1;
        while turns.1 != own {
            turns = self.turned.wait(turns).unwrap_or_else(std::sync::PoisonError::into_inner);
        }
        Turn(self)
    }
}

impl SharedLink {
    /// Joins the line at `path`, or opens it as [`SerialLink::connect`] does. `Rejected` if it is open at another rate.
    pub fn connect(device: &str, path: &str, baud: u32, timeout: Duration) -> AdapterResult<Self> {
        let place = std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
        let mut lines = lock(&LINES);
        lines.retain(|line| line.strong_count() > 0);
        let open = { lines.iter() }.filter_map(Weak::upgrade).find(|line| line.device == place);
        if let Some(line) = open.filter(|line| lock(&line.link).is_ok()) {
            if line.baud != baud {
                let what = format!("{device} at {path}: another arm of this run has the line at {} bit/s", line.baud);
                return Err(AdapterError::Rejected(format!("{what}\nhint: give both the same rate")));
            }
            return Ok(Self { line });
        }
        let link = Mutex::new(Ok(SerialLink::connect(device, path, baud, timeout)?));
        let line = Line { device: place, baud, link, turns: Mutex::default(), turned: Condvar::new() };
        let line = Arc::new(line);
        lines.push(Arc::downgrade(&line));
        Ok(Self { line })
    }

    /// Uses the port; closes it if it breaks.
    fn with<T>(&self, act: impl FnOnce(&mut SerialLink) -> AdapterResult<T>) -> AdapterResult<T> {
        let mut link = lock(&self.line.link);
        let result = act(link.as_mut().map_err(|error| error.clone())?);
        if let Err(error @ AdapterError::Io(_)) = &result {
            *link = Err(error.clone());
        }
        result
    }
}

impl ByteLink for SharedLink {
    fn exchange<T>(&mut self, make: impl FnOnce(&mut Self) -> T) -> T {
        let line = self.line.clone();
        let _turn = line.turn();
        make(self)
    }

    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        self.with(|link| link.send(bytes))
    }

    fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
        self.with(|link| link.receive(timeout, scan))
    }

    fn drain(&mut self) -> AdapterResult<()> {
        self.with(SerialLink::drain)
    }

    /// Discards unsent bytes between two exchanges, so that those of another arm are not among them.
    fn abort(mut self) {
        // A line that cannot be flushed is broken already.
        let _ = self.exchange(|link| link.with(|link| link.discard()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::serial::Pty;
    use std::time::Instant;

    const WAIT: Duration = Duration::from_secs(10);

    fn two(pty: &Pty) -> [SharedLink; 2] {
        [(); 2].map(|()| SharedLink::connect("test", pty.path(), 9600, WAIT).unwrap())
    }

    #[test]
    fn exchanges_take_turns_in_the_order_in_which_they_came() {
        let pty = Pty::open().unwrap();
        let [mut one, mut other] = two(&pty);
        let (begun, come) = std::sync::mpsc::channel();
        std::thread::scope(|scope| {
            let busy = scope.spawn(move || {
                one.exchange(|_| {
                    begun.send(()).unwrap();
                    std::thread::sleep(Duration::from_millis(30));
                });
                // Comes again at once, and after the one that waits.
                let after = Instant::now();
                one.exchange(|_| ());
                after.elapsed()
            });
            come.recv().unwrap();
            let began = Instant::now();
            other.exchange(|_| {
                assert!(began.elapsed() < Duration::from_millis(500));
                std::thread::sleep(Duration::from_millis(20));
            });
            assert!(busy.join().unwrap() >= Duration::from_millis(15));
        });
    }

    #[test]
    fn a_line_has_one_rate_and_breaks_for_all() {
        let pty = Pty::open().unwrap();
        let [mut one, mut other] = two(&pty);
        let refused = SharedLink::connect("test", pty.path(), 19200, WAIT).unwrap_err().to_string();
        assert!(refused.contains("at 9600 bit/s"), "{refused}");
        let path = pty.path().to_owned();
        drop(pty);
        let gone = one.send(b"x").unwrap_err();
        assert!(matches!(gone, AdapterError::Io(_)));
        assert_eq!(other.send(b"x"), Err(gone));
        assert!(SharedLink::connect("test", &path, 9600, WAIT).is_err(), "the broken one is not joined");
    }

    #[test]
    fn the_last_one_closes_the_port() {
        let pty = Pty::open().unwrap();
        let [one, other] = two(&pty);
        drop(one);
        assert!(SerialLink::connect("test", pty.path(), 9600, WAIT).is_err());
        other.abort();
        SerialLink::connect("test", pty.path(), 9600, WAIT).unwrap();
    }
}
