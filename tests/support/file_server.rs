//! A web server on the loopback interface that serves one file and misbehaves on request.

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What it does with its connections, one after the other; after the last, as it should.
#[derive(Debug, Clone, Copy)]
pub enum Misdeed {
    /// Sends this number of bytes of the range, then closes the connection.
    Cut(usize),
    /// Answers with this status and no file.
    Status(u16),
    /// Sends all of the file, whatever was asked for.
    NoRanges,
    /// Answers a request for the rest with another part than was asked for.
    WrongRange,
}

pub struct FileServer {
    address: std::net::SocketAddr,
    /// The `Range` of each request, empty where there was none.
    ranges: Arc<Mutex<Vec<String>>>,
    over: Arc<AtomicBool>,
}

impl FileServer {
    pub fn new(file: Vec<u8>, misdeeds: &[Misdeed]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let (ranges, over) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let (seen, end, misdeeds) = (ranges.clone(), over.clone(), misdeeds.to_vec());
        std::thread::spawn(move || {
            let mut misdeeds = misdeeds.into_iter();
            for client in listener.incoming() {
                if end.load(Ordering::Relaxed) {
                    return;
                }
                let _ = serve(client.unwrap(), &file, misdeeds.next(), &seen);
            }
        });
        Self { address, ranges, over }
    }

    pub fn url(&self, path: &str) -> String {
        format!("http://{}/{path}", self.address)
    }

    pub fn ranges(&self) -> Vec<String> {
        self.ranges.lock().unwrap().clone()
    }
}

impl Drop for FileServer {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        let _ = TcpStream::connect(self.address);
    }
}

fn serve(mut to: TcpStream, file: &[u8], misdeed: Option<Misdeed>, seen: &Mutex<Vec<String>>) -> std::io::Result<()> {
    to.set_read_timeout(Some(Duration::from_secs(10)))?;
    let mut lines = BufReader::new(to.try_clone()?).lines();
    let mut range = String::new();
    while let Some(line) = lines.next().transpose()?.filter(|line| !line.is_empty()) {
        if let Some((name, value)) = line.split_once(": ").filter(|(name, _)| name.eq_ignore_ascii_case("range")) {
            assert_eq!(name.to_ascii_lowercase(), "range");
            range = value.to_owned();
        }
    }
    seen.lock().unwrap().push(range.clone());
    if let Some(Misdeed::Status(status)) = misdeed {
        return write!(to, "HTTP/1.1 {status} No\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
    }
    let from = range.strip_prefix("bytes=").and_then(|r| r.trim_end_matches('-').parse::<usize>().ok());
    let from = from.filter(|_| !matches!(misdeed, Some(Misdeed::NoRanges)));
    let length = file.len();
    let body = match from {
        None => {
            write!(to, "HTTP/1.1 200 OK\r\ncontent-length: {length}\r\nconnection: close\r\n\r\n")?;
            file
        }
        Some(from) if from >= length => {
            let head = "HTTP/1.1 416 Range Not Satisfiable\r\ncontent-length: 0\r\nconnection: close\r\n";
            return write!(to, "{head}content-range: bytes */{length}\r\n\r\n");
        }
        Some(from) => {
            let rest = length - from;
            let said = if matches!(misdeed, Some(Misdeed::WrongRange)) { from - 1 } else { from };
            let head = format!("HTTP/1.1 206 Partial Content\r\ncontent-length: {rest}\r\nconnection: close\r\n");
            write!(to, "{head}content-range: bytes {said}-{}/{length}\r\n\r\n", length - 1)?;
            &file[from..]
        }
    };
    match misdeed {
        Some(Misdeed::Cut(at)) => to.write_all(&body[..at.min(body.len())]),
        _ => to.write_all(body),
    }
}
