//! The targets under libFuzzer: `DIMOS_FUZZ=urdf fuzz CORPUS`. `DIMOS_FUZZ_BUG=2` plants a bug; `--list` prints the
//! names, and `--prepare FOLDER` writes the target's seeds, what is kept of it, and its words there.

#![no_main]

use std::path::Path;
use std::sync::OnceLock;

use dimos_fuzz::{TARGETS, Target, plant};

fn target() -> &'static Target {
    static TARGET: OnceLock<&'static Target> = OnceLock::new();
    TARGET.get_or_init(|| {
        let name = std::env::var("DIMOS_FUZZ").unwrap_or_default();
        Target::named(&name).unwrap_or_else(|| panic!("no target named {name:?}"))
    })
}

/// Writes seeds and words; a word a line, as libFuzzer's dictionaries have them.
fn prepare(folder: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(folder.join("corpus"))?;
    for (i, seed) in (target().seeds)().into_iter().chain(target().kept()).enumerate() {
        std::fs::write(folder.join(format!("corpus/seed{i}")), seed)?;
    }
    let quoted = |word: &String| format!("\"{}\"\n", word.replace('\\', "\\\\").replace('"', "\\\""));
    std::fs::write(folder.join("words"), target().words().iter().map(quoted).collect::<String>())
}

libfuzzer_sys::fuzz_target!(
    init: {
        let arguments: Vec<String> = std::env::args().collect();
        if arguments.iter().any(|argument| argument == "--list") {
            TARGETS.iter().for_each(|target| println!("{}", target.name));
            std::process::exit(0);
        }
        if let [_, prepares, folder, ..] = arguments.as_slice()
            && prepares == "--prepare"
        {
            std::process::exit(prepare(Path::new(folder)).is_err().into());
        }
        plant(std::env::var("DIMOS_FUZZ_BUG").ok().and_then(|bug| bug.parse().ok()).unwrap_or(0));
    },
    |data: &[u8]| (target().run)(data)
);
