//! Settings of the path search, with the names of the papers. Values without a source are measured: `benches/planning`.

use std::time::Duration;

use super::level::Level;
use super::rrt_connect::Quantum;

/// Settings of the path search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanSettings {
    /// Seed of all random numbers.
    pub seed: u64,
    /// How motions are checked.
    pub level: Level,
    /// Tree search.
    pub search: RrtSettings,
    /// Division of work between several searches.
    pub portfolio: PortfolioSettings,
    /// Shortcutting.
    pub shortcut: ShortcutSettings,
    /// Rounds of refinement: more give shorter paths, and take longer.
    pub refine: u32,
    /// Ends the refinement after this time, if given: then the path depends on the speed of the machine.
    pub refine_time: Option<Duration>,
    /// A round of refinement.
    pub refinement: RefineSettings,
    /// Explanation of a search that takes long.
    pub enclosure: EnclosureSettings,
    /// Escape from a start in contact.
    pub escape: EscapeSettings,
    /// Maximum violation of a limit at the start [rad or m]; the motion begins by moving back inside.
    pub limit_tolerance: f64,
    /// Maximum violation of a limit at the goal [rad or m]; the goal is moved to the limit. Covers rounded limits, such
    /// as 3.14159 for π.
    pub goal_tolerance: f64,
}

impl Default for PlanSettings {
    fn default() -> Self {
        Self {
            seed: 0,
            level: Level::default(),
            search: RrtSettings::default(),
            portfolio: PortfolioSettings::default(),
            shortcut: ShortcutSettings::default(),
            refine: 0,
            refine_time: None,
            refinement: RefineSettings::default(),
            enclosure: EnclosureSettings::default(),
            escape: EscapeSettings::default(),
            limit_tolerance: 0.02,
            goal_tolerance: 1e-3,
        }
    }
}

/// Settings of RRT-Connect (Kuffner and LaValle, 2000) with a dynamic domain (Yershova et al., 2005), as in VAMP
/// (Thomason, Kingston and Kavraki, 2024).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RrtSettings {
    /// Maximum edge lengths [rad]: one search with each, in turn. Long edges are best in open space, short ones for
    /// many joints and narrow passages.
    pub ranges: [f64; 3],
    /// Radius of a node's domain after its first failure [rad].
    pub radius: f64,
    /// α: relative growth of the radius with each success, and reduction with each further failure.
    pub alpha: f64,
    /// Minimum radius [rad].
    pub min_radius: f64,
    /// Maximum number of samples.
    pub max_samples: u64,
    /// Maximum number of nodes in all trees.
    pub max_nodes: usize,
    /// Samples that are not connected, which take about as long as the check of an edge.
    pub samples_per_edge: u64,
    /// Samples that are drawn anywhere between the limits before half of them are drawn in the domains of nodes.
    pub uniform_samples: u64,
    /// Consecutive edges in collision after which the ends of the next ones are checked together.
    pub batch_after: u64,
    /// Ends that are checked together, at least: fewer take as long as their edges.
    pub min_batch: usize,
    /// Rounds of drawing samples for a batch, at most: each gives one sample, or uses up sixteen.
    pub max_draws: usize,
}

impl Default for RrtSettings {
    fn default() -> Self {
        Self {
            ranges: [1.0, 0.5, 0.25],
            radius: 4.0,
            alpha: 1e-4,
            min_radius: 1.0,
            max_samples: 100_000_000,
            max_nodes: 1_000_000,
            samples_per_edge: 64,
            uniform_samples: 48,
            batch_after: 8,
            min_batch: 4,
            max_draws: 32,
        }
    }
}

/// Settings of the turns of several searches. Work is counted in edges, so that a plan depends on no clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PortfolioSettings {
    /// Edges per search in the first round; doubled in each further round.
    pub first_quantum: u64,
    /// Factor of the edges of the first search: it finds the path most often, and the work of the others is then
    /// discarded.
    pub main_share: u64,
    /// With more joints than one arm has, long edges are hardly ever free: shorter ones come first, and all searches
    /// get the same number of edges.
    pub joints_of_one_arm: usize,
    /// Cost of a proven edge, in edges checked at samples.
    pub proof_cost: u64,
    /// Rounds after which a search has taken long, and is asked whether start or goal are enclosed.
    pub long_rounds: u32,
    /// Doublings of the quantum, at most.
    pub doublings: u32,
}

