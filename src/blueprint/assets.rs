//! The section `assets`, and paths of files in assets: `asset:NAME/path`.

use std::path::{Path, PathBuf};

use crate::assets::{Asset, Cache, split};
use crate::blueprint::planner::PlannerEntry;
use crate::blueprint::resolve::{Checker, UsedAsset};
use crate::blueprint::schema::{AssetEntry, TaskEntry};
use dimos_core::written::ShapeSpec;
use dimos_robot::Source;
use dimos_yaml::{Diag, Keyed, Located, NodeId, did_you_mean, quote};

/// The assets of a blueprint, while it is checked.
pub(super) struct Assets {
    entries: Keyed<AssetEntry>,
    cache: Cache,
}

impl Assets {
    /// Uses the user's cache.
    pub fn of(entries: Keyed<AssetEntry>) -> Self {
        Self { entries, cache: Cache::standard() }
    }

    fn entry(&self, name: &str) -> Option<&AssetEntry> {
        self.entries.0.iter().find(|(ours, _)| ours.value == name).map(|(_, entry)| entry)
    }

    /// Returns the file that `asset:NAME/path` refers to; `None` for other paths and unknown assets.
    pub fn path(&self, path: &str) -> Option<PathBuf> {
        let (name, inside) = split(path)?;
        let folder = self.cache.folder(&self.entry(name)?.sha256);
        Some(if inside.is_empty() { folder } else { folder.join(inside) })
    }

    /// Returns whether a file is in an asset that is not fetched yet.
    pub fn awaited(&self, path: &Path) -> bool {
        self.cache.awaits(path)
    }

    /// Returns whether any file of a description is in an asset that is not fetched yet.
    pub fn source_awaited(&self, source: &Source) -> bool {
        let files = [Some(&source.path), source.srdf.as_ref(), source.joint_limits.as_ref()];
        files.into_iter().flatten().chain(source.packages.values()).any(|path| self.awaited(path))
    }
}

/// Reports entries that cannot be fetched, and paths into unknown assets.
pub(super) fn check(checker: &mut Checker<'_>, tasks: &[Located<TaskEntry>], planner: Option<&Located<PlannerEntry>>) {
    for (name, entry) in checker.assets.entries.0.clone() {
        checker.check_name(&name, "asset's name");
        address(checker, &entry.url);
        let sum = &entry.sha256;
        if !sum.is_empty() && (sum.len() != 64 || !sum.chars().all(|c| c.is_ascii_hexdigit())) {
            let diag = Diag::error("a SHA-256 has 64 hexadecimal digits");
            checker.error(sum.at, diag.hint("`sha256sum FILE` prints it"));
        }
    }
    for (at, path) in paths(checker, tasks, planner) {
        reference(checker, at, &path);
    }
}

fn reference(checker: &mut Checker<'_>, at: NodeId, path: &str) {
    let Some((name, inside)) = split(path) else { return };
    if inside.split('/').any(|part| part == "..") || inside.starts_with('/') {
        let diag = Diag::error(format!("{} points outside its asset", quote(path)));
        checker.error(at, diag.hint("write asset:NAME/path, without `..`"));
    } else if checker.assets.entry(name).is_none() {
        let names = checker.assets.entries.0.iter().map(|(name, _)| name.as_str());
        let hint = did_you_mean(name, names, "assets");
        let hint = hint.unwrap_or_else(|| format!("add it: `assets: {{{name}: {{url: …, sha256: …}}}}`"));
        checker.error(at, Diag::error(format!("there is no asset {}", quote(name))).hint(hint));
    }
}

/// Returns the assets with the positions of their entries, and whether any path refers to them.
pub(super) fn resolved(
    checker: &Checker<'_>,
    tasks: &[Located<TaskEntry>],
    planner: Option<&Located<PlannerEntry>>,
) -> Vec<UsedAsset> {
    let paths = paths(checker, tasks, planner);
    let used = |name: &str| paths.iter().any(|(_, path)| split(path).is_some_and(|(ours, _)| ours == name));
    let asset = |(name, entry): &(Located<String>, AssetEntry)| {
        let place = Diag::error("").at(checker.tree.label(name.at)).located(checker.tree);
        let (line, column) = (place.line.unwrap_or(1), place.column.unwrap_or(1));
        let asset = Asset {
            name: name.value.clone(),
            url: entry.url.value.clone(),
            sha256: entry.sha256.value.to_ascii_lowercase(),
            place: place.file.map_or_else(String::new, |file| format!("{file}:{line}:{column}")),
        };
        let used = used(&asset.name);
        UsedAsset { asset, used }
    };
    checker.assets.entries.0.iter().map(asset).collect()
}

/// Returns all paths of descriptions and shapes, with their positions.
fn paths(
    checker: &Checker<'_>,
    tasks: &[Located<TaskEntry>],
    planner: Option<&Located<PlannerEntry>>,
) -> Vec<(NodeId, String)> {
    let tree = &checker.tree;
    let mut all = Vec::new();
    // Tasks and planning robots use the same keys.
    let tasks = tasks.iter().filter_map(|task| task.params.as_ref()).map(|params| params.at);
    let robots = planner.iter().flat_map(|planner| planner.robots.iter()).map(|robot| robot.at);
    for owner in tasks.chain(robots) {
        let packages = tree.get(owner, "package_paths").map(|map| tree.entries(map)).unwrap_or_default();
        let files = ["model_path", "srdf_path", "joint_limits_path"].into_iter().filter_map(|key| tree.get(owner, key));
        let nodes = files.chain(packages.iter().map(|(_, path)| *path));
        all.extend(nodes.filter_map(|at| Some((at, tree.text(at)?.to_owned()))));
    }
    for (_, object) in planner.iter().flat_map(|planner| planner.world.0.iter()) {
        if let ShapeSpec::Mesh(path) | ShapeSpec::Cloud(path) = &object.shape.value {
            all.push((object.shape.at, path.clone()));
        }
    }
    all
}

fn address(checker: &mut Checker<'_>, url: &Located<String>) {
    let schemes = ["https://", "http://", "file://"];
    let rest = schemes.iter().find_map(|scheme| url.strip_prefix(scheme));
    match rest {
        _ if url.is_empty() => {}
        None => {
            let diag = Diag::error(format!("{} is not the URL of a file", quote(url)));
            checker.error(url.at, diag.hint("it starts with https://, http:// or file://"));
        }
        Some(rest) if url.starts_with("file://") && !rest.starts_with('/') && !rest.starts_with("localhost/") => {
            let diag = Diag::error(format!("{} has no absolute path", quote(url)));
            checker.error(url.at, diag.hint("write file:// and the absolute path: file:///home/you/robot.zip"));
        }
        Some(rest) if rest.starts_with('/') && !url.starts_with("file://") || rest.is_empty() => {
            checker.error(url.at, Diag::error(format!("{} names no server", quote(url))));
        }
        Some(_) => {}
    }
}
