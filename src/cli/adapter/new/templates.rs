//! The templates, and what becomes of them for an arm.
//!
//! They are files of a working arm named `acme` with 6 joints, which this crate's tests compile and test as they stand;
//! an arm of another name is made by writing that name, its number of joints and its address in their place.

use super::Transport;
use super::name::Name;

macro_rules! arm {
    ($folder:literal) => {
        [
            ("mod.rs", include_str!(concat!("../../../../assets/templates/", $folder, "/mod.rs"))),
            ("adapter.rs", include_str!(concat!("../../../../assets/templates/", $folder, "/adapter.rs"))),
            ("protocol.rs", include_str!(concat!("../../../../assets/templates/", $folder, "/protocol.rs"))),
            ("golden.rs", include_str!(concat!("../../../../assets/templates/", $folder, "/golden.rs"))),
            ("emulator.rs", include_str!(concat!("../../../../assets/templates/", $folder, "/emulator.rs"))),
        ]
    };
}

const TCP: [(&str, &str); 5] = arm!("tcp");
const CAN: [(&str, &str); 5] = arm!("can");
const SERIAL: [(&str, &str); 5] = arm!("serial");

const BLUEPRINT: &str = include_str!("../../../../assets/templates/blueprint.yaml");
/// What a crate has besides: its path in the crate, and its text.
const CRATE: [(&str, &str); 5] = [
    ("Cargo.toml", include_str!("../../../../assets/templates/crate/manifest.toml")),
    ("README.md", include_str!("../../../../assets/templates/crate/README.md")),
    (".gitignore", include_str!("../../../../assets/templates/crate/gitignore")),
    ("src/main.rs", include_str!("../../../../assets/templates/crate/main.rs")),
    ("tests/conformance.rs", include_str!("../../../../assets/templates/crate/conformance.rs")),
];

/// The arm that is to be written.
#[derive(Debug, Clone)]
pub struct Arm {
    /// Its name.
    pub name: Name,
    /// Number of joints.
    pub dof: u8,
    /// How it is reached.
    pub transport: Transport,
}

impl Arm {
    /// The files of a crate of its own, with their paths below its folder. `dimos` is where the crate finds dimos, as
    /// the manifest writes it: `path = "…"`.
    pub fn own_crate(&self, dimos: &str) -> Vec<(String, String)> {
        let sources = self.sources().iter().map(|(file, text)| {
            let file = if *file == "mod.rs" { "lib.rs" } else { file };
            (format!("src/{file}"), self.code(text))
        });
        let rest = CRATE.iter().map(|(file, text)| match file.ends_with(".rs") {
            true => ((*file).to_owned(), self.code(text)),
            false => ((*file).to_owned(), self.words(text).replace("DIMOS", dimos)),
        });
        rest.chain(sources).chain([(format!("blueprints/{}.yaml", self.blueprint()), self.words(BLUEPRINT))]).collect()
    }

    /// The new files in a checkout of dimos, with their paths below it.
    pub fn in_tree(&self) -> Vec<(String, String)> {
        let folder = format!("src/hardware/arms/{}", self.name.snake);
        let sources = self.sources().iter().map(|(file, text)| {
            let text = self.code(text).replace("dimos::", "crate::");
            (format!("{folder}/{file}"), text)
        });
        sources.chain([(format!("blueprints/{}.yaml", self.blueprint()), self.words(BLUEPRINT))]).collect()
    }

    /// The name of its blueprint.
    pub fn blueprint(&self) -> String {
        format!("coordinator-{}", self.name.kebab)
    }

    fn sources(&self) -> &'static [(&'static str, &'static str)] {
        match self.transport {
            Transport::Tcp => &TCP,
            Transport::Can => &CAN,
            Transport::Serial => &SERIAL,
        }
    }

    /// Rust code of this arm.
    fn code(&self, text: &str) -> String {
        self.joints(text)
            .replace("coordinator-acme", &self.blueprint())
            .replace("acme", &self.name.snake)
            .replace("Acme", &self.name.camel)
    }

    /// Any other text of this arm.
    fn words(&self, text: &str) -> String {
        let address = match self.transport {
            Transport::Tcp => "192.168.1.100",
            Transport::Can => "can0",
            Transport::Serial => "/dev/ttyUSB0",
        };
        self.joints(text)
            .replace("adapter_type: acme", &format!("adapter_type: {}", self.name.snake))
            .replace("acme", &self.name.kebab)
            .replace("Acme", &self.name.camel)
            .replace("ADDRESS", address)
    }

    /// The text with this arm's number of joints.
    fn joints(&self, text: &str) -> String {
        let dof = self.dof;
        let article = if matches!(dof, 8 | 11) { "an" } else { "a" };
        let several = if dof == 1 { "" } else { "s" };
        text.replace("const DOF: usize = 6;", &format!("const DOF: usize = {dof};"))
            .replace("a 6-joint arm", &format!("{article} {dof}-joint arm"))
            .replace("Acme with 6 joints", &format!("Acme with {dof} joint{several}"))
            .replace("count: 6}", &format!("count: {dof}}}"))
    }
}
