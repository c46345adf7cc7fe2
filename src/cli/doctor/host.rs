//! The checks. They only read, except that the sockets folder is tested with a temporary name.

use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};

use rustix::fs::Access;
use rustix::process::{Resource, getrlimit};

use super::{Finding, installed};
use crate::share;
use dimos_log::files::log_folder;
use dimos_rpc::run_dir::RunDir;
use dimos_rt::host::WATCHDOG_PRIORITY;

/// Type of CAN links in `/sys/class/net/*/type` (ARPHRD_CAN).
const CAN: &str = "280";
/// Free space below which the log folder gets a warning [bytes].
const MIN_FREE_SPACE: u64 = 1 << 30;
/// Clock sources that are read without a system call.
const FAST_CLOCKS: &[&str] = &["tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter"];

const RT_KERNEL: &str = "sudo apt install linux-image-rt-amd64 # Ubuntu: pro enable realtime-kernel";
/// Where the package is installed, its limits and rules wait for members of the group.
const JOIN: &str = "sudo usermod -aG realtime $USER      # then log in again";
const LIMITS: &str = "etc/security/limits.d/90-dimos.conf";
const RULES: &str = "lib/udev/rules.d/60-dimos.rules";
const CAN_UNIT: &str = "lib/systemd/system/dimos-can@.service";
const RTPRIO: &str = "sudo groupadd -f realtime && sudo usermod -aG realtime $USER && echo '@realtime - rtprio 95' | sudo tee -a /etc/security/limits.d/90-realtime.conf      # then log in again";
const MEMLOCK: &str = "sudo groupadd -f realtime && sudo usermod -aG realtime $USER && echo '@realtime - memlock unlimited' | sudo tee -a /etc/security/limits.d/90-realtime.conf      # then log in again";
const LATENCY: &str = "echo 'KERNEL==\"cpu_dma_latency\", GROUP=\"realtime\", MODE=\"0660\"' | sudo tee /etc/udev/rules.d/90-cpu-dma-latency.rules && sudo udevadm control --reload && sudo udevadm trigger --name-match=cpu_dma_latency";
const GOVERNOR: &str = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor";
const CLOCK: &str = "echo tsc | sudo tee /sys/devices/system/clocksource/clocksource0/current_clocksource      # lasts until the next boot";

/// A computer, seen through its files.
pub struct Host {
    root: PathBuf,
}

impl Host {
    /// Returns this computer.
    pub fn this() -> Self {
        Self { root: PathBuf::from("/") }
    }

    /// Runs all checks.
    pub fn examine(&self) -> Vec<Finding> {
        let mut findings = vec![
            installed::parts(&self.root),
            self.kernel(),
            self.rtprio(),
            self.memlock(),
            self.latency(),
            self.governor(),
            self.clock(),
        ];
        findings.push(log_room());
        findings.push(sockets());
        findings.extend(self.can_links());
        findings.extend(self.serial_ports());
        findings.extend(certificates());
        if let Ok(program) = std::env::current_exe().and_then(|program| program.canonicalize()) {
            let path = std::env::var_os("PATH").unwrap_or_default();
            findings.splice(0..0, installed::namesakes(&program, &path));
        }
        findings
    }

    /// Returns the remedy: shorter where the package has set up its part.
    fn remedy(&self, part: &str, alone: &'static str) -> &'static str {
        if installed::has(&self.root, part) { JOIN } else { alone }
    }

    fn path(&self, path: &str) -> PathBuf {
        self.root.join(path)
    }

    /// Reads a file of one line.
    fn read(&self, path: &str) -> Option<String> {
        fs::read_to_string(self.path(path)).ok().map(|text| text.trim().to_owned())
    }

    /// Returns the sorted names in a folder.
    fn names(&self, folder: &str) -> Vec<String> {
        let entries = fs::read_dir(self.path(folder)).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
        names.sort();
        names
    }

    fn kernel(&self) -> Finding {
        let release = self.read("proc/sys/kernel/osrelease").unwrap_or_else(|| "unknown".into());
        let version = self.read("proc/sys/kernel/version").unwrap_or_default();
        let is_rt = self.read("sys/kernel/realtime").as_deref() == Some("1") || version.contains("PREEMPT_RT");
        let kind = if is_rt { "PREEMPT_RT" } else { "not PREEMPT_RT: wake-ups may be late by 1 ms or more" };
        Finding::of(is_rt, "kernel", format!("{release}, {kind}"), RT_KERNEL)
    }

    /// Returns whether this process has a capability (23 = CAP_SYS_NICE, 14 = CAP_IPC_LOCK).
    fn has_capability(&self, bit: u32) -> bool {
        let status = self.read("proc/self/status").unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
        line.and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok()).is_some_and(|caps| caps & (1 << bit) != 0)
    }

