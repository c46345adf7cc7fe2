//! Solids: everything within a radius of a core. A sphere is a point with a radius, a capsule a segment with a radius,
//! and padding enlarges the radius, so only distances between a few kinds of cores are needed.

use std::sync::Arc;

use dimos_kernels::Width;
use dimos_kernels::support::Vertices;
use glamx::{DAffine3, DVec3};
use parry3d_f64::shape::{ConvexPolyhedron, SupportMap, TriMesh, TriMeshFlags};

use super::cloud::Cloud;
use super::cover::Covers;
use super::triangles::Triangles;

/// Why a shape is not usable.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ShapeError {
    /// A length is zero, negative or not finite.
    #[error("{0} must be positive and finite, not {1}")]
    Length(&'static str, f64),
    /// A mesh has no triangles, or refers to missing vertices.
    #[error("the mesh is not usable: {0}")]
    Mesh(String),
    /// The points span no volume.
    #[error("{0} points span no volume: no convex hull")]
    Flat(usize),
    /// A pose is not finite.
    #[error("the pose is not finite")]
    Pose,
}

/// Core of a solid, in its own frame.
#[derive(Debug, Clone)]
pub enum Core {
    /// The origin.
    Point,
    /// A segment of the z axis, from -half to half [m].
    Segment {
        /// Half length [m].
        half: f64,
    },
    /// A box about the origin.
    Box {
        /// Half extents [m].
        half: DVec3,
    },
    /// A cylinder about the origin, along z.
    Cylinder {
        /// Half length [m].
        half: f64,
        /// Radius [m].
        radius: f64,
    },
    /// The convex hull of points.
    Hull(Arc<Hull>),
    /// A triangle mesh; solid if it is closed.
    Mesh(Arc<Mesh>),
    /// A point cloud.
    Cloud(Arc<Cloud>),
}

/// A convex hull with its bounding box.
#[derive(Debug, Clone)]
pub struct Hull {
    polyhedron: ConvexPolyhedron,
    vertices: Vertices,
    middle: DVec3,
    half: DVec3,
    /// The mesh in it, which decides where only the hull touches.
    surface: Option<Arc<Mesh>>,
    /// Whether it is used in place of a mesh that it is larger than.
    rough: bool,
}

/// A closed mesh that fills its hull but for this part of the volume is convex.
const FILLED: f64 = 1e-6;

impl Hull {
    /// Creates the hull of points [m].
    pub fn new(points: &[DVec3]) -> Result<Self, ShapeError> {
        let flat = ShapeError::Flat(points.len());
        if points.iter().any(|p| !p.is_finite()) {
            return Err(ShapeError::Mesh("a vertex is not finite".into()));
        }
        let polyhedron = ConvexPolyhedron::from_convex_hull(points).ok_or(flat)?;
        let corners: Vec<[f64; 3]> = polyhedron.points().iter().map(|p| p.to_array()).collect();
        let vertices = Vertices::new(&corners, Width::widest()).ok_or(ShapeError::Flat(points.len()))?;
        let (middle, half) = bounds(polyhedron.points().iter().copied());
        Ok(Self { polyhedron, vertices, middle, half, surface: None, rough: false })
    }

    /// Creates the hull of a mesh that decides where only the hull touches; a convex one is its hull.
    pub fn of_mesh(mesh: Arc<Mesh>) -> Result<Self, ShapeError> {
        let hull = Self::new(mesh.surface.vertices())?;
        let (points, triangles) = hull.polyhedron.to_trimesh();
        let (whole, own) = (volume(&points, &triangles), volume(mesh.surface.vertices(), mesh.surface.indices()));
        let is_convex = mesh.closed && (whole.abs() - own.abs()).abs() <= FILLED * whole.abs();
        Ok(Self { surface: Some(mesh).filter(|_| !is_convex), ..hull })
    }

    /// Returns whether it is used in place of a mesh: what touches it may not touch the mesh.
    pub fn is_rough(&self) -> bool {
        self.rough
    }

    /// Returns the mesh in it, if that decides where the hull touches.
    pub fn surface(&self) -> Option<&Arc<Mesh>> {
        self.surface.as_ref()
    }

    /// Returns parry's representation.
    pub fn polyhedron(&self) -> &ConvexPolyhedron {
        &self.polyhedron
    }
}

/// Returns the volume within triangles [m³]; its sign is that of their orientation.
fn volume(points: &[DVec3], triangles: &[[u32; 3]]) -> f64 {
    let middle = points.first().copied().unwrap_or_default();
    let part = |corners: &[u32; 3]| {
        let [a, b, c] = corners.map(|i| points[i as usize] - middle);
        a.dot(b.cross(c)) / 6.0
    };
    triangles.iter().map(part).sum()
}

/// The same vertex as the polyhedron's, found several times faster.
impl SupportMap for Hull {
    fn local_support_point(&self, direction: DVec3) -> DVec3 {
        self.vertices.farthest(direction.to_array()).into()
    }
}

/// A triangle mesh with its bounding box.
#[derive(Debug, Clone)]
pub struct Mesh {
    surface: TriMesh,
    triangles: Triangles,
    closed: bool,
    middle: DVec3,
    half: DVec3,
}

