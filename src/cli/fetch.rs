//! Downloads a blueprint's assets, with a progress bar on a terminal.

use indicatif::{ProgressBar, ProgressStyle};

use super::exit::{Exit, Failure, Result};
use super::output;
use crate::assets::{Asset, AssetError, Cache, Progress, without_password};
use crate::blueprint::Blueprint;

/// Downloads missing assets of a blueprint; returns whether there were any.
pub fn missing(blueprint: &Blueprint) -> Result<bool> {
    let awaited = blueprint.awaited_assets();
    for asset in &awaited {
        one(asset)?;
    }
    Ok(!awaited.is_empty())
}

/// Downloads an asset.
pub fn one(asset: &Asset) -> Result<std::path::PathBuf> {
    output::note(format_args!("fetching {} from {}", asset.name, without_password(&asset.url)));
    let mut bar = Bar::new(&asset.name);
    let fetched = Cache::standard().fetch(asset, &mut bar);
    bar.0.finish_and_clear();
    fetched.map_err(failure)
}

/// Converts an error of an asset to a failure.
pub fn failure(error: AssetError) -> Failure {
    Failure::new(Exit::Failed, error.what).maybe_hint(error.hint)
}

/// Hidden if stderr is not a terminal.
struct Bar(ProgressBar);

impl Bar {
    fn new(name: &str) -> Self {
        let bar = ProgressBar::no_length().with_prefix(name.to_owned());
        let template = "{prefix} [{bar:40}] {bytes} of {total_bytes}, {eta} left";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style.progress_chars("=> "));
        }
        Self(bar)
    }
}

impl Progress for Bar {
    fn at(&mut self, bytes: u64, of: Option<u64>) {
        if let Some(total) = of {
            self.0.set_length(total);
        }
        self.0.set_position(bytes);
    }

    fn note(&mut self, text: &str) {
        self.0.suspend(|| output::note(text));
    }
}
