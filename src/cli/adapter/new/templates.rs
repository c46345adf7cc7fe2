//! The templates, and what becomes of them for an arm.
//!
//! They are files of a working arm named `acme` with 6 joints, which this crate's tests compile and test as they stand;
//! an arm of another name is made by writing that name, its number of joints and its address in their place.

use super::Transport;
use super::description;
use super::name::Name;

/// Files of an arm in its template.
const COMMON: &[&str] = &["mod.rs", "adapter.rs", "protocol.rs", "golden.rs", "emulator.rs"];
const TCP: (&str, &[&str]) = ("tcp", &["wire.rs"]);
const CAN: (&str, &[&str]) = ("can", &[]);
const SERIAL: (&str, &[&str]) = ("serial", &["wire.rs", "calibration.rs"]);

const BLUEPRINT: &str = "blueprint.yaml";
const PLANNER: &str = "planner.yaml";
/// What a crate has besides: its path in the crate, and its template.
const CRATE: [(&str, &str); 6] = [
    ("Cargo.toml", "crate/manifest.toml"),
    ("README.md", "crate/README.md"),
    (".gitignore", "crate/gitignore"),
    ("tests/conformance.rs", "crate/conformance.rs"),
    ("program/Cargo.toml", "crate/program.toml"),
    ("program/main.rs", "crate/main.rs"),
];

/// Files of `assets/templates`: path, text.
static TEMPLATES: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/templates.rs"));

/// Returns a template. All are there: a test asks for each.
fn template(name: &str) -> &'static str {
    TEMPLATES.iter().find(|(file, _)| *file == name).map(|(_, text)| *text).unwrap_or_default()
}

/// Where a crate finds the crates of dimos.
#[derive(Debug, Clone)]
pub enum Source {
    /// A checkout, by its full path.
    Checkout(String),
    /// A repository, by its address.
    Repository(String),
}

impl Source {
    /// The text of a manifest with the places of the two crates that it uses.
    fn put_into(&self, manifest: &str, transport: Transport) -> String {
        let [hardware, program] = match self {
            Self::Checkout(path) => {
                ["/crates/hardware", ""].map(|folder| format!("path = {:?}", path.clone() + folder))
            }
            Self::Repository(address) => [(); 2].map(|()| format!("git = {address:?}")),
        };
        // SocketCAN is a feature: ten packages that the other arms do without.
        let features = if transport == Transport::Can { ", features = [\"can\"]" } else { "" };
        manifest
            .replace("HARDWARE", &format!("{hardware}, default-features = false{features}"))
            .replace("DIMOS", &program)
    }
}

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
    /// The files of a crate of its own, with their paths below its folder.
    pub fn own_crate(&self, dimos: &Source) -> Vec<(String, String)> {
        let sources = self.sources().map(|(file, text)| {
            let file = if file == "mod.rs" { "lib.rs" } else { file };
            (format!("src/{file}"), self.code(text))
        });
        let rest = CRATE.iter().map(|(file, text)| match file.ends_with(".rs") {
            true => ((*file).to_owned(), self.code(template(text))),
            false => ((*file).to_owned(), dimos.put_into(&self.words(template(text)), self.transport)),
        });
        let robot = (format!("robots/{}.urdf", self.name.snake), self.urdf("src/lib.rs"));
        rest.chain(sources).chain(self.blueprints()).chain([robot]).collect()
    }

    /// The new files in a checkout of dimos, with their paths below it.
    pub fn in_tree(&self) -> Vec<(String, String)> {
        let folder = format!("crates/arms/src/{}", self.name.snake);
        let sources = self.sources().map(|(file, text)| (format!("{folder}/{file}"), self.code(text)));
        let robot = (format!("crates/robot/robots/{}.urdf", self.name.snake), self.urdf(&format!("{folder}/mod.rs")));
        sources.chain(self.blueprints()).chain([robot]).collect()
    }

    /// The name of its blueprint.
    pub fn blueprint(&self) -> String {
        format!("coordinator-{}", self.name.kebab)
    }

    /// The name of its blueprint with a planner.
    pub fn planner(&self) -> String {
        format!("{}-planner", self.name.kebab)
    }

    fn blueprints(&self) -> [(String, String); 2] {
        [(self.blueprint(), BLUEPRINT), (self.planner(), PLANNER)]
            .map(|(name, text)| (format!("blueprints/{name}.yaml"), self.words(template(text))))
    }

    fn urdf(&self, limits_in: &str) -> String {
        let about = self.written("Acme, a 6-joint arm", &[]);
        description::urdf(&self.name.snake, &about, self.dof, limits_in)
    }

    fn sources(&self) -> impl Iterator<Item = (&'static str, &'static str)> {
        let (folder, more) = match self.transport {
            Transport::Tcp => TCP,
            Transport::Can => CAN,
            Transport::Serial => SERIAL,
        };
        COMMON.iter().chain(more).map(move |file| (*file, template(&format!("{folder}/{file}"))))
    }

    /// Rust code of this arm.
    fn code(&self, text: &str) -> String {
        let planner = self.planner();
        self.written(text, &[("acme-planner", &planner), ("acme", &self.name.snake)])
    }

    /// Any other text of this arm.
    fn words(&self, text: &str) -> String {
        let address = match self.transport {
            Transport::Tcp => "192.168.1.100",
            Transport::Can => "can0",
            Transport::Serial => "/dev/ttyUSB0",
        };
        let adapter_type = format!("adapter_type: {}", self.name.snake);
        let robot = format!("robots/{}.urdf", self.name.snake);
        let builtin = format!("builtin:{}", self.name.snake);
        let (joints, home) = (description::joint_names(self.dof), description::home(self.dof));
        let zero = vec!["0"; self.dof.into()].join(", ");
        let more = [
            ("adapter_type: acme", &*adapter_type),
            ("robots/acme.urdf", &robot),
            ("builtin:acme", &builtin),
            ("acme", &self.name.kebab),
            ("ADDRESS", address),
            ("JOINTS", &joints),
            ("HOME", &home),
            ("ZERO", &zero),
        ];
        self.written(text, &more)
    }

    /// The text with this arm's name and number of joints, and `more` in place of what it says.
    fn written(&self, text: &str, more: &[(&str, &str)]) -> String {
        let (dof, camel) = (self.dof, &self.name.camel);
        let article = if matches!(dof, 8 | 11) { "an" } else { "a" };
        let several = if dof == 1 { "" } else { "s" };
        let own = [
            ("coordinator-acme", self.blueprint()),
            ("const DOF: usize = 6;", format!("const DOF: usize = {dof};")),
            ("a 6-joint arm", format!("{article} {dof}-joint arm")),
            ("with 6 joints", format!("with {dof} joint{several}")),
            ("count: 6}", format!("count: {dof}}}")),
            ("Acme", camel.clone()),
        ];
        let own = own.iter().map(|(from, to)| (*from, to.as_str()));
        replace(text, &own.chain(more.iter().copied()).collect::<Vec<_>>())
    }
}