    fn rtprio(&self) -> Finding {
        let limit = getrlimit(Resource::Rtprio).current;
        let wanted = WATCHDOG_PRIORITY as u64;
        match limit {
            _ if self.has_capability(23) => Finding::ok("rtprio", "any priority (CAP_SYS_NICE)"),
            None => Finding::ok("rtprio", "any priority"),
            Some(most) => Finding::of(
                most >= wanted,
                "rtprio",
                format!("real-time priorities up to {most} are allowed; a run uses up to {wanted}"),
                self.remedy(LIMITS, RTPRIO),
            ),
        }
    }

    fn memlock(&self) -> Finding {
        match getrlimit(Resource::Memlock).current {
            _ if self.has_capability(14) => Finding::ok("memlock", "unlimited (CAP_IPC_LOCK)"),
            None => Finding::ok("memlock", "unlimited"),
            Some(most) => {
                let found = format!("{} KiB may be locked, not all", most >> 10);
                Finding::warn("memlock", found, self.remedy(LIMITS, MEMLOCK))
            }
        }
    }

    fn latency(&self) -> Finding {
        let check = "cpu_dma_latency";
        match OpenOptions::new().write(true).open(self.path("dev/cpu_dma_latency")) {
            Ok(_) => Finding::ok(check, "deep idle states can be disabled"),
            Err(e) => {
                let found = format!("deep idle states cannot be disabled: {e}");
                Finding::warn(check, found, self.remedy(RULES, LATENCY))
            }
        }
    }

    fn governor(&self) -> Finding {
        let of_cpu = |cpu: String| self.read(&format!("sys/devices/system/cpu/{cpu}/cpufreq/scaling_governor"));
        let mut governors: Vec<String> = self.names("sys/devices/system/cpu").into_iter().filter_map(of_cpu).collect();
        governors.sort();
        governors.dedup();
        if governors.is_empty() {
            return Finding::ok("governor", "the kernel does not scale the clock here");
        }
        let well = governors == ["performance"];
        Finding::of(well, "governor", governors.join(", "), GOVERNOR)
    }

    fn clock(&self) -> Finding {
        let folder = "sys/devices/system/clocksource/clocksource0";
        let Some(current) = self.read(&format!("{folder}/current_clocksource")) else {
            return Finding::ok("clock source", "unknown to the kernel");
        };
        let well = FAST_CLOCKS.contains(&current.as_str());
        let offered = self.read(&format!("{folder}/available_clocksource")).unwrap_or_default();
        let fix = match offered.split_whitespace().any(|clock| clock == "tsc") {
            true => CLOCK,
            false => "dmesg | grep -i tsc      # shows why the kernel does not trust it; check the firmware settings",
        };
        let slow = if well { "" } else { ": each reading of the time is a system call" };
        Finding::of(well, "clock source", format!("{current}{slow}"), fix)
    }

    fn can_links(&self) -> Vec<Finding> {
        let is_can = |name: &String| self.read(&format!("sys/class/net/{name}/type")).as_deref() == Some(CAN);
        let links: Vec<String> = self.names("sys/class/net").into_iter().filter(is_can).collect();
        if links.is_empty() {
            return vec![Finding::ok("CAN links", "none; only arms on CAN need one")];
        }
        let of_link = |name: String| {
            // IFF_UP is the lowest bit.
            let flags = self.read(&format!("sys/class/net/{name}/flags")).unwrap_or_default();
            let flags = u32::from_str_radix(flags.trim_start_matches("0x"), 16).unwrap_or_default();
            let up = flags & 1 == 1;
            let found = format!("{name} is {}", if up { "up" } else { "down" });
            let fix = match installed::has(&self.root, CAN_UNIT) {
                true => format!("sudo systemctl enable --now dimos-can@{name}      # 1 Mbit/s, now and at every boot"),
                false => format!("sudo ip link set {name} up type can bitrate 1000000      # the bitrate of the arm"),
            };
            Finding::of(up, "CAN link", found, fix)
        };
        links.into_iter().map(of_link).collect()
    }

    fn serial_ports(&self) -> Vec<Finding> {
        let is_port = |name: &String| name.starts_with("ttyUSB") || name.starts_with("ttyACM");
        let of_port = |name: String| {
            let open = rustix::fs::access(self.path(&format!("dev/{name}")), Access::READ_OK | Access::WRITE_OK);
            let found = format!(
                "/dev/{name} {}",
                if open.is_ok() { "can be opened" } else { "is not accessible to this user" }
            );
            Finding::of(open.is_ok(), "serial port", found, "sudo usermod -aG dialout $USER      # then log in again")
        };
        self.names("dev").into_iter().filter(is_port).map(of_port).collect()
    }
}

/// Checks the free space for logs.
/// Returns one finding per place of other computers: whether our certificates for it can be used.
fn certificates() -> Vec<Finding> {
    let check = "certificates";
    let examined = share::check_places().into_iter().map(|(place, result)| match result {
        Ok(None) => Finding::ok(check, format!("place {place}: in order")),
        Ok(Some(soon)) => {
            Finding::warn(check, format!("place {place}: {soon}"), "make a new one: docs/many-machines.md")
        }
        Err(error) => {
            let fix = error.hint.unwrap_or_else(|| "docs/many-machines.md shows how to make certificates".to_owned());
            Finding::warn(check, format!("place {place}: {}", error.message), fix)
        }
    });
    examined.collect()
}

