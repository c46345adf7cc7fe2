//! The kernels of the program under test are compiled with the vectors that they are named after: one that is not is
//! correct, and twenty times slower.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::packages::{done, has};

const PROGRAM: &str = env!("CARGO_BIN_EXE_dimos");
/// Each kernel has more instructions with wide registers than this.
const FEWEST: usize = 12;

/// The functions of the sources for which wide vectors are enabled.
fn in_sources(folder: &Path) -> usize {
    let mut number = 0;
    for entry in fs::read_dir(folder).unwrap() {
        let path: PathBuf = entry.unwrap().path();
        if path.is_dir() {
            number += in_sources(&path);
        } else {
            let text = fs::read_to_string(&path).unwrap();
            number += text.matches("#[target_feature(enable = \"avx").count();
        }
    }
    number
}

/// The same in the program: name, and where it begins and ends.
fn in_program(symbols: &str) -> BTreeMap<String, (u64, u64)> {
    let kernel = |line: &str| {
        let mut fields = line.splitn(4, ' ');
        let mut number = || u64::from_str_radix(fields.next()?, 16).ok();
        let (begin, size) = (number()?, number()?);
        let name = fields.nth(1).filter(|name| name.starts_with("dimos_kernels::"))?;
        (name.ends_with("avx2") || name.ends_with("avx512")).then(|| (name.to_owned(), (begin, begin + size)))
    };
    symbols.lines().filter_map(kernel).collect()
}

#[test]
fn every_kernel_is_compiled_with_its_vectors() {
    if !has(&["nm", "objdump"]) {
        return;
    }
    let symbols = done(Command::new("nm").args(["--demangle", "--print-size", "--defined-only", PROGRAM]));
    let kernels = in_program(&symbols);
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/kernels/src");
    assert_eq!(kernels.len(), in_sources(&sources), "{:?}", kernels.keys());
    for (name, (begin, end)) in &kernels {
        let range = [format!("--start-address={begin}"), format!("--stop-address={end}")];
        let code = done(Command::new("objdump").args(["-d", "--no-show-raw-insn"]).args(range).arg(PROGRAM));
        let register = if name.ends_with("avx512") { "%zmm" } else { "%ymm" };
        let wide = code.lines().filter(|line| line.contains(register)).count();
        assert!(wide > FEWEST, "{name} has {wide} instructions with {register}");
    }
    // An operation that is a function of its own was called by code without the vectors: by a closure, mostly.
    let calls: Vec<&str> = symbols.lines().filter(|s| s.contains("::_mm256_") || s.contains("::_mm512_")).collect();
    assert!(calls.is_empty(), "{calls:#?}");
}