/// Replaces the first of each pair by the second, in one pass: inserted text is not replaced again. Where two
/// pairs begin at the same place, the first one counts.
fn replace(text: &str, pairs: &[(&str, &str)]) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    let next =
        |rest: &str| pairs.iter().filter_map(|pair| rest.find(pair.0).map(|at| (at, *pair))).min_by_key(|(at, _)| *at);
    while let Some((at, (from, to))) = next(rest) {
        out.push_str(&rest[..at]);
        out.push_str(to);
        rest = &rest[at + from.len()..];
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arm(name: &str, dof: u8, transport: Transport) -> Arm {
        Arm { name: Name::parse(name).unwrap(), dof, transport }
    }

    #[test]
    fn an_arm_like_the_template_is_the_template() {
        for (transport, sources) in [(Transport::Tcp, TCP), (Transport::Can, CAN), (Transport::Serial, SERIAL)] {
            let files = arm("acme", 6, transport).own_crate(&Source::Checkout("x".into()));
            let (folder, more) = sources;
            for file in COMMON.iter().chain(more) {
                let path = if *file == "mod.rs" { "src/lib.rs".to_owned() } else { format!("src/{file}") };
                let text = template(&format!("{folder}/{file}"));
                assert!(!text.is_empty() && files.contains(&(path, text.to_owned())), "{file}");
            }
        }
    }

    #[test]
    fn names_that_contain_the_template_s_are_put_in_once() {
        let files = arm("acme-2", 8, Transport::Can).own_crate(&Source::Repository("x".into()));
        let text = |path: &str| &files.iter().find(|(p, _)| p == path).unwrap().1;
        assert!(text("program/main.rs").contains("include_str!(\"../blueprints/coordinator-acme-2.yaml\")"));
        assert!(text("program/main.rs").contains("acme_2::SPEC"));
        assert!(text("src/lib.rs").contains("Acme2, an 8-joint arm") && text("src/lib.rs").contains("usize = 8;"));
        assert!(text("src/lib.rs").contains("name: \"acme_2\""));
        assert!(
            text("Cargo.toml").contains("name = \"acme-2\"")
                && text("Cargo.toml").contains("{ git = \"x\", default-features = false, features = [\"can\"] }")
        );
        assert!(text("program/Cargo.toml").contains("dimos = { git = \"x\" }"));
        assert!(text("blueprints/coordinator-acme-2.yaml").contains("adapter_type: acme_2\n"));
        assert!(text("program/main.rs").contains("(\"acme_2\", include_str!(\"../robots/acme_2.urdf\"))"));
        assert!(
            text("program/main.rs")
                .contains("(\"acme-2-planner\", include_str!(\"../blueprints/acme-2-planner.yaml\"))")
        );
        let planner = text("blueprints/acme-2-planner.yaml");
        assert!(planner.contains("model_path: builtin:acme_2 ") && planner.contains("include: [coordinator-acme-2]"));
        assert!(planner.contains("joint_names: [joint1, joint2, joint3, joint4, joint5, joint6, joint7, joint8]"));
        assert!(planner.contains("home: [0, 0.4, 0, 0.4, 0, 0.4, 0, 0.4]"), "{planner}");
        assert!(text("robots/acme_2.urdf").contains("<robot name=\"acme_2\">"));
        assert!(text("README.md").contains("--address arm=can0"));
        assert!(files.iter().all(|(_, text)| !text.is_empty()
            && !text.contains("acme_2_2")
            && !text.contains("DIMOS")
            && !text.contains("HARDWARE")));
    }

    #[test]
    fn in_the_tree_nothing_is_of_another_crate() {
        for transport in [Transport::Tcp, Transport::Can, Transport::Serial] {
            let files = arm("otto", 7, transport).in_tree();
            let count = match transport {
                Transport::Can => 8,
                Transport::Tcp => 9,
                Transport::Serial => 10,
            };
            assert_eq!(files.len(), count);
            let left = |text: &str| text.contains(" dimos::") || text.to_lowercase().contains("acme");
            assert!(files.iter().all(|(_, text)| !left(text)), "{transport:?}");
        }
    }
}