fn log_room() -> Finding {
    let check = "log folder";
    let Some(folder) = log_folder() else {
        let found = "none: neither XDG_STATE_HOME nor HOME is set";
        return Finding::bad(check, found, "export HOME=/home/$(id -un)      # or: dimos run … --no-record");
    };
    let shown = folder.display();
    // Before the first run only a parent folder exists.
    let there = folder.ancestors().find(|folder| folder.is_dir()).unwrap_or(Path::new("/"));
    if rustix::fs::access(there, Access::WRITE_OK | Access::EXEC_OK).is_err() {
        let found = format!("{shown}: {} is not writable", there.display());
        return Finding::bad(
            check,
            found,
            format!("sudo chown $USER {}      # or: dimos run … --no-record", there.display()),
        );
    }
    match rustix::fs::statvfs(there) {
        Ok(disk) => {
            let free = disk.f_bavail.saturating_mul(disk.f_frsize);
            let found = format!("{shown}: {:.1} GiB free", free as f64 / f64::from(1 << 30));
            Finding::of(
                free >= MIN_FREE_SPACE,
                check,
                found,
                format!("du -sh {shown}/* | sort -h      # then remove old logs"),
            )
        }
        Err(e) => Finding::warn(check, format!("{shown}: {e}"), format!("df {shown}")),
    }
}

/// Checks that other users can find runs: claims a name and releases it.
fn sockets() -> Finding {
    let check = "sockets folder";
    let folder = RunDir::standard();
    let shown = folder.path().display();
    match folder.claim(&format!("doctor-{}", std::process::id())) {
        Ok(claim) => {
            drop(claim);
            let live = folder.runs().map_or(0, |runs| runs.len());
            Finding::ok(check, format!("{shown}, {live} live {}", if live == 1 { "run" } else { "runs" }))
        }
        Err(e) => Finding::bad(check, e.to_string(), e.hint()),
    }
}

#[cfg(test)]
mod tests {
    use super::super::Level;
    use super::*;

    fn host(files: &[(&str, &str)]) -> (tempfile::TempDir, Host) {
        let folder = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let root = folder.path().to_owned();
        (folder, Host { root })
    }

    #[test]
    fn a_well_kept_host_has_no_findings() {
        let (_folder, host) = host(&[
            ("proc/sys/kernel/osrelease", "6.12.0-rt\n"),
            ("proc/sys/kernel/version", "#1 SMP PREEMPT_RT Debian\n"),
            ("proc/self/status", "Name:\tdimos\nCapEff:\t000001ffffffffff\n"),
            ("dev/cpu_dma_latency", ""),
            ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n"),
            ("sys/devices/system/cpu/cpu1/cpufreq/scaling_governor", "performance\n"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "tsc\n"),
            ("sys/class/net/eth0/type", "1\n"),
            ("sys/class/net/can0/type", "280\n"),
            ("sys/class/net/can0/flags", "0x40081\n"),
            ("dev/ttyUSB0", ""),
        ]);
        let findings = host.examine();
        let of_root = |f: &&Finding| !matches!(f.check, "program" | "log folder" | "sockets folder");
        assert!(findings.iter().filter(of_root).all(|f| f.level == Level::Ok && f.fix.is_none()), "{findings:?}");
        assert!(findings.iter().any(|f| f.found == "can0 is up"), "{findings:?}");
    }

    #[test]
    fn what_is_not_as_it_should_be_has_a_fix() {
        let (_folder, host) = host(&[
            ("proc/sys/kernel/version", "#1 SMP PREEMPT_DYNAMIC\n"),
            ("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "powersave\n"),
            ("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet\n"),
            ("sys/devices/system/clocksource/clocksource0/available_clocksource", "hpet acpi_pm\n"),
            ("sys/class/net/can1/type", "280\n"),
            ("sys/class/net/can1/flags", "0x40080\n"),
        ]);
        for finding in [host.kernel(), host.latency(), host.governor(), host.clock(), host.can_links().remove(0)] {
            assert_eq!(finding.level, Level::Warn, "{finding:?}");
            assert!(finding.fix.is_some_and(|fix| !fix.is_empty()));
        }
        assert!(host.can_links()[0].fix.as_ref().unwrap().starts_with("sudo ip link set can1 up"));
        assert!(host.clock().fix.unwrap().starts_with("dmesg"), "tsc is not on offer");
        fs::create_dir_all(host.path("usr/lib/udev/rules.d")).unwrap();
        fs::write(host.path("usr").join(RULES), "").unwrap();
        assert_eq!(host.latency().fix.as_deref(), Some(JOIN), "the package's rule is there");
    }
}
