//! Finds the file of a blueprint by its name.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::{env, fs, io};

use serde::Serialize;

use crate::blueprint::catalog::Catalog;
use crate::blueprint::load::{Overrides, load_from};
use dimos_robot::builtin::PREFIX;
use dimos_yaml::{MAX_BYTES, closest, did_you_mean, quote};

/// Files and texts of the blueprints in the binary, embedded by `build.rs` from `blueprints/`.
const EMBEDDED: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/blueprints.rs"));

/// Blueprints added by a program that embeds this crate.
static MORE: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// Adds named blueprints, which win over the built-in ones. Call it once, first thing in `main`.
pub fn embed(more: Vec<(&'static str, &'static str)>) {
    let _ = MORE.set(more);
}

/// Returns all blueprints in the program, by name.
fn embedded() -> BTreeMap<&'static str, &'static str> {
    let shipped = EMBEDDED.iter().map(|(file, text)| (file.strip_suffix(".yaml").unwrap_or(file), *text));
    shipped.chain(MORE.get().into_iter().flatten().copied()).collect()
}

/// Origin of a blueprint.
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

/// A blueprint's file, not parsed yet.
#[derive(Debug, Clone)]
pub struct Found {
    /// The file's name: the name of the blueprint unless the file sets another.
    pub name: String,
    /// Origin.
    pub source: Source,
    /// Contents, at most one byte more than the size limit.
    pub bytes: Vec<u8>,
}

impl Found {
    /// Returns the file's name for messages.
    pub fn file(&self) -> String {
        match &self.source {
            Source::Path(path) => path.display().to_string(),
            Source::Embedded => format!("<embedded>/{}.yaml", self.name),
        }
    }

    /// Returns the folder that its paths are relative to.
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

/// The blueprint does not exist, or cannot be opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}\nhint: {hint}")]
pub struct FindError {
    /// What is wrong.
    pub message: String,
    /// How to fix it.
    pub hint: String,
}

/// Folders that are searched for a blueprint's name, in this order; embedded blueprints come last.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SearchPath {
    /// The folders.
    pub folders: Vec<PathBuf>,
}

impl SearchPath {
    /// Returns `./blueprints`, the folders of `$DIMOS_BLUEPRINT_PATH`, and the user's configuration folder.
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

    /// Returns the file of a name or path; `builtin:NAME` is the blueprint in the program, whatever files there are.
    pub fn find(&self, name_or_path: &str) -> Result<Found, FindError> {
        if let Some(name) = name_or_path.strip_prefix(PREFIX) {
            let message = format!("there is no built-in blueprint {}", quote(name));
            let hint = did_you_mean(name, embedded().into_keys(), "the built-in ones are").unwrap_or_default();
            return Found::embedded(name).ok_or(FindError { message, hint });
        }
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
                message: format!("an include must be in the blueprint's own folder; {} is not", quote(name)),
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

    /// Returns all names, each with its origin.
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
        let beside = EXTENSIONS.iter().map(|ext| format!("{wanted}.{ext}")).find(|file| Path::new(file).is_file());
        if let Some(file) = beside {
            return format!("there is a file of that name: use `{file}`");
        }
        if Path::new(wanted).extension().is_some() {
            return "a blueprint is a YAML file: NAME.yaml or NAME.yml".to_owned();
        }
        let names = self.names();
        match closest(wanted, names.iter().map(|(name, _)| name.as_str())) {
            Some(name) => format!("did you mean `{name}`?"),
            None => "`dimos list-blueprints` shows the names; a file is given by its path".to_owned(),
        }
    }

    fn cannot_open(&self, path: &Path, error: &io::Error) -> FindError {
        let reason = match error.kind() {
            io::ErrorKind::NotFound => "there is no such file".to_owned(),
            io::ErrorKind::PermissionDenied => "permission denied".to_owned(),
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

    /// Returns all blueprints that can be run by name.
    pub fn list<'a>(&self, catalog: impl Into<Catalog<'a>>) -> Vec<Listing> {
        let catalog = catalog.into();
        let found = self.names().into_iter().map(|(name, source)| {
            let found = match &source {
                Source::Path(path) => Found::file_at(path).map_err(|error| self.cannot_open(path, &error).message),
                Source::Embedded => Found::embedded(&name).ok_or_else(|| "it no longer exists".to_owned()),
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

/// A row of `dimos list-blueprints`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Listing {
    /// Name for `dimos run`.
    pub name: String,
    /// Origin.
    pub source: Source,
    /// Its arms: name, adapter, number of joints.
    pub arms: Vec<String>,
    /// Its description.
    pub description: String,
    /// Its first mistake, if any.
    pub problem: Option<String>,
}

/// Returns the file of a name or path; searches the folders of [`SearchPath::from_env`].
pub fn find(name_or_path: &str) -> Result<Found, FindError> {
    SearchPath::from_env().find(name_or_path)
}

/// Returns the names of all blueprints that can be run by name; reads none of them.
pub fn names() -> Vec<String> {
    SearchPath::from_env().names().into_iter().map(|(name, _)| name).collect()
}

/// Returns all blueprints that can be run by name, from the folders of [`SearchPath::from_env`].
pub fn list<'a>(catalog: impl Into<Catalog<'a>>) -> Vec<Listing> {
    SearchPath::from_env().list(catalog)
}
