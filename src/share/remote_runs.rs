//! The runs of other computers: which there are, and a connection to one.

use std::path::PathBuf;
use std::time::Duration;

use zenoh::Session;

use super::connection;
use super::page::Page;
use super::place::Place;
use super::settings::OPEN_TIMEOUT;
use crate::blueprint::share::ANYONE;
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::{Code, RpcError};
use dimos_rpc::run_dir::LiveRun;

/// Maximum time until a place accepts a connection again: those who connect again try until it does.
pub(super) const AGAIN_TIMEOUT: Duration = Duration::from_millis(500);

/// Returns the runs that a place shares with us: an endpoint, or a name in `places.yaml`.
pub fn runs(place: &str) -> Result<Vec<LiveRun>, ClientError> {
    let found = find(place)?;
    let session = connection::open(&found, OPEN_TIMEOUT)?;
    Ok(live(place, connection::runs(&session)))
}

/// Connects to the run of this name at a place; without a name, to the one that the place names, or the only one.
pub fn connect(place: &str, run: Option<&str>) -> Result<Client, ClientError> {
    let found = find(place)?;
    let (session, name) = open(&found, run, OPEN_TIMEOUT)?;
    connection::connect(session, &found, &name)
}

/// Connects to the run of this name again, after a loss: gives up after half a second where nothing answers.
pub fn connect_again(place: &str, run: &str) -> Result<Client, ClientError> {
    let found = find(place)?;
    let (session, name) = open(&found, Some(run), AGAIN_TIMEOUT)?;
    connection::connect(session, &found, &name)
}

/// Opens the live view of a run at a place, as [`connect`] finds it.
pub fn page(place: &str, run: Option<&str>) -> Result<Page, ClientError> {
    let found = find(place)?;
    let (session, name) = open(&found, run, OPEN_TIMEOUT)?;
    Ok(Page::new(session, &found, &name))
}

/// Opens a session with a place for one of its runs; returns the run's name.
pub(super) fn open(place: &Place, run: Option<&str>, timeout: Duration) -> Result<(Session, String), ClientError> {
    let session = connection::open(place, timeout)?;
    let mut names = connection::runs(&session);
    let name = match run.map(str::to_owned).or_else(|| place.run.clone()) {
        Some(name) if names.contains(&name) => name,
        Some(_) | None if names.is_empty() => return Err(nothing(place).into()),
        Some(name) => return Err(ClientError::UnknownRun { name, live: live(&place.name, names) }),
        None if names.len() > 1 => return Err(ClientError::SeveralRuns(live(&place.name, names))),
        None => names.remove(0),
    };
    Ok((session, name))
}

pub(super) fn find(place: &str) -> Result<Place, RpcError> {
    Place::find(place).map_err(|text| {
        let (what, hint) = text.split_once("\nhint: ").map_or((text.as_str(), None), |(what, hint)| (what, Some(hint)));
        let error = RpcError::new(Code::InvalidParams, what);
        match hint {
            Some(hint) if !hint.is_empty() => error.hint(hint),
            _ => error,
        }
    })
}

fn live(place: &str, names: Vec<String>) -> Vec<LiveRun> {
    let run = |name| LiveRun { name, pid: 0, socket: PathBuf::new(), at: Some(place.to_owned()) };
    names.into_iter().map(run).collect()
}

/// The error where something answers and shows no run.
fn nothing(place: &Place) -> RpcError {
    let Place { name, user, .. } = place;
    if user == ANYONE {
        let text = format!("{name} answers, but shares no run with clients that have no certificate");
        return RpcError::new(Code::Forbidden, text).hint("the run may be starting; or give `tls/` and certificates");
    }
    let text = format!("{name} answers, but shares no run with {user}");
    RpcError::new(Code::Forbidden, text)
        .hint("its owner adds users: `share.users` in the blueprint; or the run is starting")
}
