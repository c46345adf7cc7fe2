//! The way to a run's socket: a path, or `@NAME` for an abstract one. One of another user is refused, except to root.

use std::io::{self, ErrorKind};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::net::SocketAddrUnix;

use dimos_rt::abstract_name;

/// Maximum wait for a place in the queue of a run's connections, and the pause between attempts.
const TIMEOUT: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(5);

/// Why there is no connection.
pub enum Unreached {
    /// The kernel refuses it.
    Io(io::Error),
    /// This user listens there.
    OtherUser(u32),
}

impl From<io::Error> for Unreached {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<Unreached> for io::Error {
    fn from(unreached: Unreached) -> Self {
        match unreached {
            Unreached::Io(error) => error,
            Unreached::OtherUser(uid) => Self::new(ErrorKind::PermissionDenied, format!("it belongs to user {uid}")),
        }
    }
}

/// Opens a connection. Never blocks, and the stream does not block either.
pub fn open(socket: &Path) -> io::Result<UnixStream> {
    Ok(connect(socket)?)
}

/// Returns whether a process listens there. Never blocks.
pub fn is_there(socket: &Path) -> bool {
    match connect(socket) {
        Ok(_) => true,
        // A full queue is that of a process.
        Err(Unreached::Io(error)) => error.kind() == ErrorKind::WouldBlock,
        Err(Unreached::OtherUser(_)) => false,
    }
}

/// Opens a connection whose stream blocks. Waits while the queue is full: many clients connect at once, or the run
/// takes no connections.
pub fn wait_for(socket: &Path) -> Result<UnixStream, Unreached> {
    let deadline = Instant::now() + TIMEOUT;
    loop {
        match connect(socket) {
            Err(Unreached::Io(error)) if error.kind() == ErrorKind::WouldBlock && Instant::now() < deadline => {
                std::thread::sleep(PAUSE);
            }
            Ok(stream) => return Ok(stream.set_nonblocking(false).map(|()| stream)?),
            unreached => return unreached,
        }
    }
}

fn connect(socket: &Path) -> Result<UnixStream, Unreached> {
    let address = match socket.as_os_str().as_bytes().strip_prefix(b"@") {
        Some(name) => SocketAddrUnix::new_abstract_name(name),
        None => SocketAddrUnix::new(socket),
    };
    let stream = abstract_name::open(&address.map_err(io::Error::from)?).map_err(io::Error::from)?;
    let (us, listener) = (rustix::process::geteuid().as_raw(), abstract_name::peer(&stream)?.uid);
    if us == 0 || listener == us { Ok(stream) } else { Err(Unreached::OtherUser(listener)) }
}
