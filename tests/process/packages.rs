//! What is shipped, made from the program under test: the tarball, and the Debian package installed in a root of its
//! own.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use crate::support::skip::skip;

/// Whether the tools are there.
pub fn has(tools: &[&str]) -> bool {
    let missing = |tool: &&&str| {
        let found = Command::new(**tool).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        found.is_err()
    };
    let Some(tool) = tools.iter().find(missing) else { return true };
    skip(tool);
    false
}

#[track_caller]
pub fn done(command: &mut Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let (out, err) = (String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert!(status.success(), "{command:?}: {status}\n{out}{err}");
    out.into_owned()
}

fn script(name: &str) -> Command {
    let mut command = Command::new(Path::new(env!("CARGO_MANIFEST_DIR")).join("packaging").join(name));
    command.env("COMPRESS", "none");
    command
}

/// The one file in a folder with this ending.
fn only(folder: &Path, ending: &str) -> PathBuf {
    let files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files = files.filter(|path| path.extension() == Some(OsStr::new(ending)));
    let file = files.next().unwrap_or_else(|| panic!("no .{ending} in {}", folder.display()));
    assert_eq!(files.next(), None);
    file
}

/// An installed program, started by a user who has nothing.
struct Installed {
    program: PathBuf,
    home: tempfile::TempDir,
}

impl Installed {
    fn at(program: PathBuf) -> Self {
        Self { program, home: tempfile::tempdir().unwrap() }
    }

    #[track_caller]
    fn dimos(&self, arguments: &[&str]) -> String {
        let mut command = Command::new(&self.program);
        done(command.args(arguments).env_clear().env("HOME", self.home.path()).current_dir(self.home.path()))
    }

    /// It says its version, knows its arms and its blueprints.
    #[track_caller]
    fn works(&self) {
        assert!(self.dimos(&["--version"]).starts_with(concat!("dimos ", env!("CARGO_PKG_VERSION"))));
        assert!(self.dimos(&["list-adapters"]).contains("xarm"));
        self.dimos(&["check", "coordinator-yourarm"]);
    }
}

#[test]
fn the_tarball_and_the_debian_package_install_and_run() {
    if !has(&["objcopy", "ar", "dpkg", "gzip"]) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (built, shipped) = (Path::new(env!("CARGO_BIN_EXE_dimos")), folder.path().join("shipped"));
    done(script("strip.sh").arg(built).arg(&shipped));
    let size = |path: &Path| fs::metadata(path).unwrap().len();
    let debug = only(&shipped, "debug");
    assert!(size(&shipped.join("dimos")) < size(built) / 2 && size(&debug) > size(built) / 2, "stripped");
    let sections = done(Command::new("objdump").args(["-s", "-j", ".gnu_debuglink"]).arg(shipped.join("dimos")));
    assert!(sections.contains("dimos-"), "it names its debug file: {sections}");
    done(script("dist.sh").arg(shipped.join("dimos")).arg(&shipped));

    let unpacked = folder.path().join("unpacked");
    fs::create_dir(&unpacked).unwrap();
    done(Command::new("tar").arg("-xf").arg(only(&shipped, "tar")).arg("-C").arg(&unpacked));
    let top = fs::read_dir(&unpacked).unwrap().next().unwrap().unwrap().path();
    Installed::at(top.join("bin/dimos")).works();

    // An empty system: dpkg's own records and nothing else.
    let root = folder.path().join("root");
    fs::create_dir_all(root.join("var/lib/dpkg/info")).unwrap();
    fs::create_dir_all(root.join("var/lib/dpkg/updates")).unwrap();
    fs::write(root.join("var/lib/dpkg/status"), "").unwrap();
    let dpkg = |arguments: &[&OsStr]| {
        let mut command = Command::new("dpkg");
        let options = ["--force-script-chrootless", "--force-not-root", "--force-depends", "--force-bad-path"];
        command.arg(format!("--root={}", root.display())).args(options).args(arguments);
        done(&mut command)
    };
    dpkg(&["--install".as_ref(), only(&shipped, "deb").as_os_str()]);
    let records = dpkg(&["--status".as_ref(), "dimos".as_ref()]);
    assert!(records.contains("Status: install ok installed") && records.contains("libc6 (>= 2."), "{records}");
    let installed = Installed::at(root.join("usr/bin/dimos"));
    installed.works();

    let share = root.join("usr/share");
    for blueprint in fs::read_dir(share.join("dimos/blueprints")).unwrap() {
        installed.dimos(&["check", blueprint.unwrap().path().to_str().unwrap()]);
    }
    for verb in ["dimos", "dimos-run", "dimos-arm-reset"] {
        let page = share.join(format!("man/man1/{verb}.1.gz"));
        assert!(done(Command::new("gzip").arg("-dc").arg(&page)).contains(".TH "), "{verb}");
    }
    for (file, says) in [
        ("bash-completion/completions/dimos", "COMPLETE="),
        ("zsh/vendor-completions/_dimos", "#compdef dimos"),
        ("fish/vendor_completions.d/dimos.fish", "--command dimos"),
        ("doc/dimos/copyright", "Apache License"),
        ("dimos/python/dimos_client/client.py", "class Client"),
        ("dimos/python/pyproject.toml", "dimos-client"),
        ("../lib/systemd/system/dimos@.service", "ExecStart=/usr/bin/dimos run %i"),
    ] {
        assert!(fs::read_to_string(share.join(file)).unwrap().contains(says), "{file}");
    }
    dpkg(&["--purge".as_ref(), "dimos".as_ref()]);
    assert!(!root.join("usr/bin/dimos").exists(), "removed");
}

#[test]
fn a_user_installs_without_units() {
    let prefix = tempfile::tempdir().unwrap();
    let program = env!("CARGO_BIN_EXE_dimos");
    done(script("install.sh").arg(program).arg(prefix.path()));
    Installed::at(prefix.path().join("bin/dimos")).works();
    assert!(!prefix.path().join("lib").exists());
}
