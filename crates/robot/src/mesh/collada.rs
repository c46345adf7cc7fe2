//! Collada (`.dae`): the triangles of its visual scene, in metres.
//!
//! `unit` is applied. `up_axis` is not: x stays x and z stays z, as in RViz, MoveIt and Gazebo, for which robot
//! descriptions are made (docs/decisions/0024).

use std::collections::HashMap;

use nalgebra::{Matrix4, Point3, Rotation3, Unit, Vector3};
use roxmltree::{Document, Node, ParsingOptions};

use super::MAX_TRIANGLES;

/// Maximum depth of nodes, and maximum visits to nodes: instances may multiply.
const MAX_DEPTH: usize = 64;
const MAX_VISITS: usize = 100_000;

type Triangle = [Point3<f64>; 3];

/// Reads the triangles of a file.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Triangle>, String> {
    let text = std::str::from_utf8(bytes).map_err(|_| "the file is not UTF-8".to_owned())?;
    let options = ParsingOptions { nodes_limit: 1_000_000, ..ParsingOptions::default() };
    let xml = Document::parse_with_options(text, options).map_err(|e| format!("not well-formed XML: {e}"))?;
    let root = xml.root_element();
    if root.tag_name().name() != "COLLADA" {
        return Err(format!("the root element is `{}`, not `COLLADA`", root.tag_name().name()));
    }
    let meter = child(root, "asset").and_then(|asset| child(asset, "unit")).and_then(|u| u.attribute("meter"));
    let unit: f64 = meter.map_or(Ok(1.0), |text| text.trim().parse()).unwrap_or(f64::NAN);
    if !(unit.is_finite() && unit > 0.0) {
        return Err(format!("the unit of {} metres", meter.unwrap_or_default()));
    }
    let by_id = root.descendants().filter_map(|node| Some((node.attribute("id")?, node))).collect();
    let mut scene = Scene { by_id, meshes: HashMap::new(), triangles: Vec::new(), visits: 0 };
    let unit = Matrix4::new_scaling(unit);
    match scene.root(root) {
        Some(top) => {
            for node in children(top, "node") {
                scene.node(node, &unit, 0)?;
            }
        }
        None => {
            let libraries = children(root, "library_geometries");
            for geometry in libraries.flat_map(|library| children(library, "geometry")) {
                scene.place(geometry, &unit)?;
            }
        }
    }
    Ok(scene.triangles)
}

fn children<'a, 'i: 'a>(node: Node<'a, 'i>, name: &'static str) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(move |n| n.is_element() && n.tag_name().name() == name)
}

fn child<'a, 'i: 'a>(node: Node<'a, 'i>, name: &'static str) -> Option<Node<'a, 'i>> {
    children(node, name).next()
}

fn numbers(node: Node<'_, '_>) -> Result<Vec<f64>, String> {
    let words = node.text().unwrap_or_default().split_ascii_whitespace();
    words.map(|w| w.parse().map_err(|_| format!("{w:?} is not a number"))).collect()
}

struct Scene<'a, 'i> {
    by_id: HashMap<&'a str, Node<'a, 'i>>,
    /// Triangles of geometries in their own frame.
    meshes: HashMap<roxmltree::NodeId, Vec<Triangle>>,
    triangles: Vec<Triangle>,
    visits: usize,
}

