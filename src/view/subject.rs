//! What the pages of a server show: a live run, or what another program opens: a log, a robot model.

use std::path::PathBuf;

use super::Shown;
use super::foxglove::Asset;
use super::scene::Scene;
use dimos_rpc::api::{World, WorldObject};
use dimos_rpc::client::Client;

/// What the pages of a server show. It is asked on a thread for files, which may wait.
pub trait Subject: Send + Sync {
    /// Returns the scene, for the first page.
    fn scene(&self) -> Scene;

    /// Returns the object of the world with this name, whose file a page asks for.
    fn object(&self, name: &str) -> Option<WorldObject>;

    /// Answers a further request, by its path without `/` and its query, with JSON or the reason why not. `None`:
    /// there is no such path.
    fn answer(&self, path: &str, query: &str) -> Option<Result<String, String>>;

    /// Returns a file of the scene, `mesh/…` or `object/…`, from where the scene comes from. `None`: the scene and
    /// [`object`](Self::object) have it.
    fn file(&self, path: &str) -> Option<Result<Vec<u8>, String>> {
        let _ = path;
        None
    }

    /// Returns the meshes of the robots, by their URIs in the run's description, for viewers that fetch them.
    fn meshes(&self) -> Vec<Asset> {
        Vec::new()
    }
}

/// A live run.
pub(super) struct Live {
    pub shown: Shown,
    pub socket: PathBuf,
}

impl Subject for Live {
    fn scene(&self) -> Scene {
        Scene::read(&self.shown, "run")
    }

    fn object(&self, name: &str) -> Option<WorldObject> {
        let world = Client::connect(&self.shown.name, &self.socket).ok()?.call(World {}).ok()?;
        world.objects.into_iter().find(|object| object.name == name)
    }

    fn answer(&self, _: &str, _: &str) -> Option<Result<String, String>> {
        None
    }

    fn meshes(&self) -> Vec<Asset> {
        let models = self.shown.robots.iter().filter_map(|robot| dimos_robot::load(&robot.source).into_model().ok());
        models.flat_map(|model| model.meshes().map(|m| (m.uri.clone(), m.path.clone())).collect::<Vec<_>>()).collect()
    }
}

/// Returns the value of a key in a query: `from=1&to=2`.
pub fn value<'q>(query: &'q str, key: &str) -> Option<&'q str> {
    query.split('&').filter_map(|pair| pair.split_once('=')).find(|(own, _)| *own == key).map(|(_, value)| value)
}
