//! What is installed beside the program: units and rules of the package, and other programs of the same name.

use std::env;
use std::fs::{self, File};
use std::io::Read as _;
use std::path::{Path, PathBuf};

use rustix::fs::Access;

use super::Finding;

/// What a Debian package, or `make install` as root, puts below `/usr` or `/usr/local`.
const PARTS: [(&str, &str); 4] = [
    ("lib/systemd/system/dimos@.service", "systemctl start dimos@BLUEPRINT"),
    ("lib/systemd/user/dimos@.service", "systemctl --user start dimos@BLUEPRINT"),
    ("lib/systemd/system/dimos-can@.service", "systemctl enable --now dimos-can@can0"),
    ("lib/udev/rules.d/60-dimos.rules", "device permissions"),
];

/// Whether this part is installed below a root.
pub fn has(root: &Path, part: &str) -> bool {
    ["usr", "usr/local", ""].iter().any(|prefix| root.join(prefix).join(part).exists())
}

/// Which units and rules are installed.
pub fn parts(root: &Path) -> Finding {
    let there: Vec<&str> = PARTS.iter().filter(|(part, _)| has(root, part)).map(|(_, what)| *what).collect();
    let found = match there.is_empty() {
        true => "no units, no device rules: only the Debian package and sudo make install have them".to_owned(),
        false => there.join(", "),
    };
    Finding::ok("services", found)
}

/// Other programs named `dimos`: those of `path`, the value of PATH, and those of other packages in the Python
/// environment of `program`. Python dimos brings one.
pub fn namesakes(program: &Path, path: &std::ffi::OsStr) -> Vec<Finding> {
    let check = "program";
    let shown = program.display();
    let mut findings = Vec::new();
    let mut is_behind = false;
    for candidate in env::split_paths(path).map(|folder| folder.join("dimos")) {
        let Ok(real) = candidate.canonicalize() else { continue };
        if real == program {
            is_behind = true;
        } else if rustix::fs::access(&real, Access::EXEC_OK).is_ok() && !is_behind {
            let kind = if is_python(&real) { "a script of Python, as Python dimos has" } else { "another program" };
            let found = format!("`dimos` is {}, {kind}; this one is {shown}", candidate.display());
            let folder = program.parent().unwrap_or(Path::new("/")).display();
            findings.push(Finding::warn(
                check,
                found,
                format!("export PATH={folder}:$PATH      # or: alias dimos={shown}"),
            ));
            break;
        }
    }
    for package in claimants(program) {
        let found = format!("the Python package {package} has a script {shown} too: the one installed last is there");
        let fix = "pip install --force-reinstall --no-deps dimos-arm      # it again; better: an environment for each";
        findings.push(Finding::warn(check, found, fix));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(check, format!("{shown}, dimos {}", crate::VERSION)));
    }
    findings
}

/// Whether a file is a script that Python runs.
fn is_python(file: &Path) -> bool {
    let mut head = [0; 128];
    let length = File::open(file).and_then(|mut file| file.read(&mut head)).unwrap_or(0);
    let head = String::from_utf8_lossy(&head[..length]);
    // pip writes long paths of the interpreter into the second line.
    head.starts_with("#!") && head.contains("python")
}

/// Returns the packages, other than our wheel, whose records name `bin/dimos` of the environment that has the program.
fn claimants(program: &Path) -> Vec<String> {
    let folder = |path: PathBuf| fs::read_dir(path).into_iter().flatten().flatten().map(|entry| entry.path());
    let Some(environment) = program.parent().and_then(Path::parent) else { return Vec::new() };
    let pythons = folder(environment.join("lib")).map(|python| python.join("site-packages"));
    let records = pythons.flat_map(folder).filter(|path| path.extension().is_some_and(|e| e == "dist-info"));
    let claims = |path: &PathBuf| {
        let record = fs::read_to_string(path.join("RECORD")).unwrap_or_default();
        record.lines().any(|line| line.starts_with("../../../bin/dimos,"))
    };
    let mut names: Vec<String> = records
        .filter(claims)
        .filter_map(|path| path.file_stem()?.to_str().map(|name| name.replacen('-', " ", 1)))
        .filter(|name| !name.starts_with("dimos_arm "))
        .collect();
    names.sort();
    names
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::super::Level;
    use super::*;

    fn file(path: &Path, text: &str) -> PathBuf {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
        fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
        path.canonicalize().unwrap()
    }

    #[test]
    fn a_namesake_is_found_where_the_shell_would_take_it() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let ours = file(&at("ours/bin/dimos"), "ELF");
        file(&at("theirs/dimos"), "#!/usr/bin/env python3\n");
        let path = |order: [&str; 2]| env::join_paths(order.map(at)).unwrap();
        let found = namesakes(&ours, &path(["theirs", "ours/bin"])).remove(0);
        assert!(found.level == Level::Warn && found.found.contains("script of Python"), "{found:?}");
        let fine = namesakes(&ours, &path(["ours/bin", "theirs"])).remove(0);
        assert_eq!(fine.level, Level::Ok, "{fine:?}");
    }

    #[test]
    fn a_package_that_claims_the_script_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let ours = file(&folder.path().join("bin/dimos"), "ELF");
        let packages = folder.path().join("lib/python3.12/site-packages");
        let claim = "../../../bin/dimos,sha256=x,1\n";
        file(&packages.join("dimos_arm-0.2.0.dist-info/RECORD"), claim);
        file(&packages.join("other-1.0.dist-info/RECORD"), "other.py,,\n");
        assert_eq!(namesakes(&ours, "".as_ref()).remove(0).level, Level::Ok);
        file(&packages.join("dimos-0.0.15.dist-info/RECORD"), claim);
        let found = namesakes(&ours, "".as_ref()).remove(0);
        assert!(found.level == Level::Warn && found.found.contains("dimos 0.0.15"), "{found:?}");
    }

    #[test]
    fn installed_parts_are_listed() {
        let folder = tempfile::tempdir().unwrap();
        assert!(parts(folder.path()).found.starts_with("no units"));
        file(&folder.path().join("usr/local/lib/systemd/user/dimos@.service"), "");
        assert_eq!(parts(folder.path()).found, "systemctl --user start dimos@BLUEPRINT");
    }
}
