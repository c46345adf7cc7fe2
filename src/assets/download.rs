//! Downloads a file. Resumes an interrupted download if the server supports it.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use ureq::Agent;
use ureq::http::{Response, StatusCode};
use ureq::tls::{Certificate, RootCerts, TlsConfig};

use super::fetch::percent_decoded;
use super::{AssetError, Progress, without_password};

/// Maximum file size [bytes].
pub const MAX_BYTES: u64 = 4 << 30;
/// Timeout for DNS lookup and TCP connect.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// Timeout without received data.
const RECEIVE_TIMEOUT: Duration = Duration::from_secs(30);
/// Maximum duration of one connection.
const MAX_DURATION: Duration = Duration::from_secs(3600);
/// Maximum consecutive attempts without progress.
const MAX_STALLED_TRIES: u32 = 3;
/// Maximum number of connections.
const MAX_CONNECTIONS: u32 = 100;
/// Initial back-off between attempts; it grows with each.
const BACK_OFF: Duration = Duration::from_millis(300);

/// Why a connection did not deliver the whole file.
enum Interruption {
    /// Temporary: retry.
    Temporary(AssetError),
    /// Permanent.
    Permanent(AssetError),
}

impl From<AssetError> for Interruption {
    fn from(error: AssetError) -> Self {
        Self::Permanent(error)
    }
}

/// Downloads a file to `part`, which may hold its beginning already.
pub fn download(url: &str, part: &Path, progress: &mut dyn Progress) -> Result<(), AssetError> {
    if let Some(path) = url.strip_prefix("file://") {
        let path = path.strip_prefix("localhost").unwrap_or(path);
        return copy(&PathBuf::from(percent_decoded(path)), part, progress);
    }
    let agent = agent(url.starts_with("https://"))?;
    let (mut stalled, mut connections) = (0, 0);
    loop {
        let before = length(part);
        let error = match connection(&agent, url, part, before, progress) {
            Ok(()) => return Ok(()),
            Err(Interruption::Permanent(error)) => return Err(error),
            Err(Interruption::Temporary(error)) => error,
        };
        connections += 1;
        stalled = if length(part) > before { 0 } else { stalled + 1 };
        if stalled >= MAX_STALLED_TRIES || connections >= MAX_CONNECTIONS {
            let kept = length(part);
            let kept = if kept > 0 {
                format!("; {kept} bytes are kept and the next attempt resumes there")
            } else {
                String::new()
            };
            return Err(AssetError { what: format!("{}{kept}", error.what), hint: error.hint });
        }
        progress.note(&format!("{error}: retrying"));
        std::thread::sleep(BACK_OFF * (1 << stalled.min(4)));
    }
}

fn length(part: &Path) -> u64 {
    fs::metadata(part).map_or(0, |found| found.len())
}

/// Copies a local file.
fn copy(from: &Path, part: &Path, progress: &mut dyn Progress) -> Result<(), AssetError> {
    let unreadable = |e: io::Error| {
        AssetError::new(format!("{}: {e}", from.display())).hint("write the full path of a local file after file://")
    };
    let mut source = File::open(from).map_err(unreadable)?;
    let found = source.metadata().map_err(unreadable)?;
    if !found.is_file() {
        return Err(AssetError::new(format!("{} is not a file", from.display())));
    }
    let _ = fs::remove_file(part);
    copy_stream(&mut source, part, 0, Some(found.len()), progress).map_err(|broken| match broken {
        Interruption::Temporary(error) | Interruption::Permanent(error) => error,
    })
}