impl Mesh {
    /// Creates a mesh from vertices [m] and triangles.
    pub fn new(vertices: Vec<DVec3>, triangles: Vec<[u32; 3]>) -> Result<Self, ShapeError> {
        let bad = |why: &str| ShapeError::Mesh(why.to_owned());
        if vertices.iter().any(|v| !v.is_finite()) {
            return Err(bad("a vertex is not finite"));
        }
        if triangles.iter().flatten().any(|&i| i as usize >= vertices.len()) {
            return Err(bad("a triangle refers to a missing vertex"));
        }
        let (middle, half) = bounds(vertices.iter().copied());
        let merge = TriMeshFlags::MERGE_DUPLICATE_VERTICES | TriMeshFlags::DELETE_DEGENERATE_TRIANGLES;
        let mut surface = TriMesh::with_flags(vertices, triangles, merge).map_err(|e| bad(&e.to_string()))?;
        let closed =
            is_closed(surface.indices()) && surface.set_flags(surface.flags() | TriMeshFlags::ORIENTED).is_ok();
        let triangles = Triangles::new(surface.triangles().map(|t| [t.a, t.b, t.c]));
        Ok(Self { surface, triangles, closed, middle, half })
    }

    /// Returns its triangles as a tree of boxes.
    pub fn triangles(&self) -> &Triangles {
        &self.triangles
    }

    /// Returns parry's representation.
    pub fn surface(&self) -> &TriMesh {
        &self.surface
    }

    /// Returns whether it is closed: every edge has one triangle on each side.
    pub fn is_closed(&self) -> bool {
        self.closed
    }

    /// Returns whether a point in its own frame is inside.
    pub fn holds(&self, p: DVec3) -> bool {
        use parry3d_f64::query::PointQuery;
        (p - self.middle).abs().cmple(self.half).all() && self.surface.contains_local_point(p)
    }
}

fn is_closed(triangles: &[[u32; 3]]) -> bool {
    let mut edges: Vec<(u32, u32)> = triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
    edges.sort_unstable();
    let twice = edges.windows(2).any(|pair| pair[0] == pair[1]);
    !twice && edges.iter().all(|&(a, b)| edges.binary_search(&(b, a)).is_ok())
}

/// Returns the centre and half extents of the bounding box of points.
pub fn bounds(points: impl Iterator<Item = DVec3>) -> (DVec3, DVec3) {
    let start = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    let (low, high) = points.fold(start, |(low, high), p| (low.min(p), high.max(p)));
    ((low + high) * 0.5, (high - low) * 0.5)
}

/// Everything within `radius` of a core at `frame`.
#[derive(Debug, Clone)]
pub struct Solid {
    /// The core.
    pub core: Core,
    /// Distance from the core to the surface [m].
    pub radius: f64,
    /// The core's frame.
    pub frame: DAffine3,
    /// Covers, made when they are first needed; shared by all copies.
    pub(super) covers: Arc<Covers>,
}

fn positive(what: &'static str, x: f64) -> Result<f64, ShapeError> {
    if x > 0.0 && x.is_finite() { Ok(x) } else { Err(ShapeError::Length(what, x)) }
}

impl Solid {
    fn of(core: Core, radius: f64, frame: DAffine3) -> Result<Self, ShapeError> {
        if frame.is_finite() { Ok(Self { core, radius, frame, covers: Arc::default() }) } else { Err(ShapeError::Pose) }
    }

    /// Creates a box with these full extents [m].
    pub fn cuboid(size: DVec3, frame: DAffine3) -> Result<Self, ShapeError> {
        for x in size.to_array() {
            positive("each side of a box", x)?;
        }
        Self::of(Core::Box { half: size * 0.5 }, 0.0, frame)
    }

    /// Creates a sphere [m].
    pub fn sphere(radius: f64, frame: DAffine3) -> Result<Self, ShapeError> {
        Self::of(Core::Point, positive("the radius of a sphere", radius)?, frame)
    }

    /// Creates a cylinder along z with this full length [m].
    pub fn cylinder(radius: f64, length: f64, frame: DAffine3) -> Result<Self, ShapeError> {
        let radius = positive("the radius of a cylinder", radius)?;
        Self::of(Core::Cylinder { half: positive("the length of a cylinder", length)? * 0.5, radius }, 0.0, frame)
    }

    /// Creates a capsule along z; `length` is the distance between the centres of its half spheres [m].
    pub fn capsule(radius: f64, length: f64, frame: DAffine3) -> Result<Self, ShapeError> {
        let half = positive("the length of a capsule", length)? * 0.5;
        Self::of(Core::Segment { half }, positive("the radius of a capsule", radius)?, frame)
    }

    /// Creates the convex hull of points [m].
    pub fn hull(points: &[DVec3], frame: DAffine3) -> Result<Self, ShapeError> {
        Self::of(Core::Hull(Arc::new(Hull::new(points)?)), 0.0, frame)
    }

