//! The same problems with VAMP, by a program that is built from its sources: RRT-Connect and simplification with VAMP's
//! settings, timed as VAMP times itself, without the preparation of the environment.

use std::cell::RefCell;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde::Deserialize;

use crate::problems::Problem;
use crate::{Row, quantile};

/// The program, its input, and the shortest times so far.
pub struct Peer {
    program: PathBuf,
    folder: PathBuf,
    range: f64,
    rows: RefCell<Vec<PeerRow>>,
}

#[derive(Debug, Clone, Deserialize)]
struct PeerRow {
    valid: bool,
    solved: bool,
    plan_us: Option<f64>,
    simplify_us: Option<f64>,
    total_us: Option<f64>,
    cost: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct Answer {
    rows: Vec<PeerRow>,
}

impl Peer {
    /// Writes the problems for a program; `None` without one.
    pub fn of(program: Option<&Path>, problems: &[Problem], range: f64) -> Result<Option<Self>, Box<dyn Error>> {
        let Some(program) = program else { return Ok(None) };
        let folder = std::env::temp_dir().join(format!("dimos-bench-peer-{}", std::process::id()));
        std::fs::create_dir_all(&folder)?;
        let text = problems.iter().map(Problem::text).collect::<Result<String, _>>()?;
        std::fs::write(folder.join("problems.txt"), text)?;
        Ok(Some(Self { program: program.to_owned(), folder, range, rows: RefCell::default() }))
    }

    /// Runs it once over all problems.
    pub fn run(&self) -> Result<(), Box<dyn Error>> {
        let (input, output) = (self.folder.join("problems.txt"), self.folder.join("out.json"));
        let range = self.range.to_string();
        let ran = Command::new(&self.program).arg(&input).args(["1", &range]).arg(&output).output()?;
        if !ran.status.success() {
            return Err(format!("{}: {}", self.program.display(), String::from_utf8_lossy(&ran.stderr)).into());
        }
        let answer: Answer = serde_json::from_str(&std::fs::read_to_string(&output)?)?;
        let mut rows = self.rows.borrow_mut();
        if rows.is_empty() {
            *rows = answer.rows;
            return Ok(());
        }
        for (row, again) in rows.iter_mut().zip(answer.rows) {
            let times = [
                (&mut row.plan_us, again.plan_us),
                (&mut row.simplify_us, again.simplify_us),
                (&mut row.total_us, again.total_us),
            ];
            for (time, again) in times {
                *time = time.zip(again).map(|(a, b)| a.min(b)).or(*time);
            }
        }
        Ok(())
    }

    /// Prints its times beside ours: of the problems that both solved.
    pub fn report(&self, own: &[Row]) {
        let rows = self.rows.borrow();
        let both = || own.iter().zip(rows.iter()).filter(|(own, peer)| own.solved && peer.solved);
        let valid = rows.iter().filter(|row| row.valid).count();
        let solved = rows.iter().filter(|row| row.solved).count();
        println!(
            "\nVAMP in the same rounds: solved {solved}/{valid}/{}; solved by both: {}",
            rows.len(),
            both().count()
        );
        println!(
            "{:<10} {:>10} {:>10} {:>10} {:>10} {:>10} {:>10}",
            "µs", "median", "VAMP", "p95", "VAMP", "mean", "VAMP"
        );
        let line = |name: &str, of: fn(&Row) -> Option<f64>, peers: fn(&PeerRow) -> Option<f64>| {
            let (a, b): (Vec<f64>, Vec<f64>) = both().filter_map(|(own, peer)| Some((of(own)?, peers(peer)?))).unzip();
            let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
            println!(
                "{name:<10} {:>10.1} {:>10.1} {:>10.1} {:>10.1} {:>10.1} {:>10.1}   ratio {:.2} / {:.2} / {:.2}",
                quantile(a.clone(), 0.5),
                quantile(b.clone(), 0.5),
                quantile(a.clone(), 0.95),
                quantile(b.clone(), 0.95),
                mean(&a),
                mean(&b),
                quantile(a.clone(), 0.5) / quantile(b.clone(), 0.5),
                quantile(a.clone(), 0.95) / quantile(b.clone(), 0.95),
                mean(&a) / mean(&b),
            );
        };
        line("plan", |row| row.plan_us, |row| row.plan_us);
        line("simplify", |row| row.simplify_us, |row| row.simplify_us);
        line("total", |row| row.total_us, |row| row.total_us);
        let cost: (Vec<f64>, Vec<f64>) = both().filter_map(|(own, peer)| own.cost.zip(peer.cost)).unzip();
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        println!("mean cost {:.3} rad, VAMP {:.3} rad", mean(&cost.0), mean(&cost.1));
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}
