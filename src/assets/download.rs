//! From an address into a file. What breaks off goes on where it was, where the server can do that.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use ureq::Agent;
use ureq::http::{Response, StatusCode};
use ureq::tls::{Certificate, RootCerts, TlsConfig};

use super::fetch::percent_decoded;
use super::{AssetError, Progress};

/// Largest file that is fetched [bytes].
pub const MAX_BYTES: u64 = 4 << 30;
/// A server may take so long to be found and to accept a connection.
const CONNECT: Duration = Duration::from_secs(10);
/// A server may be silent for so long.
const SILENCE: Duration = Duration::from_secs(30);
/// One connection may last so long.
const LONGEST: Duration = Duration::from_secs(3600);
/// So often in a row a connection may bring nothing new.
const FRUITLESS: u32 = 3;
/// So many connections are made at most.
const CONNECTIONS: u32 = 100;
/// Pause before the next, longer each time.
const PAUSE: Duration = Duration::from_millis(300);

/// Why a connection brought not all.
enum Broken {
    /// The next may bring the rest.
    ForNow(AssetError),
    /// No use to try again.
    ForGood(AssetError),
}

impl From<AssetError> for Broken {
    fn from(error: AssetError) -> Self {
        Self::ForGood(error)
    }
}

/// Fetches a file to `part`, which may hold its beginning already.
pub fn download(url: &str, part: &Path, progress: &mut dyn Progress) -> Result<(), AssetError> {
    if let Some(path) = url.strip_prefix("file://") {
        return copy(&PathBuf::from(percent_decoded(path)), part, progress);
    }
    let agent = agent(url.starts_with("https://"))?;
    let (mut fruitless, mut connections) = (0, 0);
    loop {
        let before = length(part);
        let error = match connection(&agent, url, part, before, progress) {
            Ok(()) => return Ok(()),
            Err(Broken::ForGood(error)) => return Err(error),
            Err(Broken::ForNow(error)) => error,
        };
        connections += 1;
        fruitless = if length(part) > before { 0 } else { fruitless + 1 };
        if fruitless >= FRUITLESS || connections >= CONNECTIONS {
            let kept = length(part);
            let kept = if kept > 0 {
                format!("; {kept} bytes are kept, and the next try goes on there")
            } else {
                String::new()
            };
            return Err(AssetError { what: format!("{}{kept}", error.what), hint: error.hint });
        }
        progress.note(&format!("{error}: trying again"));
        std::thread::sleep(PAUSE * (1 << fruitless.min(4)));
    }
}

fn length(part: &Path) -> u64 {
    fs::metadata(part).map_or(0, |found| found.len())
}

/// A file of this computer.
fn copy(from: &Path, part: &Path, progress: &mut dyn Progress) -> Result<(), AssetError> {
    let there = |e: io::Error| {
        AssetError::new(format!("{}: {e}", from.display()))
            .hint("file:// is followed by the full path of a file of this computer")
    };
    let mut source = File::open(from).map_err(there)?;
    let found = source.metadata().map_err(there)?;
    if !found.is_file() {
        return Err(AssetError::new(format!("{} is no file", from.display())));
    }
    let _ = fs::remove_file(part);
    pour(&mut source, part, 0, Some(found.len()), progress).map_err(|broken| match broken {
        Broken::ForNow(error) | Broken::ForGood(error) => error,
    })
}

