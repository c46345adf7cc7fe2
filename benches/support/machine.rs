//! Machine of the figures: processor, kernel, versions, and time stolen by the hypervisor.

use std::fs;
use std::process::Command;

/// Returns the processor and its cores.
fn processor() -> String {
    let cpu = read("/proc/cpuinfo");
    let model = cpu.lines().find_map(|l| l.strip_prefix("model name")).map(|l| l.trim_start_matches([' ', '\t', ':']));
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    let virtual_machine = if cpu.contains(" hypervisor") { ", virtual machine" } else { "" };
    format!("{}, {cores} cores{virtual_machine}", model.unwrap_or("unknown processor"))
}

fn date() -> String {
    first_line("date", &["-u", "+%Y-%m-%d %H:%M UTC"]).unwrap_or_default()
}

/// Returns machine, version and date in a line.
pub fn line() -> String {
    let kernel = read("/proc/sys/kernel/osrelease");
    format!("{}; kernel {}; dimos {}; {}", processor(), kernel.trim(), dimos::VERSION, date())
}

/// Prints machine and versions.
pub fn print() {
    let governor = read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor");
    let preemption = if read("/sys/kernel/realtime").trim() == "1" { "PREEMPT_RT" } else { "no PREEMPT_RT" };
    println!("machine   {}", processor());
    println!("kernel    {}, {preemption}", read("/proc/sys/kernel/osrelease").trim());
    println!("governor  {}", if governor.is_empty() { "not readable" } else { governor.trim() });
    println!("load      {}", read("/proc/loadavg").trim());
    println!("dimos     {}", dimos::VERSION);
    println!("rustc     {}", first_line("rustc", &["--version"]).unwrap_or_else(|| "unknown".into()));
    println!("cyclictest  {}", cyclictest().unwrap_or_else(|| "none".into()));
    println!("date      {}\n", date());
}

/// Returns the version of cyclictest, if it is installed.
pub fn cyclictest() -> Option<String> {
    first_line("cyclictest", &["--help"])
}

fn read(path: &str) -> String {
    fs::read_to_string(path).unwrap_or_default()
}

fn first_line(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok()?;
    let text = if output.stdout.is_empty() { output.stderr } else { output.stdout };
    String::from_utf8_lossy(&text).lines().next().map(str::to_owned)
}

/// Processor time so far, over all cores [clock ticks].
#[derive(Debug, Clone, Copy)]
pub struct CpuTimes {
    busy: u64,
    stolen: u64,
    all: u64,
}

impl CpuTimes {
    /// Returns the current values.
    pub fn now() -> Self {
        let stat = read("/proc/stat");
        let line = stat.lines().next().unwrap_or_default();
        // user nice system idle iowait irq softirq steal; the guest times after them are part of the user times.
        let t: Vec<u64> = line.split_whitespace().skip(1).take(8).filter_map(|v| v.parse().ok()).collect();
        let at = |i: usize| t.get(i).copied().unwrap_or_default();
        Self { busy: at(0) + at(1) + at(2) + at(5) + at(6), stolen: at(7), all: t.iter().sum() }
    }

    /// Returns the load of the machine since then, and the time stolen by the hypervisor, in per cent of all cores.
    pub fn since(before: Self) -> (f64, f64) {
        let now = Self::now();
        let part = |of: u64| 100.0 * of as f64 / (now.all - before.all).max(1) as f64;
        (part(now.busy - before.busy), part(now.stolen - before.stolen))
    }
}
