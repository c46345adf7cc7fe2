//! `cyclictest` as the reference: same FIFO priority, deep idle states disabled, memory locked.

use std::process::Command;
use std::time::Duration;

use crate::Lateness;

/// Maximum lateness that its histogram resolves [µs].
const LATEST: usize = 20_000;

/// Runs it for this time; fails if its output is not understood.
pub fn run(period: Duration, time: Duration, priority: i32) -> Result<Lateness, String> {
    let output = Command::new("cyclictest")
        .args(["--mlockall", "--threads=1", "--policy=fifo", "--latency=0", "--quiet"])
        .arg(format!("--priority={priority}"))
        .arg(format!("--interval={}", period.as_micros()))
        .arg(format!("--duration={}", time.as_secs()))
        .arg(format!("--histogram={LATEST}"))
        .output()
        .map_err(|e| e.to_string())?;
    let text = String::from_utf8_lossy(&output.stdout);
    let mut counts = Vec::new();
    for line in text.lines() {
        if let Some((late, count)) = line.split_once(' ')
            && let (Ok(late), Ok(count)) = (late.parse::<u32>(), count.trim().parse::<usize>())
        {
            counts.push((f64::from(late), count));
        }
    }
    let longest = text.lines().find_map(|l| l.strip_prefix("# Max Latencies:")).and_then(|v| v.trim().parse().ok());
    let counted: usize = counts.iter().map(|(_, n)| n).sum();
    match longest {
        Some(longest) if counted > 0 => Ok(Lateness::of_counts(&counts, longest)),
        _ => Err(String::from_utf8_lossy(&output.stderr).lines().next().unwrap_or("no figures").to_owned()),
    }
}
