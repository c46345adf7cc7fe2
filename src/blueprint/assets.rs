//! The section `assets`, and the paths that lead into them: `asset:NAME/path`.

use std::path::PathBuf;

use crate::assets::{Asset, Cache, split};
use crate::blueprint::planner::{PlannerConfig, RobotConfig, ShapeEntry};
use crate::blueprint::resolve::{Checker, UsedAsset};
use crate::blueprint::schema::AssetEntry;
use crate::yaml::{Diag, Keyed, Located, NodeId, did_you_mean, quote};

/// The assets of a blueprint, while it is checked.
pub(super) struct Assets {
    entries: Keyed<AssetEntry>,
    cache: Cache,
}

impl Assets {
    /// Those of a blueprint, in the user's cache.
    pub fn of(entries: Keyed<AssetEntry>) -> Self {
        Self { entries, cache: Cache::standard() }
    }

    fn entry(&self, name: &str) -> Option<&AssetEntry> {
        self.entries.0.iter().find(|(ours, _)| ours.value == name).map(|(_, entry)| entry)
    }

    /// Where a path into an asset leads; `None` for any other path, and for one into an asset that there is not.
    pub fn path(&self, path: &str) -> Option<PathBuf> {
        let (name, inside) = split(path)?;
        let folder = self.cache.folder(&self.entry(name)?.sha256);
        Some(if inside.is_empty() { folder } else { folder.join(inside) })
    }

    /// Whether a path leads into an asset that has not been fetched yet.
    pub fn awaited(&self, path: &str) -> bool {
        split(path).and_then(|(name, _)| self.entry(name)).is_some_and(|entry| !self.cache.has(&entry.sha256))
    }

    /// Whether a robot's description lies in one.
    pub fn robot_awaited(&self, robot: &RobotConfig) -> bool {
        self.awaited(&robot.model_path) || robot.package_paths.values().any(|path| self.awaited(path))
    }
}

/// Reports entries that cannot be fetched, and paths into assets that there are not.
pub(super) fn check(checker: &mut Checker<'_>, planner: Option<&Located<PlannerConfig>>) {
    for (name, entry) in checker.assets.entries.0.clone() {
        checker.check_name(&name, "asset's name");
        address(checker, &entry.url);
        let sum = &entry.sha256;
        if !sum.is_empty() && (sum.len() != 64 || !sum.chars().all(|c| c.is_ascii_hexdigit())) {
            let diag = Diag::error("a SHA-256 has 64 hexadecimal digits");
            checker.error(sum.at, diag.hint("`sha256sum FILE` prints it"));
        }
    }
    for (at, path) in planner.into_iter().flat_map(|planner| paths(checker, planner)).collect::<Vec<_>>() {
        reference(checker, at, &path);
    }
}

fn reference(checker: &mut Checker<'_>, at: NodeId, path: &str) {
    let Some((name, inside)) = split(path) else { return };
    if inside.split('/').any(|part| part == "..") || inside.starts_with('/') {
        let diag = Diag::error(format!("{} leads out of its asset", quote(path)));
        checker.error(at, diag.hint("write asset:NAME/path, without `..`"));
    } else if checker.assets.entry(name).is_none() {
        let names = checker.assets.entries.0.iter().map(|(name, _)| name.as_str());
        let hint = did_you_mean(name, names, "assets");
        let hint = hint.unwrap_or_else(|| format!("add it: `assets: {{{name}: {{url: …, sha256: …}}}}`"));
        checker.error(at, Diag::error(format!("there is no asset {}", quote(name))).hint(hint));
    }
}

/// The assets with the places of their entries, and whether any path leads into them.
pub(super) fn resolved(checker: &Checker<'_>, planner: Option<&Located<PlannerConfig>>) -> Vec<UsedAsset> {
    let paths: Vec<String> = planner.into_iter().flat_map(|p| paths(checker, p)).map(|(_, path)| path).collect();
    let used = |name: &str| paths.iter().any(|path| split(path).is_some_and(|(ours, _)| ours == name));
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

/// All paths of a planner's files, with their places.
fn paths(checker: &Checker<'_>, planner: &PlannerConfig) -> Vec<(NodeId, String)> {
    let mut all = Vec::new();
    for robot in &planner.robots {
        all.push((robot.model_path.at, robot.model_path.value.clone()));
        let packages = checker.tree.get(robot.at, "package_paths");
        for (name, path) in &robot.package_paths {
            let at = packages.and_then(|map| checker.tree.get(map, name));
            all.push((at.unwrap_or(robot.at), path.clone()));
        }
    }
    for (_, object) in &planner.world.0 {
        if let ShapeEntry::Mesh(path) | ShapeEntry::Cloud(path) = &object.shape.value {
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
            let diag = Diag::error(format!("{} is no address of a file", quote(url)));
            checker.error(url.at, diag.hint("it starts with https://, http:// or file://"));
        }
        Some(rest) if url.starts_with("file://") && !rest.starts_with('/') => {
            let diag = Diag::error(format!("{} has no full path", quote(url)));
            checker.error(url.at, diag.hint("write file:// and the path from the root: file:///home/you/robot.zip"));
        }
        Some(rest) if rest.starts_with('/') && !url.starts_with("file://") || rest.is_empty() => {
            checker.error(url.at, Diag::error(format!("{} names no server", quote(url))));
        }
        Some(_) => {}
    }
}
