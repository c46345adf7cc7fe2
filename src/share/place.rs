//! Places: where runs of other computers are reached.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::blueprint::share::{ANYONE, Endpoint, Identity, is_user};
use dimos_core::bounded;
use dimos_yaml::{did_you_mean, quote};

/// Where a run, or a router of runs, is reached, and as whom.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Its name, or the endpoint.
    pub name: String,
    /// Its endpoint.
    pub endpoint: Endpoint,
    /// Our certificates.
    pub identity: Option<Identity>,
    /// Our name: that of the certificate; `-` without one.
    pub user: String,
    /// The run that is meant if none is named.
    pub run: Option<String>,
}

/// An entry of the file of places.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    at: String,
    identity: Option<PathBuf>,
    user: Option<String>,
    run: Option<String>,
}

/// Returns the folder of the user's settings.
fn settings() -> PathBuf {
    let config = std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|dir| dir.is_absolute());
    let home = || std::env::var_os("HOME").map(PathBuf::from).unwrap_or_default().join(".config");
    config.unwrap_or_else(home).join("dimos")
}

impl Place {
    /// Returns the place of an endpoint, or of a name in `places.yaml`. The error may end with a hint.
    pub fn find(text: &str) -> Result<Self, String> {
        Self::find_in(text, &settings(), std::env::var_os("DIMOS_IDENTITY").map(PathBuf::from))
    }

    /// Returns the names in `places.yaml`; none if it cannot be read.
    pub fn names() -> Vec<String> {
        let written = bounded::read_text(&settings().join("places.yaml"), bounded::SMALL).unwrap_or_default();
        let places: BTreeMap<String, serde_yaml::Value> = serde_yaml::from_str(&written).unwrap_or_default();
        places.into_keys().collect()
    }

    fn find_in(text: &str, settings: &Path, identity: Option<PathBuf>) -> Result<Self, String> {
        if text.contains('/') {
            let endpoint: Endpoint = text.parse()?;
            let identity = endpoint.tls.then(|| identity.unwrap_or_else(|| settings.join("identity")));
            return Self::with(text, endpoint, identity, None, None);
        }
        let file = settings.join("places.yaml");
        let shown = file.display();
        let written = match bounded::read_text(&file, bounded::SMALL) {
            Ok(written) => written,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                let hint = "hint: give an endpoint, tls/HOST:PORT, or name places in that file: docs/many-machines.md";
                return Err(format!("there is no place {}, and no file {shown}\n{hint}", quote(text)));
            }
            Err(e) => return Err(format!("{shown}: {e}")),
        };
        let mut places: BTreeMap<String, Entry> = serde_yaml::from_str(&written)
            .map_err(|e| format!("{shown}: {e}\nhint: docs/many-machines.md shows it"))?;
        let Some(Entry { at, identity: own, user, run }) = places.remove(text) else {
            let hint = did_you_mean(text, places.keys().map(String::as_str), "there").unwrap_or_default();
            return Err(format!("there is no place {} in {shown}\nhint: {hint}", quote(text)));
        };
        let endpoint: Endpoint = at.parse().map_err(|e| format!("{shown}: {text}: {e}"))?;
        let own = own.map(|folder| settings.join(folder)).or(identity);
        let identity = endpoint.tls.then(|| own.unwrap_or_else(|| settings.join("identity")));
        Self::with(text, endpoint, identity, user, run)
    }

    fn with(
        name: &str,
        endpoint: Endpoint,
        folder: Option<PathBuf>,
        user: Option<String>,
        run: Option<String>,
    ) -> Result<Self, String> {
        let Some(folder) = folder else {
            return Ok(Self { name: name.to_owned(), endpoint, identity: None, user: ANYONE.to_owned(), run });
        };
        let user = match user {
            Some(user) => user,
            None => only_user(&folder)?,
        };
        if !is_user(&user) {
            return Err(format!("{} cannot be a user", quote(&user)));
        }
        let identity = Identity {
            ca: folder.join("ca.pem"),
            cert: folder.join(format!("{user}.pem")),
            key: folder.join(format!("{user}.key")),
        };
        Ok(Self { name: name.to_owned(), endpoint, identity: Some(identity), user, run })
    }
}

/// Returns the name of the only private key of a folder.
fn only_user(folder: &Path) -> Result<String, String> {
    let hint = "hint: it has ca.pem, NAME.pem and NAME.key; docs/many-machines.md shows how to make them";
    let shown = folder.display();
    let entries = std::fs::read_dir(folder).map_err(|e| format!("{shown}: {e}\n{hint}"))?;
    let paths = entries.flatten().map(|entry| entry.path());
    let keys: Vec<PathBuf> = paths.filter(|path| path.extension().is_some_and(|e| e == "key")).collect();
    match keys.as_slice() {
        [key] => Ok(key.file_stem().unwrap_or_default().to_string_lossy().into_owned()),
        [] => Err(format!("{shown} has no private key\n{hint}")),
        _ => Err(format!("{shown} has several private keys\nhint: name the place in places.yaml, with `user:`")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_an_endpoint_or_a_name_in_the_file() {
        let home = tempfile::tempdir().unwrap();
        let find = |text: &str| Place::find_in(text, home.path(), None);
        let local = find("tcp/127.0.0.1:7447").unwrap();
        assert_eq!((local.user.as_str(), local.identity, local.run), ("-", None, None));
        assert!(find("cell1").unwrap_err().contains("no file"));

        std::fs::create_dir(home.path().join("lab")).unwrap();
        std::fs::write(home.path().join("lab/alice.key"), "").unwrap();
        let written = "cell1: {at: 'tls/cell1:7447', identity: lab, run: cell}\ncell2: {at: nowhere}\n";
        std::fs::write(home.path().join("places.yaml"), written).unwrap();
        let cell = find("cell1").unwrap();
        let identity = cell.identity.unwrap();
        assert_eq!((cell.user.as_str(), cell.run.as_deref()), ("alice", Some("cell")));
        assert_eq!(identity.cert, home.path().join("lab/alice.pem"));
        assert_eq!(identity.ca, home.path().join("lab/ca.pem"));

        assert!(find("cell3").unwrap_err().contains("cell3"));
        assert!(find("cell2").unwrap_err().contains("is no endpoint"));
        assert!(find("tls/cell1:7447").unwrap_err().contains("identity"));
        std::fs::write(home.path().join("lab/bob.key"), "").unwrap();
        assert!(find("cell1").unwrap_err().contains("several private keys"));
    }
}
