//! Resolves the file references of a description: `package://`, `file://`, relative paths, `$(find …)`.
//!
//! A reference cannot leave its package by `..`: paths are normalized as text before anything is opened.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Component, Path, PathBuf};
use std::sync::OnceLock;

use percent_encoding::percent_decode_str;

/// Maximum number of parent folders searched for a description's own package.
const MAX_PARENTS: usize = 8;
/// Maximum depth of a package below a folder of `ROS_PACKAGE_PATH`.
const MAX_DEPTH: usize = 5;
/// Maximum number of folders searched below `ROS_PACKAGE_PATH`.
const MAX_FOLDERS: usize = 50_000;

/// Locations of packages.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Packages {
    /// By name: `package_paths` of a blueprint, `--package`.
    named: BTreeMap<String, PathBuf>,
    /// Folders that contain packages at any depth, from `ROS_PACKAGE_PATH`.
    ros: Vec<PathBuf>,
    /// The packages in them, and whether all folders were searched; searched once, when the first is needed.
    crawled: OnceLock<(BTreeMap<String, PathBuf>, bool)>,
    /// Prefixes, from `AMENT_PREFIX_PATH`.
    ament: Vec<PathBuf>,
}

impl Packages {
    /// Uses only packages given by name.
    pub fn named(named: BTreeMap<String, PathBuf>) -> Self {
        Self { named, ..Self::default() }
    }

    /// Adds the packages of ROS's environment variables.
    pub fn with_environment(mut self) -> Self {
        let paths = |name| std::env::var_os(name).map(|v| std::env::split_paths(&v).collect()).unwrap_or_default();
        self.ros = paths("ROS_PACKAGE_PATH");
        self.ament = paths("AMENT_PREFIX_PATH");
        self
    }

    /// Returns the folder of a package: the one given by name, then ROS 1's and ROS 2's, then the package that contains
    /// the file itself. The error lists the folders searched.
    pub fn find(&self, package: &str, beside: &Path) -> Result<PathBuf, String> {
        if package.is_empty() || package.contains(['/', '\\']) || package.starts_with('.') {
            return Err(format!("`{package}` is not a package name"));
        }
        if let Some(folder) = self.named.get(package) {
            return match folder.is_dir() {
                true => Ok(absolute(folder)),
                false => Err(format!("the folder given for package `{package}` does not exist: {}", folder.display())),
            };
        }
        let (crawled, all) = self.crawled.get_or_init(|| crawl(&self.ros, MAX_FOLDERS));
        let crawled = crawled.get(package).cloned();
        // A folder without package.xml, too.
        let direct = self.ros.iter().flat_map(|folder| {
            let itself = is_package(folder, package).then(|| folder.clone());
            itself.into_iter().chain([folder.join(package)])
        });
        let ros = crawled.into_iter().chain(direct);
        let ament = self.ament.iter().map(|prefix| prefix.join("share").join(package));
        if let Some(found) = ros.chain(ament).find(|folder| folder.is_dir()) {
            return Ok(absolute(&found));
        }
        let beside = absolute(beside);
        if let Some(own) = beside.ancestors().take(MAX_PARENTS).find(|folder| is_package(folder, package)) {
            return Ok(own.to_owned());
        }
        let ended = match all {
            true => String::new(),
            false => format!("; the search of ROS_PACKAGE_PATH ended after {MAX_FOLDERS} folders"),
        };
        Err(format!(
            "unknown package `{package}`{ended}\nhint: give its folder: --package {package}=FOLDER, or \
             `package_paths` in a blueprint; ROS_PACKAGE_PATH and AMENT_PREFIX_PATH are searched too"
        ))
    }

    /// Returns the existing file that a URI refers to, for a description in the folder `beside`.
    pub fn resolve(&self, uri: &str, beside: &Path) -> Result<PathBuf, String> {
        let path = if let Some(rest) = uri.strip_prefix("package://").or_else(|| uri.strip_prefix("model://")) {
            let (package, inside) = rest.split_once('/').unwrap_or((rest, ""));
            let root = self.find(package, beside)?;
            // A second slash would make the rest a path from the root of the file system.
            let path = plain(&root.join(decoded(inside).trim_start_matches('/')));
            if !path.starts_with(&root) {
                return Err(format!("`{uri}` points outside its package"));
            }
            path
        } else if let Some(rest) = uri.strip_prefix("file://") {
            let path = decoded(rest);
            match Path::new(&path).is_absolute() {
                true => plain(Path::new(&path)),
                false => plain(&absolute(beside).join(path)),
            }
        } else if let Some((scheme, _)) = uri.split_once("://") {
            return Err(format!("`{scheme}://` is not supported\nhint: use package://, file:// or a path"));
        } else {
            plain(&absolute(beside).join(uri))
        };
        match path.is_file() {
            true => Ok(path),
            false => Err(format!("file not found: {}", path.display())),
        }
    }