impl<'a, 'i: 'a> Scene<'a, 'i> {
    /// Returns the element that `#id` refers to.
    fn target(&self, url: Option<&str>) -> Result<Node<'a, 'i>, String> {
        let id = url.unwrap_or_default().trim_start_matches('#');
        self.by_id.get(id).copied().ok_or_else(|| format!("no element has the id {id:?}"))
    }

    /// Returns the visual scene: the one that `scene` names, otherwise the first.
    fn root(&self, root: Node<'a, 'i>) -> Option<Node<'a, 'i>> {
        let named = child(root, "scene").and_then(|s| child(s, "instance_visual_scene"));
        let named = named.and_then(|s| self.target(s.attribute("url")).ok());
        named.or_else(|| children(root, "library_visual_scenes").find_map(|l| child(l, "visual_scene")))
    }

    fn node(&mut self, node: Node<'a, 'i>, above: &Matrix4<f64>, depth: usize) -> Result<(), String> {
        self.visits += 1;
        if depth > MAX_DEPTH || self.visits > MAX_VISITS {
            return Err("nodes are nested too deeply, or refer to each other".to_owned());
        }
        let mut transform = *above;
        for element in node.children().filter(Node::is_element) {
            let name = element.tag_name().name();
            if let Some(step) = transformation(name, element)? {
                transform *= step;
            }
        }
        for element in node.children().filter(Node::is_element) {
            let target = |scene: &Self| scene.target(element.attribute("url"));
            match element.tag_name().name() {
                "node" => self.node(element, &transform, depth + 1)?,
                "instance_node" => {
                    let target = target(self)?;
                    self.node(target, &transform, depth + 1)?;
                }
                "instance_geometry" => {
                    let geometry = target(self)?;
                    self.place(geometry, &transform)?;
                }
                "instance_controller" => {
                    let skin = child(target(self)?, "skin").and_then(|skin| skin.attribute("source"));
                    let geometry = self.target(skin)?;
                    self.place(geometry, &transform)?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Adds a geometry's triangles with a transform.
    fn place(&mut self, geometry: Node<'a, 'i>, transform: &Matrix4<f64>) -> Result<(), String> {
        if !self.meshes.contains_key(&geometry.id()) {
            let triangles = self.geometry(geometry)?;
            self.meshes.insert(geometry.id(), triangles);
        }
        let triangles = self.meshes.get(&geometry.id()).map(Vec::as_slice).unwrap_or_default();
        if self.triangles.len() + triangles.len() > MAX_TRIANGLES {
            return Err(format!("more than {MAX_TRIANGLES} triangles"));
        }
        let turned = transform.fixed_view::<3, 3>(0, 0).determinant() < 0.0;
        let moved = triangles.iter().map(|triangle| {
            let [a, b, c] = triangle.map(|p| transform.transform_point(&p));
            if turned { [a, c, b] } else { [a, b, c] }
        });
        self.triangles.extend(moved);
        Ok(())
    }

    fn geometry(&self, geometry: Node<'a, 'i>) -> Result<Vec<Triangle>, String> {
        // Splines and other geometry have no triangles.
        let Some(mesh) = child(geometry, "mesh") else { return Ok(Vec::new()) };
        let mut out = Vec::new();
        for primitive in mesh.children().filter(Node::is_element) {
            let kind = primitive.tag_name().name();
            if !matches!(kind, "triangles" | "polylist" | "polygons" | "tristrips" | "trifans") {
                continue;
            }
            let Some((points, offset, stride)) = self.inputs(primitive)? else { continue };
            let corner = |index: &usize| points.get(*index).copied();
            let mut sizes = child(primitive, "vcount").map(numbers).transpose()?.unwrap_or_default().into_iter();
            for list in children(primitive, "p") {
                let indices = numbers(list)?;
                let mut polygon: Vec<usize> = Vec::new();
                let at_vertex = indices.iter().skip(offset).step_by(stride).map(|i| *i as usize);
                let all: Vec<usize> = at_vertex.collect();
                let mut rest = all.as_slice();
                while !rest.is_empty() {
                    let size = match kind {
                        "triangles" => 3,
                        "polylist" => sizes.next().map_or(rest.len(), |s| s as usize),
                        _ => rest.len(),
                    };
                    let (these, after) = rest.split_at_checked(size.max(1)).unwrap_or((rest, &[]));
                    rest = after;
                    polygon.clear();
                    polygon.extend_from_slice(these);
                    for [a, b, c] in corners(kind, &polygon) {
                        let (Some(a), Some(b), Some(c)) = (corner(&a), corner(&b), corner(&c)) else {
                            return Err("a triangle refers to a missing vertex".to_owned());
                        };
                        out.push([a, b, c]);
                        if out.len() > MAX_TRIANGLES {
                            return Err(format!("more than {MAX_TRIANGLES} triangles"));
                        }
                    }
                }
            }
        }
        Ok(out)
    }

    /// Returns the positions that a primitive's indices refer to, the offset of their index, and the number of indices
    /// per vertex.
    #[expect(clippy::type_complexity, reason = "indices, stride and offset, used once")]
    fn inputs(&self, primitive: Node<'a, 'i>) -> Result<Option<(Vec<Point3<f64>>, usize, usize)>, String> {
        let number = |node: Node<'_, '_>, name: &str| node.attribute(name).and_then(|t| t.trim().parse::<usize>().ok());
        let inputs: Vec<_> = children(primitive, "input").collect();
        let stride = inputs.iter().filter_map(|i| number(*i, "offset")).max().unwrap_or(0).min(64) + 1;
        let Some(vertex) = inputs.iter().find(|i| i.attribute("semantic") == Some("VERTEX")) else { return Ok(None) };
        let offset = number(*vertex, "offset").unwrap_or(0);
        let vertices = self.target(vertex.attribute("source"))?;
        let positions = children(vertices, "input").find(|i| i.attribute("semantic") == Some("POSITION"));
        let Some(positions) = positions else { return Err("vertices without positions".to_owned()) };
        let source = self.target(positions.attribute("source"))?;
        let accessor = child(source, "technique_common").and_then(|t| child(t, "accessor"));
        let array = match accessor.and_then(|a| a.attribute("source")) {
            Some(url) => self.target(Some(url))?,
            None => child(source, "float_array").ok_or("a source without numbers")?,
        };
        let values = numbers(array)?;
        let step = accessor.and_then(|a| number(a, "stride")).unwrap_or(3).max(3);
        let skip = accessor.and_then(|a| number(a, "offset")).unwrap_or(0);
        let values = values.get(skip..).unwrap_or_default();
        let points = values.chunks(step).filter_map(|c| Some(Point3::from_slice(c.get(..3)?))).collect();
        Ok(Some((points, offset, stride)))
    }
}

/// Returns one step of a node's transformation; `None` for other elements.
fn transformation(name: &str, element: Node<'_, '_>) -> Result<Option<Matrix4<f64>>, String> {
    let needed = match name {
        "matrix" => 16,
        "translate" | "scale" => 3,
        "rotate" => 4,
        "lookat" | "skew" => return Err(format!("`{name}` in a node is not supported")),
        _ => return Ok(None),
    };
    let v = numbers(element)?;
    if v.len() != needed {
        return Err(format!("`{name}` takes {needed} numbers, found {}", v.len()));
    }
    Ok(Some(match (name, v.as_slice()) {
        ("matrix", v) => Matrix4::from_row_slice(v),
        ("translate", [x, y, z]) => Matrix4::new_translation(&Vector3::new(*x, *y, *z)),
        ("scale", [x, y, z]) => Matrix4::new_nonuniform_scaling(&Vector3::new(*x, *y, *z)),
        (_, [x, y, z, degrees]) => match Unit::try_new(Vector3::new(*x, *y, *z), 1e-12) {
            Some(axis) => Rotation3::from_axis_angle(&axis, degrees.to_radians()).to_homogeneous(),
            None => Matrix4::identity(),
        },
        _ => Matrix4::identity(),
    }))
}

/// Returns the triangles of one polygon, strip or fan; polygons are assumed convex.
fn corners(kind: &str, polygon: &[usize]) -> Vec<[usize; 3]> {
    match kind {
        "tristrips" => {
            let turn = |(i, w): (usize, &[usize])| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[1], w[0], w[2]] };
            polygon.windows(3).enumerate().map(turn).collect()
        }
        _ => match polygon {
            [first, rest @ ..] => rest.windows(2).map(|w| [*first, w[0], w[1]]).collect(),
            [] => Vec::new(),
        },
    }
}
