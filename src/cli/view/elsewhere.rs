//! The live view of a run on another computer, served from this one: its robots and meshes come from there, and each
//! page is a client of the run, with the role of this user.

use std::sync::Arc;

use crate::blueprint::planner::ViewConfig;
use crate::cli::exit::{Exit, Failure, Result};
use crate::share::{self, Page, Relay};
use crate::view::{Scene, Subject, View};
use dimos_rpc::api::WorldObject;

/// What the pages show.
struct Elsewhere {
    scene: String,
    page: Page,
    /// Where pages connect to the run.
    _relay: Relay,
}

/// A page of a run on another computer.
pub struct Served {
    /// Its server.
    pub view: View,
    /// The run's name.
    pub run: String,
    /// Dropped last, and not by the thread of the server: zenoh ends no session on such a thread.
    _subject: Arc<Elsewhere>,
}

/// Serves the page of a run at a place.
pub fn open(place: &str, run: Option<&str>) -> Result<Served> {
    let page = share::page(place, run)?;
    let run = page.run().to_owned();
    let scene = String::from_utf8_lossy(&page.get("scene.json")?).into_owned();
    let relay = Relay::start(place, &run)?;
    let socket = relay.socket().to_owned();
    let subject = Arc::new(Elsewhere { scene, page, _relay: relay });
    let view = View::through(&ViewConfig::default(), subject.clone(), &socket)
        .map_err(|why| Failure::new(Exit::Failed, format!("the page cannot be served: {why}")))?;
    Ok(Served { view, run, _subject: subject })
}

impl Subject for Elsewhere {
    fn scene(&self) -> Scene {
        Scene { json: self.scene.clone(), meshes: Vec::new() }
    }

    fn object(&self, _: &str) -> Option<WorldObject> {
        None
    }

    fn answer(&self, _: &str, _: &str) -> Option<std::result::Result<String, String>> {
        None
    }

    fn file(&self, path: &str) -> Option<std::result::Result<Vec<u8>, String>> {
        Some(self.page.get(path).map_err(|error| error.to_string()))
    }
}