fn agent(encrypted: bool) -> Result<Agent, AssetError> {
    let mut config = Agent::config_builder()
        .http_status_as_error(false)
        .user_agent(format!("dimos/{}", crate::VERSION))
        .timeout_resolve(Some(CONNECT_TIMEOUT))
        .timeout_connect(Some(CONNECT_TIMEOUT))
        .timeout_recv_response(Some(RECEIVE_TIMEOUT))
        .timeout_per_read(Some(RECEIVE_TIMEOUT))
        .timeout_recv_body(Some(MAX_DURATION));
    if encrypted {
        if let Some(file) = std::env::var_os("SSL_CERT_FILE").filter(|file| !Path::new(file).is_file()) {
            let error = AssetError::new(format!("SSL_CERT_FILE: there is no file {}", Path::new(&file).display()));
            return Err(error.hint("unset it to use the system's certificates, or correct its path"));
        }
        // The system's certificates, so that a company's own CA is trusted as elsewhere on this computer.
        let found = rustls_native_certs::load_native_certs();
        let trusted: Vec<_> = found.certs.iter().map(|c| Certificate::from_der(c.as_ref()).to_owned()).collect();
        if trusted.is_empty() {
            let error = AssetError::new("no trusted certificates on this computer: https is not available");
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

/// Makes one connection: requests the missing part and appends it.
fn connection(
    agent: &Agent,
    url: &str,
    part: &Path,
    have: u64,
    progress: &mut dyn Progress,
) -> Result<(), Interruption> {
    let request = agent.get(url);
    let request = if have > 0 { request.header("range", format!("bytes={have}-")) } else { request };
    let mut response = request.call().map_err(|error| unreachable(url, &error))?;
    let status = response.status();
    let status_text = format!("{}: the server answered {status}", without_password(url));
    match status {
        StatusCode::OK => {
            // The whole file, whatever was requested.
            let _ = fs::remove_file(part);
            let total = response.body().content_length();
            copy_stream(&mut response.body_mut().as_reader(), part, 0, total, progress)
        }
        StatusCode::PARTIAL_CONTENT if begins_at(&response) == Some(have) => {
            let total = response.body().content_length().map(|rest| have.saturating_add(rest));
            copy_stream(&mut response.body_mut().as_reader(), part, have, total, progress)
        }
        // The file is complete: the checksum decides.
        StatusCode::RANGE_NOT_SATISFIABLE if full_length(&response) == Some(have) => Ok(()),
        StatusCode::PARTIAL_CONTENT | StatusCode::RANGE_NOT_SATISFIABLE => {
            let _ = fs::remove_file(part);
            Err(Interruption::Temporary(AssetError::new(format!("{status_text}, but not with the requested range"))))
        }
        StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_MANY_REQUESTS => {
            Err(Interruption::Temporary(AssetError::new(status_text)))
        }
        _ if status.is_server_error() => {
            Err(Interruption::Temporary(AssetError::new(status_text).hint("try again later")))
        }
        _ => Err(Interruption::Permanent(
            AssetError::new(status_text).hint("check the address: `url` in the blueprint's assets"),
        )),
    }
}

/// Appends the received data.
fn copy_stream(
    from: &mut dyn Read,
    part: &Path,
    have: u64,
    total: Option<u64>,
    progress: &mut dyn Progress,
) -> Result<(), Interruption> {
    let refused = |e: io::Error| Interruption::Permanent(AssetError::io(part, &e));
    let too_large = || AssetError::new(format!("larger than {} GiB", MAX_BYTES >> 30));
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
                return Err(Interruption::Temporary(AssetError::new(format!(
                    "the download was interrupted after {bytes} bytes: {e}"
                ))));
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
        Some(total) if bytes < total => Err(Interruption::Temporary(AssetError::new(format!(
            "the download was interrupted after {bytes} of {total} bytes"
        )))),
        _ => Ok(()),
    }
}

/// Returns the start of a partial response: `bytes 500-999/1000`.
fn begins_at<T>(response: &Response<T>) -> Option<u64> {
    let range = response.headers().get("content-range")?.to_str().ok()?;
    range.strip_prefix("bytes ")?.split('-').next()?.trim().parse().ok()
}

/// Returns the size of the whole file: `bytes */1000`.
fn full_length<T>(response: &Response<T>) -> Option<u64> {
    let range = response.headers().get("content-range")?.to_str().ok()?;
    range.strip_prefix("bytes */")?.trim().parse().ok()
}

/// Returns the error of a failed request. Only failures that may pass are temporary.
fn unreachable(url: &str, error: &ureq::Error) -> Interruption {
    let (shown, encrypted) = (without_password(url), url.starts_with("https://"));
    let permanent = |what: String, hint: &str| {
        Interruption::Permanent(AssetError::new(format!("{shown}: {what}")).hint(hint.to_owned()))
    };
    let temporary = |what: String, hint: &str| {
        Interruption::Temporary(AssetError::new(format!("{shown}: {what}")).hint(hint.to_owned()))
    };
    let offline = "if this computer is usually offline, run `dimos model assets fetch BLUEPRINT` while it is online";
    let address = "check the address: `url` in the blueprint's assets";
    let certificates = "set SSL_CERT_FILE to the certificates to trust, if they are not the system's";
    let other_protocol = match encrypted {
        true => "the server does not speak TLS at this port: http:// instead of https://?",
        false => "the server does not speak HTTP at this port: https:// instead of http://?",
    };
    let untrusted = |error: &rustls::Error| match error {
        rustls::Error::InvalidMessage(_) => permanent(format!("no encrypted connection: {error}"), other_protocol),
        _ => permanent(format!("no trusted connection: {error}"), certificates),
    };
    match error {
        ureq::Error::HostNotFound => temporary("unknown host name".to_owned(), offline),
        ureq::Error::ConnectionFailed => temporary("the server cannot be reached".to_owned(), offline),
        ureq::Error::Timeout(_) => temporary(format!("no answer from the server ({error})"), offline),
        ureq::Error::TooManyRedirects => permanent("the server redirects in a circle".to_owned(), address),
        ureq::Error::BadUri(_) | ureq::Error::Http(_) => permanent(format!("not a valid address: {error}"), address),
        ureq::Error::Protocol(_) => permanent(format!("the answer is not HTTP: {error}"), other_protocol),
        ureq::Error::Rustls(error) => untrusted(error),
        ureq::Error::Tls(_) => permanent(format!("no trusted connection: {error}"), certificates),
        ureq::Error::Io(e) => match e.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>()) {
            Some(error) => untrusted(error),
            None if e.kind() == io::ErrorKind::ConnectionRefused => {
                let hint = "nothing listens at this address and port: check both, and whether the server runs";
                temporary("connection refused".to_owned(), hint)
            }
            None => temporary(e.to_string(), offline),
        },
        other => temporary(other.to_string(), offline),
    }
}
