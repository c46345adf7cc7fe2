//! Finds the file of a blueprint by its name.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::{env, fs, io};

use serde::Serialize;

use crate::blueprint::catalog::Catalog;
use crate::blueprint::load::{Overrides, load_from};
use crate::yaml::{MAX_BYTES, did_you_mean, quote};

/// Names and texts of the blueprints in the binary, made by `build.rs` from `blueprints/`.
const EMBEDDED: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/blueprints.rs"));

/// Those that the program which embeds this crate brings along.
static MORE: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// Adds blueprints to the built-in ones; they win over those of the same name. For `main`, once, before anything else.
pub fn embed(more: Vec<(&'static str, &'static str)>) {
    let _ = MORE.set(more);
}

/// All blueprints in the program, by name.
fn embedded() -> BTreeMap<&'static str, &'static str> {
    EMBEDDED.iter().chain(MORE.get().into_iter().flatten()).copied().collect()
}

/// Where a blueprint comes from.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// A file.
    Path(PathBuf),
    /// The binary itself.
    Embedded,
}

impl std::fmt::Display for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Path(path) => write!(f, "{}", path.display()),
            Self::Embedded => f.write_str("embedded"),
        }
    }
}

/// A blueprint's file, not read yet as YAML.
#[derive(Debug, Clone)]
pub struct Found {
    /// The name of the blueprint, unless the file gives another: the file's name.
    pub name: String,
    /// Where it comes from.
    pub source: Source,
    /// What is in it; at most one byte more than is accepted.
    pub bytes: Vec<u8>,
}

impl Found {
    /// The file as shown in messages.
    pub fn file(&self) -> String {
        match &self.source {
            Source::Path(path) => path.display().to_string(),
            Source::Embedded => format!("<embedded>/{}.yaml", self.name),
        }
    }

    /// The folder that paths in it are relative to.
    pub(super) fn folder(&self) -> Option<&Path> {
        match &self.source {
            Source::Path(path) => path.parent(),
            Source::Embedded => None,
        }
    }

    fn embedded(name: &str) -> Option<Self> {
        let text = embedded().remove(name)?;
        Some(Self { name: name.to_owned(), source: Source::Embedded, bytes: text.as_bytes().to_vec() })
    }

    fn file_at(path: &Path) -> io::Result<Self> {
        let mut bytes = Vec::new();
        fs::File::open(path)?.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { name, source: Source::Path(path.to_owned()), bytes })
    }
}

/// There is no such blueprint, or it cannot be opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}\nhint: {hint}")]
pub struct FindError {
    /// What is wrong.
    pub message: String,
    /// What to do about it.
    pub hint: String,
}

/// The folders in which blueprints are looked for by name, in this order; the embedded ones come last.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SearchPath {
    /// The folders.
    pub folders: Vec<PathBuf>,
}

impl SearchPath {
    /// `./blueprints`, the folders of `$DIMOS_BLUEPRINT_PATH`, and the user's configuration folder.
    pub fn from_env() -> Self {
        let mut folders = vec![PathBuf::from("blueprints")];
        if let Some(path) = env::var_os("DIMOS_BLUEPRINT_PATH") {
            folders.extend(env::split_paths(&path).filter(|p| !p.as_os_str().is_empty()));
        }
        let config = env::var_os("XDG_CONFIG_HOME").map(PathBuf::from).filter(|p| p.is_absolute());
        let config = config.or_else(|| env::var_os("HOME").map(|home| Path::new(&home).join(".config")));
        folders.extend(config.map(|c| c.join("dimos").join("blueprints")));
        Self { folders }
    }

    /// The file of a name or path.
    pub fn find(&self, name_or_path: &str) -> Result<Found, FindError> {
        let path = Path::new(name_or_path);
        if looks_like_path(name_or_path) || path.is_file() {
            return self.open(path);
        }
        self.find_name(name_or_path)
    }

    fn open(&self, path: &Path) -> Result<Found, FindError> {
        Found::file_at(path).map_err(|error| self.cannot_open(path, &error))
    }

    fn by_name(&self, name: &str) -> Option<Result<Found, FindError>> {
        let files = self.folders.iter().flat_map(|folder| EXTENSIONS.map(|ext| folder.join(format!("{name}.{ext}"))));
        let file = files.filter(|path| path.is_file()).map(|path| self.open(&path)).next();
        file.or_else(|| Found::embedded(name).map(Ok))
    }

