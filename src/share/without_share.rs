//! The network of a build without it.

use std::path::PathBuf;

use crate::blueprint::share::ShareConfig;
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::{Code, RpcError};
use dimos_rpc::run_dir::LiveRun;

/// No environment variable.
pub const THREADS: (&str, &str) = ("", "");

/// No gateway.
#[derive(Debug)]
pub enum Gateway {}

impl Gateway {
    /// Fails: this build has none.
    pub fn start(_: &str, _: PathBuf, _: ShareConfig) -> Result<Self, RpcError> {
        Err(lacking())
    }

    /// Returns why a bridge does not serve.
    pub fn bridge_error(&self) -> Option<&RpcError> {
        None
    }

    /// Returns which bridges do not serve.
    pub fn not_serving(&self) -> Vec<String> {
        match *self {}
    }

    /// Serves until the run ends.
    pub fn serve(self) {
        match self {}
    }
}

/// No socket of a run on another computer.
#[derive(Debug)]
pub enum Relay {}

impl Relay {
    /// Fails: this build reaches no other computer.
    pub fn start(_: &str, _: &str) -> Result<Self, ClientError> {
        Err(lacking().into())
    }

    /// Returns the socket.
    pub fn socket(&self) -> &std::path::Path {
        match *self {}
    }
}

/// No live view of a run on another computer.
#[derive(Debug)]
pub enum Page {}

impl Page {
    /// Returns the run's name.
    pub fn run(&self) -> &str {
        match *self {}
    }

    /// Returns a file.
    pub fn get(&self, _: &str) -> Result<Vec<u8>, ClientError> {
        match *self {}
    }
}

/// Fails: this build has none.
pub fn check_gateway(_: &ShareConfig) -> Result<Option<String>, RpcError> {
    Err(lacking())
}

/// Checks nothing.
pub fn check_places() -> Vec<(String, Result<Option<String>, RpcError>)> {
    Vec::new()
}

/// Reports nothing.
pub fn refusals<S: tracing::Subscriber>(
    _: &ShareConfig,
    _: impl Fn(String) + Send + Sync + 'static,
) -> Box<dyn tracing_subscriber::Layer<S> + Send + Sync> {
    Box::new(tracing_subscriber::layer::Identity::new())
}

/// Fails: this build reaches no other computer.
pub fn page(_: &str, _: Option<&str>) -> Result<Page, ClientError> {
    Err(lacking().into())
}

/// Fails: this build reaches no other computer.
pub fn connect_again(_: &str, _: &str) -> Result<Client, ClientError> {
    Err(lacking().into())
}

/// Fails: this build reaches no other computer.
pub fn connect(_: &str, _: Option<&str>) -> Result<Client, ClientError> {
    Err(lacking().into())
}

/// Fails: this build reaches no other computer.
pub fn runs(_: &str) -> Result<Vec<LiveRun>, ClientError> {
    Err(lacking().into())
}

fn lacking() -> RpcError {
    RpcError::new(Code::Unsupported, "this build reaches no other computer (cargo feature `share`)")
        .hint("`make install` builds with it; by hand: cargo build --release --features share")
}