impl Default for PortfolioSettings {
    fn default() -> Self {
        Self { first_quantum: 256, main_share: 16, joints_of_one_arm: 8, proof_cost: 4, long_rounds: 4, doublings: 6 }
    }
}

/// Settings of the shortcutting (Geraerts and Overmars, "Creating high-quality paths for motion planning", 2007).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShortcutSettings {
    /// Maximum number of rounds.
    pub rounds: usize,
    /// A corner stays if cutting it would move it by no more than this [rad].
    pub min_change: f64,
    /// Fewest and most random cuts of a path that was found.
    pub cuts: [usize; 2],
    /// Nodes of the search per random cut: a path that took long to find may take longer to shorten.
    pub nodes_per_cut: usize,
}

impl Default for ShortcutSettings {
    fn default() -> Self {
        Self { rounds: 5, min_change: 0.1, cuts: [10, 256], nodes_per_cut: 8 }
    }
}

/// Settings of a round of refinement, with the informed set of Gammell, Srinivasa and Barfoot ("Informed RRT*", 2014).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineSettings {
    /// Random cuts that are tried in a round.
    pub cuts: usize,
    /// Effort of a round's search: a path that is worth it is found quickly, or with another seed.
    pub effort: Quantum,
    /// Least reduction of the length of a path [rad].
    pub min_gain: f64,
    /// A path is kept in addition to a longer one if it is shorter than this part of it.
    pub distinct: f64,
}

impl Default for RefineSettings {
    fn default() -> Self {
        let effort = Quantum { edges: 512, samples: 4096, nodes: 4096 };
        Self { cuts: 12, effort, min_gain: 1e-6, distinct: 0.99 }
    }
}

/// Settings of the test whether a configuration is enclosed: one rapidly exploring random tree (LaValle, 1998).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EnclosureSettings {
    /// Most joints: with those of two arms, so few edges reach too little.
    pub max_joints: usize,
    /// Edges that are tried.
    pub edges: usize,
    /// Length of an edge [rad].
    pub step: f64,
    /// A quarter of the samples are within this distance of a configuration that was reached [rad].
    pub nearby: f64,
    /// One of this number of samples is the other end of the path (goal bias).
    pub bias: usize,
    /// Growth of a joint's range in the second half of the edges below which it counts as still [rad or m] …
    pub still: f64,
    /// … and as a part of its range.
    pub still_part: f64,
    /// A joint that reaches this part of its range is not enclosed.
    pub whole: f64,
    /// Least distance of the other end from a joint's reached range [rad or m].
    pub gap: f64,
    /// Positions of a joint at which a wall is searched.
    pub walls: usize,
    /// Distance of the first of them from the reached range [rad or m]; each is twice as far as the one before.
    pub first_wall: f64,
    /// Configurations that are tried at each of them …
    pub tries: usize,
    /// … and at the one that decides.
    pub last_tries: usize,
    /// Configurations at the end of the reached range whose contacts are examined.
    pub probes: usize,
    /// How far they are moved beyond it [rad].
    pub beyond: f64,
    /// Most pairs that are named.
    pub named: usize,
}

impl Default for EnclosureSettings {
    fn default() -> Self {
        Self {
            max_joints: 8,
            edges: 6000,
            step: 0.15,
            nearby: 0.5,
            bias: 8,
            still: 0.04,
            still_part: 0.02,
            whole: 0.9,
            gap: 0.1,
            walls: 8,
            first_wall: 0.01,
            tries: 256,
            last_tries: 4096,
            probes: 40,
            beyond: 0.05,
            named: 3,
        }
    }
}

/// Settings of the escape from a start in slight contact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EscapeSettings {
    /// Maximum penetration depth at the start [m]; the motion begins by moving out of contact.
    pub max_depth: f64,
    /// Maximum increase of the penetration depth on the way [m].
    pub depth_tolerance: f64,
    /// Collision checks along a piece of the way.
    pub samples: u32,
    /// Random configurations that are tried.
    pub tries: u32,
    /// Largest step of a joint in the first try [rad or m].
    pub first_step: f64,
    /// Its growth until the last try [rad or m].
    pub growth: f64,
}

impl Default for EscapeSettings {
    fn default() -> Self {
        Self { max_depth: 0.003, depth_tolerance: 1e-4, samples: 8, tries: 200, first_step: 0.01, growth: 0.1 }
    }
}