fn agent(encrypted: bool) -> Result<Agent, AssetError> {
    let mut config = Agent::config_builder()
        .http_status_as_error(false)
        .user_agent(format!("dimos/{}", crate::VERSION))
        .timeout_resolve(Some(CONNECT))
        .timeout_connect(Some(CONNECT))
        .timeout_recv_response(Some(SILENCE))
        .timeout_per_read(Some(SILENCE))
        .timeout_recv_body(Some(LONGEST));
    if encrypted {
        // Those of the system, so that a company's own are trusted as everywhere else on this computer.
        let found = rustls_native_certs::load_native_certs();
        let trusted: Vec<_> = found.certs.iter().map(|c| Certificate::from_der(c.as_ref()).to_owned()).collect();
        if trusted.is_empty() {
            let error = AssetError::new("this computer trusts no certificates: https cannot be used");
            return Err(error.hint("install them (Debian: apt install ca-certificates), or set SSL_CERT_FILE"));
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let tls = TlsConfig::builder()
            .root_certs(RootCerts::new_with_certs(&trusted))
            .unversioned_rustls_crypto_provider(provider)
            .build();
        config = config.tls_config(tls);
    }
    Ok(config.build().new_agent())
}

/// One connection: asks for what is missing and appends it.
fn connection(agent: &Agent, url: &str, part: &Path, have: u64, progress: &mut dyn Progress) -> Result<(), Broken> {
    let request = agent.get(url);
    let request = if have > 0 { request.header("range", format!("bytes={have}-")) } else { request };
    let mut response = request.call().map_err(|error| unreachable(url, &error))?;
    let status = response.status();
    let said = format!("{url}: the server answered {status}");
    match status {
        StatusCode::OK => {
            // All of it, whatever was asked for.
            let _ = fs::remove_file(part);
            let total = response.body().content_length();
            pour(&mut response.body_mut().as_reader(), part, 0, total, progress)
        }
        StatusCode::PARTIAL_CONTENT if begins_at(&response) == Some(have) => {
            let total = response.body().content_length().map(|rest| have.saturating_add(rest));
            pour(&mut response.body_mut().as_reader(), part, have, total, progress)
        }
        // All is there already: the check sum will tell.
        StatusCode::RANGE_NOT_SATISFIABLE if full_length(&response) == Some(have) => Ok(()),
        StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE => {
            let _ = fs::remove_file(part);
            Err(Broken::ForNow(AssetError::new(format!("{said}, but not to what was asked"))))
        }
        StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_MANY_REQUESTS => Err(Broken::ForNow(AssetError::new(said))),
        _ if status.is_server_error() => Err(Broken::ForNow(AssetError::new(said).hint("try again later"))),
        _ => Err(Broken::ForGood(AssetError::new(said).hint("is the address right? `url` in the blueprint's assets"))),
    }
}

/// Appends what comes.
fn pour(
    from: &mut dyn Read,
    part: &Path,
    have: u64,
    total: Option<u64>,
    progress: &mut dyn Progress,
) -> Result<(), Broken> {
    let refused = |e: io::Error| Broken::ForGood(AssetError::io(part, &e));
    let too_large = || AssetError::new(format!("it is larger than {} GiB", MAX_BYTES >> 30));
    if total.is_some_and(|total| total > MAX_BYTES) {
        return Err(too_large().into());
    }
    let mut file = OpenOptions::new().append(true).create(true).open(part).map_err(refused)?;
    let (mut bytes, mut room) = (have, vec![0; 1 << 16]);
    progress.at(bytes, total);
    loop {
        let n = match from.read(&mut room) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
            Err(e) => {
                return Err(Broken::ForNow(AssetError::new(format!("the download broke after {bytes} bytes: {e}"))));
            }
        };
        bytes += n as u64;
        if bytes > MAX_BYTES {
            return Err(too_large().into());
        }
        file.write_all(room.get(..n).unwrap_or_default()).map_err(refused)?;
        progress.at(bytes, total);
    }
    match total {
        Some(total) if bytes < total => {
            Err(Broken::ForNow(AssetError::new(format!("the download broke after {bytes} of {total} bytes"))))
        }
        _ => Ok(()),
    }
}

/// Where a part of a file begins: `bytes 500-999/1000`.
fn begins_at<T>(response: &Response<T>) -> Option<u64> {
    let range = response.headers().get("content-range")?.to_str().ok()?;
    range.strip_prefix("bytes ")?.split('-').next()?.trim().parse().ok()
}

/// How long the whole file is: `bytes */1000`.
fn full_length<T>(response: &Response<T>) -> Option<u64> {
    let range = response.headers().get("content-range")?.to_str().ok()?;
    range.strip_prefix("bytes */")?.trim().parse().ok()
}

/// Why a server could not be asked.
fn unreachable(url: &str, error: &ureq::Error) -> Broken {
    let offline = "is this computer offline? With the network, `dimos model assets fetch BLUEPRINT` fetches what a blueprint needs, for later";
    let what = match error {
        ureq::Error::HostNotFound => "the server's name is not known".to_owned(),
        ureq::Error::ConnectionFailed => "the server cannot be reached".to_owned(),
        ureq::Error::Timeout(_) => format!("the server does not answer ({error})"),
        ureq::Error::BadUri(_) | ureq::Error::Http(_) => {
            return Broken::ForGood(AssetError::new(format!("{url} is no address: {error}")));
        }
        ureq::Error::Rustls(_) | ureq::Error::Tls(_) => {
            let error = AssetError::new(format!("{url}: no trusted connection: {error}"));
            return Broken::ForGood(
                error.hint("SSL_CERT_FILE names the certificates to trust, where they are not the system's"),
            );
        }
        ureq::Error::Io(e) if e.get_ref().is_some_and(|inner| inner.is::<rustls::Error>()) => {
            let error = AssetError::new(format!("{url}: no trusted connection: {e}"));
            return Broken::ForGood(
                error.hint("SSL_CERT_FILE names the certificates to trust, where they are not the system's"),
            );
        }
        other => other.to_string(),
    };
    Broken::ForNow(AssetError::new(format!("{url}: {what}")).hint(offline))
}
