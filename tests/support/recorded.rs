//! How real arms' readings differ from a smooth motion, from `../shared/recordings`: facts for honest trials.

use std::path::Path;

/// Differences per joint [rad], and the period of the rows [s].
pub type Residuals = (f64, Vec<Vec<f64>>);

/// A Piper in MOVE J: staircases, joint by joint, with steps back. Against the mean of nine readings.
pub fn piper_move(folder: &Path) -> Residuals {
    let text = std::fs::read_to_string(folder.join("piper_move.txt")).unwrap();
    let parse = |line: &str| line.split_whitespace().map(|n| (1e-3 * n.parse::<f64>().unwrap()).to_radians()).collect();
    let rows: Vec<Vec<f64>> = text.lines().filter(|line| !line.starts_with('#')).map(parse).collect();
    let smooth = |k: usize, j: usize| {
        let near = &rows[k.saturating_sub(4)..(k + 5).min(rows.len())];
        near.iter().map(|row| row[j]).sum::<f64>() / near.len() as f64
    };
    // Of the middle, where nine readings lie around each.
    let residual = |k: usize| (0..6).map(|j| rows[k][j] - smooth(k, j)).collect();
    (0.005, (4..rows.len() - 4).map(residual).collect())
}

/// A UR3e: measured against its controller's targets.
pub fn ur3e(folder: &Path) -> Residuals {
    let text = std::fs::read_to_string(folder.join("ur3e_rtde.csv")).unwrap();
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let column = |name: String| names.iter().position(|n| *n == name).unwrap();
    let pairs: Vec<(usize, usize)> =
        (0..6).map(|j| (column(format!("actual_q_{j}")), column(format!("target_q_{j}")))).collect();
    let rows = lines.map(|line| {
        let values: Vec<f64> = line.split(',').map(|n| n.parse().unwrap_or(0.0)).collect();
        pairs.iter().map(|(actual, target)| values[*actual] - values[*target]).collect()
    });
    (0.04, rows.collect())
}