    /// Returns the folder that a description in the folder `beside` may include files from: its own package, or
    /// `beside` itself without a package.
    pub fn own(&self, beside: &Path) -> PathBuf {
        let beside = absolute(beside);
        let own = beside.ancestors().take(MAX_PARENTS).find(|folder| folder.join("package.xml").is_file());
        own.unwrap_or(&beside).to_owned()
    }
}

/// Returns whether a folder is a package: by its own name, or by the name in its `package.xml`.
fn is_package(folder: &Path, package: &str) -> bool {
    if folder.file_name().is_some_and(|name| name == package) {
        return true;
    }
    name_in_manifest(folder).is_some_and(|name| name == package)
}

/// Returns the name in a folder's `package.xml`.
fn name_in_manifest(folder: &Path) -> Option<String> {
    let manifest = folder.join("package.xml");
    let small = fs::metadata(&manifest).is_ok_and(|m| m.is_file() && m.len() < 1 << 20);
    let text = if small { fs::read_to_string(manifest).unwrap_or_default() } else { String::new() };
    let (_, rest) = text.split_once("<name>")?;
    rest.split_once("</name>").map(|(name, _)| name.trim().to_owned())
}

/// Returns the packages below some folders by the names in their `package.xml`, as ROS 1 searches them: a package
/// contains no others, a folder with `CATKIN_IGNORE` none at all, and of two with the same name the first one counts.
/// Also returns whether all were searched: at most `limit` folders are.
fn crawl(folders: &[PathBuf], limit: usize) -> (BTreeMap<String, PathBuf>, bool) {
    let (mut found, mut visited) = (BTreeMap::new(), 0);
    for folder in folders {
        let mut open = vec![(absolute(folder), 0)];
        while let Some((folder, depth)) = open.pop() {
            visited += 1;
            if visited > limit {
                return (found, false);
            }
            if folder.join("CATKIN_IGNORE").exists() {
                continue;
            }
            if folder.join("package.xml").is_file() {
                if let Some(name) = name_in_manifest(&folder) {
                    found.entry(name).or_insert(folder);
                }
                continue;
            }
            if depth == MAX_DEPTH {
                continue;
            }
            let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
            let hidden = |entry: &fs::DirEntry| entry.file_name().as_encoded_bytes().starts_with(b".");
            let mut inside: Vec<PathBuf> =
                entries.filter(|e| !hidden(e)).map(|e| e.path()).filter(|path| path.is_dir()).collect();
            // The last is next: in the order of their names.
            inside.sort_by(|a, b| b.cmp(a));
            open.extend(inside.into_iter().map(|path| (path, depth + 1)));
        }
    }
    (found, true)
}

/// Returns an absolute path without `.` and `..`, normalized as text.
pub fn absolute(path: &Path) -> PathBuf {
    plain(&std::path::absolute(path).unwrap_or_else(|_| path.to_owned()))
}

/// Returns a path without `.` and `..`, normalized as text: what is opened is exactly what was checked.
pub fn plain(path: &Path) -> PathBuf {
    let mut out = PathBuf::new();
    for part in path.components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir => {
                if !out.pop() {
                    out.push("..");
                }
            }
            other => out.push(other),
        }
    }
    out
}