    /// Creates the convex hull of a mesh, or of a part of it, in place of the mesh.
    pub fn rough_hull(points: &[DVec3], frame: DAffine3) -> Result<Self, ShapeError> {
        let hull = Hull { rough: true, ..Hull::new(points)? };
        Self::of(Core::Hull(Arc::new(hull)), 0.0, frame)
    }

    /// Creates a solid from a mesh: its hull first, and triangle by triangle where only the hull touches.
    pub fn hull_of(mesh: Arc<Mesh>, frame: DAffine3) -> Result<Self, ShapeError> {
        Self::of(Core::Hull(Arc::new(Hull::of_mesh(mesh)?)), 0.0, frame)
    }

    /// Creates a solid from a mesh.
    pub fn mesh(mesh: Arc<Mesh>, frame: DAffine3) -> Result<Self, ShapeError> {
        Self::of(Core::Mesh(mesh), 0.0, frame)
    }

    /// Creates a cloud of balls of one radius [m].
    pub fn cloud(cloud: Arc<Cloud>, radius: f64, frame: DAffine3) -> Result<Self, ShapeError> {
        Self::of(Core::Cloud(cloud), positive("the radius of a cloud's points", radius)?, frame)
    }

    /// Returns the core's pose if its carrier frame is at `carrier`.
    pub fn place(&self, carrier: &DAffine3) -> Placed<'_> {
        let frame = || *carrier * self.frame;
        match &self.core {
            Core::Point => Placed::Point(carrier.transform_point3(self.frame.translation)),
            Core::Segment { half } => {
                let middle = carrier.transform_point3(self.frame.translation);
                let along = carrier.transform_vector3(self.frame.matrix3.z_axis * *half);
                Placed::Segment(middle - along, middle + along)
            }
            Core::Box { half } => Placed::Box(frame(), *half),
            Core::Cylinder { half, radius } => Placed::Cylinder(frame(), *half, *radius),
            Core::Hull(hull) => Placed::Hull(frame(), hull),
            Core::Mesh(mesh) => Placed::Mesh(frame(), mesh),
            Core::Cloud(cloud) => Placed::Cloud(frame(), cloud),
        }
    }

    /// Returns the same solid at another frame.
    pub fn at(mut self, frame: DAffine3) -> Self {
        self.frame = frame;
        self
    }

    /// Returns a bounding ball in the carrier frame: centre and radius [m].
    pub fn ball(&self) -> (DVec3, f64) {
        let (middle, radius) = self.place(&DAffine3::IDENTITY).ball();
        (middle, radius + self.radius)
    }
}

/// A core at its pose, in the common frame of a query.
#[derive(Debug, Clone, Copy)]
pub enum Placed<'a> {
    /// A point.
    Point(DVec3),
    /// The ends of a segment.
    Segment(DVec3, DVec3),
    /// Frame and half extents of a box.
    Box(DAffine3, DVec3),
    /// Frame, half length and radius of a cylinder along z.
    Cylinder(DAffine3, f64, f64),
    /// A hull and its frame.
    Hull(DAffine3, &'a Hull),
    /// A mesh and its frame.
    Mesh(DAffine3, &'a Mesh),
    /// A cloud and its frame.
    Cloud(DAffine3, &'a Cloud),
}

impl Placed<'_> {
    /// Returns whether it is a hull that is not decided by the hull alone.
    pub fn has_surface(&self) -> bool {
        matches!(self, Self::Hull(_, hull) if hull.surface.is_some())
    }

    /// Returns the mesh of a hull that is not decided by the hull alone; otherwise the core itself.
    pub fn decisive(&self) -> Self {
        match self {
            Self::Hull(frame, Hull { surface: Some(mesh), .. }) => Self::Mesh(*frame, mesh),
            other => *other,
        }
    }

    /// Returns a bounding box, for cores that have a frame: its frame and half extents.
    pub fn guard(&self) -> Option<(DAffine3, DVec3)> {
        let around = |f: &DAffine3, middle: DVec3, half: DVec3| {
            let frame = DAffine3 { matrix3: f.matrix3, translation: f.transform_point3(middle) };
            Some((frame, half))
        };
        match self {
            Self::Point(_) | Self::Segment(..) => None,
            Self::Box(f, half) => Some((*f, *half)),
            Self::Cylinder(f, half, radius) => Some((*f, DVec3::new(*radius, *radius, *half))),
            Self::Hull(f, hull) => around(f, hull.middle, hull.half),
            Self::Mesh(f, mesh) => around(f, mesh.middle, mesh.half),
            Self::Cloud(f, cloud) => {
                let (low, high) = cloud.bounds();
                around(f, (low + high) * 0.5, (high - low) * 0.5)
            }
        }
    }

    /// Returns a bounding ball: centre and radius [m].
    pub fn ball(&self) -> (DVec3, f64) {
        match self {
            Self::Point(p) => (*p, 0.0),
            Self::Segment(a, b) => ((*a + *b) * 0.5, a.distance(*b) * 0.5),
            Self::Cylinder(f, half, radius) => (f.translation, half.hypot(*radius)),
            _ => self.guard().map_or((DVec3::ZERO, f64::INFINITY), |(f, half)| (f.translation, half.length())),
        }
    }
}