    /// Returns the file of an `include`: a path relative to the including file, a file beside it, or a name.
    pub(super) fn find_include(&self, from: &Found, name: &str) -> Result<Found, FindError> {
        let path = Path::new(name);
        if path.is_absolute() || path.components().any(|c| c == std::path::Component::ParentDir) {
            return Err(FindError {
                message: format!("an include stays in the blueprint's own folder, {} does not", quote(name)),
                hint: "include by name, and put the file's folder into $DIMOS_BLUEPRINT_PATH".to_owned(),
            });
        }
        if looks_like_path(name) {
            let path = from.folder().unwrap_or(Path::new("")).join(path);
            return match from.source {
                Source::Path(_) => self.open(&path),
                Source::Embedded => self.find(name),
            };
        }
        let mut near = self.clone();
        near.folders.splice(0..0, from.folder().map(Path::to_owned));
        near.find_name(name)
    }

    fn find_name(&self, name: &str) -> Result<Found, FindError> {
        self.by_name(name).unwrap_or_else(|| {
            let message = format!("there is no blueprint {}", quote(name));
            Err(FindError { message, hint: self.hint(name) })
        })
    }

    /// All names, each with the place where it is found.
    fn names(&self) -> Vec<(String, Source)> {
        let mut seen = BTreeSet::new();
        let mut out = Vec::new();
        for folder in &self.folders {
            let mut files: Vec<PathBuf> =
                fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
            files.retain(|p| p.extension().is_some_and(|e| EXTENSIONS.iter().any(|ext| e == *ext)) && p.is_file());
            files.sort();
            for path in files {
                let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
                if seen.insert(name.clone()) {
                    out.push((name, Source::Path(path)));
                }
            }
        }
        let embedded = embedded().into_keys().filter(|name| !seen.contains(*name));
        out.extend(embedded.map(|name| (name.to_owned(), Source::Embedded)));
        out.sort();
        out
    }

    fn hint(&self, wanted: &str) -> String {
        let names = self.names();
        let meant = did_you_mean(wanted, names.iter().map(|(name, _)| name.as_str()), "there are");
        meant.unwrap_or_else(|| "give the path of a YAML file".to_owned())
    }

    fn cannot_open(&self, path: &Path, error: &io::Error) -> FindError {
        let reason = match error.kind() {
            io::ErrorKind::NotFound => "there is no such file".to_owned(),
            io::ErrorKind::PermissionDenied => "you may not read it".to_owned(),
            io::ErrorKind::IsADirectory => "it is a folder".to_owned(),
            _ => error.to_string(),
        };
        let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let known = self.names().into_iter().any(|(name, _)| name == stem);
        let hint = match known {
            true => format!("there is a blueprint of that name: use `{stem}`"),
            false => "`dimos list-blueprints` shows the blueprints that can be run by name".to_owned(),
        };
        FindError { message: format!("cannot open {}: {reason}", quote(&path.display().to_string())), hint }
    }

    /// All blueprints that can be run by name.
    pub fn list<'a>(&self, catalog: impl Into<Catalog<'a>>) -> Vec<Listing> {
        let catalog = catalog.into();
        let found = self.names().into_iter().map(|(name, source)| {
            let found = match &source {
                Source::Path(path) => Found::file_at(path).map_err(|error| self.cannot_open(path, &error).message),
                Source::Embedded => Found::embedded(&name).ok_or_else(|| "it is gone".to_owned()),
            };
            let mut listing = Listing { name, source, arms: Vec::new(), description: String::new(), problem: None };
            match found.map(|found| load_from(self, &found, &Overrides::default(), catalog)) {
                Ok(loaded) => {
                    listing.problem = loaded.first_problem();
                    if let Some(blueprint) = loaded.blueprint {
                        listing.description = blueprint.description;
                        listing.arms = blueprint
                            .arms
                            .iter()
                            .map(|a| format!("{} ({}, {} joints)", a.hardware_id, a.adapter_type, a.joints.len()))
                            .collect();
                    }
                }
                Err(problem) => listing.problem = Some(problem),
            }
            listing
        });
        found.collect()
    }
}

const EXTENSIONS: [&str; 2] = ["yaml", "yml"];

fn looks_like_path(text: &str) -> bool {
    text.contains(['/', '\\']) || EXTENSIONS.iter().any(|ext| Path::new(text).extension().is_some_and(|e| e == *ext))
}

/// A line of `dimos list-blueprints`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Listing {
    /// What to give to `dimos run`.
    pub name: String,
    /// Where it comes from.
    pub source: Source,
    /// Its arms: name, adapter, number of joints.
    pub arms: Vec<String>,
    /// Its description.
    pub description: String,
    /// Its first mistake, when it has one.
    pub problem: Option<String>,
}

/// The file of a name or path, looked for in the folders of the environment.
pub fn find(name_or_path: &str) -> Result<Found, FindError> {
    SearchPath::from_env().find(name_or_path)
}

/// All blueprints that can be run by name, from the folders of the environment.
pub fn list<'a>(catalog: impl Into<Catalog<'a>>) -> Vec<Listing> {
    SearchPath::from_env().list(catalog)
}