/// Decodes `%20` in a URI's path.
fn decoded(text: &str) -> String {
    percent_decode_str(text).decode_utf8().map_or_else(|_| text.to_owned(), Into::into)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for file in
            ["given/a.stl", "ros/p/b.stl", "ament/share/q/c.stl", "own_repo/package.xml", "own_repo/urdf/d e.stl"]
        {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "<package><name>own</name></package>").unwrap();
        }
        folder
    }

    fn packages(root: &Path) -> Packages {
        Packages {
            named: [("g".to_owned(), root.join("given"))].into(),
            ros: vec![root.join("ros")],
            ament: vec![root.join("ament")],
            crawled: OnceLock::new(),
        }
    }

    #[test]
    fn packages_of_a_ros_1_workspace_are_found_at_any_depth_by_the_name_in_their_manifest() {
        let folder = tempfile::tempdir().unwrap();
        let root = absolute(folder.path());
        let package = |path: &str, name: &str| {
            fs::create_dir_all(root.join(path)).unwrap();
            fs::write(root.join(path).join("package.xml"), format!("<package>\n<name> {name} </name></package>"))
                .unwrap();
        };
        package("src/some_repo/robots/z_description", "z_description");
        package("src/foo_description", "my_foo_description");
        package("src/foo_description/inner", "inner");
        package("src/ignored/hidden", "hidden");
        fs::write(root.join("src/ignored/CATKIN_IGNORE"), "").unwrap();
        package("src/a/b/c/d/e/f", "too_deep");
        package("other/z_description", "z_description");
        let ros = vec![root.join("src"), root.join("other")];
        let packages = Packages { ros, ..Packages::default() };
        let find = |name: &str| packages.find(name, Path::new("/")).ok();
        assert_eq!(find("z_description"), Some(root.join("src/some_repo/robots/z_description")));
        assert_eq!(find("my_foo_description"), Some(root.join("src/foo_description")));
        assert_eq!([find("inner"), find("hidden"), find("too_deep")], [None, None, None]);
    }

    #[test]
    fn a_search_that_ended_early_is_reported_with_a_package_that_was_not_found() {
        let folder = tempfile::tempdir().unwrap();
        let root = absolute(folder.path());
        for package in ["a", "b", "c"] {
            fs::create_dir_all(root.join("ros").join(package)).unwrap();
            fs::write(root.join("ros").join(package).join("package.xml"), format!("<name>my_{package}</name>"))
                .unwrap();
        }
        let packages = |limit| {
            let ros = vec![root.join("ros")];
            Packages { crawled: crawl(&ros, limit).into(), ros, ..Packages::default() }
        };
        let (whole, early) = (packages(4), packages(3));
        assert!(whole.find("my_c", Path::new("/")).is_ok() && early.find("my_b", Path::new("/")).is_ok());
        let missing = |packages: &Packages, name| packages.find(name, Path::new("/")).unwrap_err();
        let words = "the search of ROS_PACKAGE_PATH ended after 50000 folders\nhint: ";
        assert!(missing(&early, "my_c").contains(words), "{}", missing(&early, "my_c"));
        assert!(!missing(&whole, "my_d").contains("ended after"));
    }

    #[test]
    fn files_are_found_in_every_way() {
        let folder = folder();
        let (root, beside) = (absolute(folder.path()), folder.path().join("own_repo/urdf"));
        let packages = packages(&root);
        for (uri, file) in [
            ("package://g/a.stl", "given/a.stl"),
            ("package://p/./x/../b.stl", "ros/p/b.stl"),
            ("package://q/c.stl", "ament/share/q/c.stl"),
            ("package://g//a.stl", "given/a.stl"),
            ("package://q/%2Fc.stl", "ament/share/q/c.stl"),
            ("package://own/urdf/d%20e.stl", "own_repo/urdf/d e.stl"),
            ("package://own_repo/urdf/d e.stl", "own_repo/urdf/d e.stl"),
            ("d e.stl", "own_repo/urdf/d e.stl"),
            ("../package.xml", "own_repo/package.xml"),
            (&format!("file://{}/given/a.stl", root.display()), "given/a.stl"),
        ] {
            assert_eq!(packages.resolve(uri, &beside), Ok(root.join(file)), "{uri}");
        }
        assert_eq!(packages.own(&beside), root.join("own_repo"));
        assert_eq!(packages.own(&root.join("ros/p")), root.join("ros/p"));
    }

    #[test]
    fn a_missing_file_or_package_is_reported() {
        let folder = folder();
        let packages = packages(folder.path());
        for (uri, what) in [
            ("package://zz/a.stl", "--package zz=FOLDER"),
            ("package://g/../ros/p/b.stl", "points outside its package"),
            ("package://g/%2e%2e/ros/p/b.stl", "points outside its package"),
            ("package://g//../ros/p/b.stl", "points outside its package"),
            ("package://g/%2F%2e%2e%2Fros/p/b.stl", "points outside its package"),
            ("package://../given/a.stl", "is not a package name"),
            ("package://g/none.stl", "file not found"),
            ("https://x/a.stl", "`https://` is not supported"),
        ] {
            let error = packages.resolve(uri, folder.path()).unwrap_err();
            assert!(error.contains(what), "{uri}: {error}");
        }
    }
}
