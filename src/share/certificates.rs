//! Checks certificates before they are used: zenoh reports all that may be wrong with them in the same words.

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use rustls::crypto::ring::sign::any_supported_type;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use x509_parser::prelude::{FromDer, X509Certificate};

use super::place::Place;
use crate::blueprint::share::{Identity, ShareConfig};
use dimos_core::clock::wall_now;
use dimos_rpc::error::{Code, RpcError};

/// An end of validity that is nearer than this is reported [s].
const SOON: i64 = 14 * DAY;
/// A day [s].
const DAY: i64 = 24 * 3600;

/// Checks the certificates of a shared run. Returns what will be wrong soon.
pub fn check_gateway(config: &ShareConfig) -> Result<Option<String>, RpcError> {
    match &config.identity {
        Some(identity) => check(identity, &name_of(identity)?),
        None => Ok(None),
    }
}

/// Checks our certificates for each place in `places.yaml`: its name, and what is wrong or will be.
pub fn check_places() -> Vec<(String, Result<Option<String>, RpcError>)> {
    let names = Place::names();
    let examined = names.into_iter().map(|name| {
        let result = match Place::find(&name) {
            Ok(Place { identity: Some(identity), user, .. }) => check(&identity, &user),
            Ok(_) => Ok(None),
            Err(text) => Err(RpcError::new(Code::InvalidParams, text.lines().next().unwrap_or_default())
                .hint("docs/many-machines.md shows places.yaml")),
        };
        (name, result)
    });
    examined.collect()
}

/// Checks that the files of an identity can be used: they are readable, the key is the owner's only, the certificate is
/// valid now, the authority signed it, it belongs to the key, and it has this name. Returns what will be wrong soon.
pub(super) fn check(identity: &Identity, name: &str) -> Result<Option<String>, RpcError> {
    check_at(identity, name, (wall_now() / 1_000_000_000) as i64)
}

fn check_at(identity: &Identity, name: &str, now: i64) -> Result<Option<String>, RpcError> {
    let (ca, cert) = (read(&identity.ca)?, read(&identity.cert)?);
    let key = PrivateKeyDer::from_pem_file(&identity.key).map_err(|e| wrong(&identity.key, &e.to_string()))?;
    private(&identity.key)?;
    let (_, authority) = X509Certificate::from_der(&ca).map_err(|e| wrong(&identity.ca, &e.to_string()))?;
    let (_, own) = X509Certificate::from_der(&cert).map_err(|e| wrong(&identity.cert, &e.to_string()))?;
    for (file, certificate) in [(&identity.ca, &authority), (&identity.cert, &own)] {
        let (begin, end) =
            (certificate.validity().not_before.timestamp(), certificate.validity().not_after.timestamp());
        if now > end {
            return Err(wrong(file, &format!("the certificate expired {} ago", span(now - end))).hint(RENEW));
        }
        if now < begin {
            let text = format!("the certificate is not valid yet, but in {}", span(begin - now));
            return Err(wrong(file, &text).hint("check the clock of this computer"));
        }
    }
    let common_name = own.subject().iter_common_name().next().and_then(|name| name.as_str().ok()).unwrap_or_default();
    if common_name != name {
        let text = format!("the certificate is that of {common_name:?}, not of {name:?}");
        return Err(
            wrong(&identity.cert, &text).hint("name the files after the common name, or give `user:` in places.yaml")
        );
    }
    if own.verify_signature(Some(authority.public_key())).is_err() {
        let text = format!("{} did not sign it", identity.ca.display());
        return Err(wrong(&identity.cert, &text).hint("both ends need certificates of the same authority"));
    }
    let signer = any_supported_type(&key).map_err(|e| wrong(&identity.key, &e.to_string()))?;
    if signer.public_key().is_some_and(|public| public.as_ref() != own.public_key().raw) {
        return Err(wrong(&identity.key, &format!("it is not the key of {}", identity.cert.display())));
    }
    let end = own.validity().not_after.timestamp().min(authority.validity().not_after.timestamp());
    Ok((end - now < SOON).then(|| format!("{}: expires in {}", identity.cert.display(), span(end - now))))
}

/// Returns a time [s] in hours or days.
fn span(seconds: i64) -> String {
    if seconds < 2 * DAY { format!("{} h", seconds / 3600) } else { format!("{} days", seconds / DAY) }
}

/// What to do about a certificate that has expired.
const RENEW: &str = "make a new one: docs/many-machines.md shows how";

/// Returns the name of a certificate, its common name.
pub(super) fn name_of(identity: &Identity) -> Result<String, RpcError> {
    let cert = read(&identity.cert)?;
    let (_, own) = X509Certificate::from_der(&cert).map_err(|e| wrong(&identity.cert, &e.to_string()))?;
    let name = own.subject().iter_common_name().next().and_then(|name| name.as_str().ok()).map(str::to_owned);
    name.ok_or_else(|| wrong(&identity.cert, "the certificate has no common name"))
}

fn read(file: &Path) -> Result<CertificateDer<'static>, RpcError> {
    CertificateDer::from_pem_file(file).map_err(|e| wrong(file, &e.to_string()))
}

/// Fails if others than the owner, who must be this user, can read a private key.
fn private(file: &Path) -> Result<(), RpcError> {
    let found = std::fs::metadata(file).map_err(|e| wrong(file, &e.to_string()))?;
    let ours = rustix::process::geteuid();
    if found.mode() & 0o077 != 0 {
        let text = format!("other users can read this private key (mode {:o})", found.mode() & 0o777);
        return Err(wrong(file, &text).hint(format!("chmod 600 {}", file.display())));
    }
    if found.uid() != ours.as_raw() && !ours.is_root() {
        return Err(wrong(file, "the private key belongs to another user"));
    }
    Ok(())
}

fn wrong(file: &Path, what: &str) -> RpcError {
    RpcError::new(Code::Unreachable, format!("{}: {what}", file.display()))
        .hint("docs/many-machines.md shows how to make certificates")
}
