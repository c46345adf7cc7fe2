//! What is shipped, made from the program under test: the tarball, the Debian package in a root and in a Debian base,
//! the wheel in a virtual environment.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use rustix::thread::CapabilitySet;

use crate::support::python::python_with;
use crate::support::skip::{skip, skip_privileged};

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

/// Strips the program under test and packs it into a folder. Nothing where a tool is missing.
fn shipped(folder: &Path) -> Option<PathBuf> {
    if !has(&["objcopy", "readelf", "ar", "dpkg", "gzip"]) {
        return None;
    }
    let python = python_with(&["wheel"])?;
    let shipped = folder.join("shipped");
    done(script("strip.sh").arg(env!("CARGO_BIN_EXE_dimos")).arg(&shipped));
    done(script("package.sh").env("PYTHON", python).arg(shipped.join("dimos")).arg(&shipped));
    Some(shipped)
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
    let folder = tempfile::tempdir().unwrap();
    let (built, Some(shipped)) = (Path::new(env!("CARGO_BIN_EXE_dimos")), shipped(folder.path())) else { return };
    let size = |path: &Path| fs::metadata(path).unwrap().len();
    let debug = only(&shipped, "debug");
    assert!(size(&shipped.join("dimos")) < size(built) / 2 && size(&debug) > size(built) / 2, "stripped");
    let sections = done(Command::new("objdump").args(["-s", "-j", ".gnu_debuglink"]).arg(shipped.join("dimos")));
    assert!(sections.contains("dimos-"), "it names its debug file: {sections}");

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
        ("../lib/systemd/user/dimos@.service", "ExecStart=/usr/bin/dimos run %i"),
        ("../lib/systemd/system/dimos-can@.service", "type can bitrate"),
        ("../lib/udev/rules.d/60-dimos.rules", "cpu_dma_latency"),
        ("../../etc/security/limits.d/90-dimos.conf", "@realtime - rtprio 95"),
    ] {
        assert!(fs::read_to_string(share.join(file)).unwrap().contains(says), "{file}");
    }
    dpkg(&["--purge".as_ref(), "dimos".as_ref()]);
    assert!(files(&root.join("usr")).is_empty() && files(&root.join("etc")).is_empty(), "removed");
}

/// `make test-tools` makes the base.
#[test]
fn packages_work_in_a_debian_base_and_leave_it_clean() {
    let bases = Path::new(env!("CARGO_BIN_EXE_dimos")).ancestors().nth(2).unwrap().join("cross");
    let made = fs::read_dir(&bases).is_ok_and(|mut all| all.any(|base| base.unwrap().path().join("made").exists()));
    if !made {
        return skip_privileged("a Debian base (as root, make test-tools)", CapabilitySet::SYS_ADMIN);
    }
    let folder = tempfile::tempdir().unwrap();
    let Some(shipped) = shipped(folder.path()) else { return };
    let tried = done(script("try.sh").env("CARGO_TARGET_DIR", bases.parent().unwrap()).arg(shipped));
    println!("{tried}");
    for (what, limit) in [("to the end of the first motion: ", 60.0), ("wheel, from nothing to a plan: ", 60.0)] {
        let time = tried.split(what).nth(1).and_then(|rest| rest.split(' ').next()?.parse::<f64>().ok());
        assert!(time.is_some_and(|time| time < limit), "{what}\n{tried}");
    }
    assert!(tried.contains("nothing is left but logs"), "{tried}");
}

/// All files below a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    let paths: Vec<PathBuf> = fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path()).collect();
    let mut all: Vec<PathBuf> = Vec::new();
    for path in paths {
        if path.is_dir() && !path.is_symlink() { all.extend(files(&path)) } else { all.push(path) }
    }
    all.sort();
    all
}

#[test]
fn the_wheel_installs_program_and_client_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let Some(shipped) = shipped(folder.path()) else { return };
    let wheel = only(&shipped, "whl");
    let name = wheel.file_name().unwrap().to_str().unwrap();
    assert!(name.starts_with(concat!("dimos_arm-", env!("CARGO_PKG_VERSION"), "-py3-none-manylinux_2_")), "{name}");
    let venv = folder.path().join("venv");
    done(Command::new("python3").args(["-m", "venv"]).arg(&venv));
    let before = files(&venv);
    let pip = |arguments: &[&str]| done(Command::new(venv.join("bin/pip")).args(arguments).env("PIP_NO_INDEX", "1"));
    pip(&["install", "--no-compile", wheel.to_str().unwrap()]);

    let installed = Installed::at(venv.join("bin/dimos"));
    installed.works();
    let asked =
        "import dimos_client, importlib.metadata as m; print(m.version('dimos-arm'), dimos_client.Client.__name__)";
    let mut python = Command::new(venv.join("bin/python"));
    assert_eq!(done(python.args(["-c", asked])), concat!(env!("CARGO_PKG_VERSION"), " Client\n"));
    for file in
        ["man/man1/dimos.1.gz", "bash-completion/completions/dimos", "dimos/blueprints/coordinator-yourarm.yaml"]
    {
        assert!(venv.join("share").join(file).exists(), "{file}");
    }
    // Python dimos has a script of the same name: here, a package that claims it.
    let record = "../../../bin/dimos,,\n";
    let packages = venv.join("lib").read_dir().unwrap().next().unwrap().unwrap().path().join("site-packages");
    let other = packages.join("dimos-0.0.15.dist-info");
    fs::create_dir(&other).unwrap();
    fs::write(other.join("RECORD"), record).unwrap();
    let findings = installed.dimos(&["doctor", "--json"]);
    assert!(findings.contains("the Python package dimos 0.0.15 has a script"), "{findings}");
    fs::remove_dir_all(other).unwrap();

    pip(&["uninstall", "--yes", "dimos-arm"]);
    let left: Vec<PathBuf> = files(&venv).into_iter().filter(|file| !before.contains(file)).collect();
    let caches = left.iter().filter(|file| !file.to_string_lossy().contains("__pycache__"));
    assert_eq!(caches.count(), 0, "{left:?}");
}

#[test]
fn a_user_installs_without_units() {
    let prefix = tempfile::tempdir().unwrap();
    let program = env!("CARGO_BIN_EXE_dimos");
    done(script("install.sh").arg(program).arg(prefix.path()));
    Installed::at(prefix.path().join("bin/dimos")).works();
    assert!(!prefix.path().join("lib").exists());
}
