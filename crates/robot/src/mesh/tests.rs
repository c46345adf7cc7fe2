use super::*;

const ONE: Vector3<f64> = Vector3::new(1.0, 1.0, 1.0);

/// Vertices and triangles of a tetrahedron, anticlockwise from outside.
const POINTS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
const FACES: [[usize; 3]; 4] = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

fn binary_stl(header: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0; 80];
    bytes[..header.len()].copy_from_slice(header);
    bytes.extend(4u32.to_le_bytes());
    for face in FACES {
        bytes.extend([0; 12]);
        face.iter().flat_map(|i| POINTS[*i]).for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend([0, 0]);
    }
    bytes
}

fn ascii_stl() -> String {
    let vertex = |i: usize| POINTS[i].map(|v| v.to_string()).join(" ");
    let facet = |f: &[usize; 3]| {
        let [a, b, c] = f.map(vertex);
        format!("facet normal 0 0 0\nouter loop\nvertex {a}\nvertex {b}\nvertex {c}\nendloop\nendfacet\n")
    };
    format!("solid t\n{}endsolid t\n", FACES.iter().map(facet).collect::<String>())
}

fn obj() -> String {
    let points: String = POINTS.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
    let faces: String = FACES.iter().map(|f| format!("f {} {} {}\n", f[0] + 1, f[1] + 1, f[2] + 1)).collect();
    format!("mtllib nowhere.mtl\n{points}usemtl none\n{faces}")
}

fn dae(unit: &str, axis: &str, nodes: &str) -> String {
    let points = POINTS.iter().flatten().map(f32::to_string).collect::<Vec<_>>().join(" ");
    // Two indices per vertex: of its position, and of a missing normal.
    let p = FACES.iter().flatten().map(|i| format!("{i} 0")).collect::<Vec<_>>().join(" ");
    format!(
        "<COLLADA xmlns='http://www.collada.org/2005/11/COLLADASchema' version='1.4.1'>\
         <asset><unit meter='{unit}'/><up_axis>{axis}</up_axis></asset>\
         <library_geometries><geometry id='g'><mesh><source id='s'><float_array id='f' count='12'>{points}</float_array>\
         <technique_common><accessor source='#f' count='4' stride='3'/></technique_common></source>\
         <vertices id='v'><input semantic='POSITION' source='#s'/></vertices>\
         <triangles count='4'><input semantic='VERTEX' source='#v' offset='0'/>\
         <input semantic='NORMAL' source='#n' offset='1'/><p>{p}</p></triangles></mesh></geometry></library_geometries>\
         <library_visual_scenes><visual_scene id='x'>{nodes}</visual_scene></library_visual_scenes>\
         <scene><instance_visual_scene url='#x'/></scene></COLLADA>"
    )
}

fn read(name: &str, bytes: &[u8], scale: Vector3<f64>) -> Result<Mesh, String> {
    Mesh::from_bytes(bytes, Path::new(name), scale)
}

/// Returns six times the enclosed volume: negative if the triangles are inside out.
fn volume(mesh: &Mesh) -> f64 {
    let corner = |i: u32| mesh.vertices[i as usize].coords;
    mesh.triangles.iter().map(|[a, b, c]| corner(*a).dot(&corner(*b).cross(&corner(*c)))).sum()
}

#[test]
fn every_format_gives_the_same_mesh() {
    let plain = "<node id='n'><instance_geometry url='#g'/></node>";
    let faces_first = obj();
    let (points, faces) = faces_first.split_once("usemtl none\n").unwrap();
    let faces_first = format!("{faces}{points}");
    for (name, bytes) in [
        ("a.stl", binary_stl(b"binary")),
        ("a.STL", binary_stl(b"solid but binary all the same")),
        ("a.stl", ascii_stl().into_bytes()),
        ("a.stl", ascii_stl().replace('\n', " \r").into_bytes()),
        ("a.obj", obj().into_bytes()),
        ("a.obj", obj().replace("v 1 0 0", "v 2 0 0 2").into_bytes()),
        ("a.obj", faces_first.into_bytes()),
        ("a.dae", dae("1", "Z_UP", plain).into_bytes()),
        ("a.dae", dae("1", "Y_UP", plain).into_bytes()),
    ] {
        let mesh = read(name, &bytes, ONE).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!((mesh.vertices.len(), mesh.triangles.len()), (4, 4), "{name}");
        assert_eq!(mesh.bounds(), (Point3::origin(), Point3::new(1.0, 2.0, 3.0)), "{name}");
        assert!((volume(&mesh) - 6.0).abs() < 1e-12, "{name}");
    }
}

#[test]
fn a_line_break_after_the_triangles_of_a_binary_file_is_accepted() {
    for end in ["\n", "\r\n"] {
        let bytes = [binary_stl(b""), end.as_bytes().to_vec()].concat();
        assert_eq!(read("a.stl", &bytes, ONE).unwrap().triangles.len(), 4, "{end:?}");
    }
}

#[test]
fn scales_apply_and_mirrors_stay_right_side_out() {
    for (scale, high) in [([0.001, 0.001, 0.001], 0.003), ([1.0, -1.0, 1.0], 3.0), ([-1.0, -1.0, 2.0], 6.0)] {
        let mesh = read("a.stl", &binary_stl(b""), scale.into()).unwrap();
        assert!((mesh.bounds().1.z - high).abs() < 1e-12);
        assert!(volume(&mesh) > 0.0, "{scale:?}");
    }
}

#[test]
fn units_and_nodes_of_collada_apply() {
    let nodes = "<node><translate>0 0 100</translate><rotate>0 0 1 90</rotate>\
                   <node><scale>2 2 2</scale><instance_geometry url='#g'/></node></node>\
                 <node><matrix>1 0 0 500 0 1 0 0 0 0 1 0 0 0 0 1</matrix><instance_geometry url='#g'/></node>";
    let mesh = read("a.dae", dae("0.01", "Z_UP", nodes).as_bytes(), ONE).unwrap();
    assert_eq!((mesh.vertices.len(), mesh.triangles.len()), (8, 8));
    let (low, high) = mesh.bounds();
    // The first: scaled by two, rotated by 90° about z, one metre up. The second: five metres along x.
    assert!((low - Point3::new(-0.04, 0.0, 0.0)).norm() < 1e-9, "{low}");
    assert!((high - Point3::new(5.01, 0.02, 1.06)).norm() < 1e-9, "{high}");
    let mirrored = "<node><scale>1 1 -1</scale><instance_geometry url='#g'/></node>";
    assert!(volume(&read("a.dae", dae("1", "Z_UP", mirrored).as_bytes(), ONE).unwrap()) > 0.0);
}

#[test]
fn polygons_strips_and_fans_are_triangles() {
    let square = |kind: &str, inside: &str| {
        let primitive = format!("<{kind}><input semantic='VERTEX' source='#v' offset='0'/>{inside}</{kind}>");
        let text = dae("1", "Z_UP", "<node><instance_geometry url='#g'/></node>");
        let (before, rest) = text.split_once("<triangles").unwrap();
        let (_, after) = rest.split_once("</triangles>").unwrap();
        read("a.dae", format!("{before}{primitive}{after}").as_bytes(), ONE).unwrap().triangles
    };
    let fan = vec![[0, 1, 2], [0, 2, 3]];
    assert_eq!(square("polylist", "<vcount>4 3</vcount><p>0 1 2 3 0 1 2</p>"), [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
    assert_eq!(square("polygons", "<p>0 1 2 3</p>"), fan);
    assert_eq!(square("trifans", "<p>0 1 2 3</p>"), fan);
    assert_eq!(square("tristrips", "<p>0 1 2 3</p>"), [[0, 1, 2], [2, 1, 3]]);
}

#[test]
fn unusable_files_are_rejected() {
    let mut nan = binary_stl(b"");
    nan[96..100].copy_from_slice(&f32::NAN.to_le_bytes());
    let mut short = binary_stl(b"");
    short.truncate(120);
    // Cut between two triangles, and with one too many: the length alone looks like that of a whole file.
    let mut cut = binary_stl(b"solid t");
    cut.truncate(84 + 2 * 50);
    let whole = ascii_stl();
    let cut_text = whole.as_bytes().get(..whole.len() / 2).unwrap();
    let padded = [binary_stl(b""), vec![7; 50]].concat();
    let mut bogus = binary_stl(b"");
    bogus[80..84].copy_from_slice(&4_000_000_000_u32.to_le_bytes());
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n".to_vec();
    let page = b"\n<!DOCTYPE html>\n<html><body>404</body></html>".to_vec();
    let own = "<node id='n'><instance_node url='#n'/></node>";
    for (name, bytes, what) in [
        ("a.stl", nan, "a vertex at NaN"),
        ("a.stl", short, "the file is truncated or not STL: its header declares 4 triangles (284 bytes), it has 120"),
        ("a.stl", cut, "its header declares 4 triangles (284 bytes), it has 184 bytes"),
        ("a.stl", padded, "the file is damaged: its header declares 4 triangles (284 bytes), it has 334 bytes"),
        ("a.stl", bogus, "declares 4000000000 triangles (200000000084 bytes)"),
        ("a.stl", b"shorter than a header".to_vec(), "truncated: 21 bytes"),
        ("a.stl", ascii_stl().replace("endsolid t", "").into_bytes(), "truncated: it has no `endsolid`"),
        ("a.stl", cut_text.to_vec(), "truncated: it has no `endsolid`"),
        ("a.stl", ascii_stl().replacen("vertex", "vertx", 1).into_bytes(), "line 8: a facet with 2 vertices, not 3"),
        ("a.stl", ascii_stl().replacen("endloop", "vertex 1 2 3", 1).into_bytes(), "line 8: a facet with 4 vertices"),
        ("a.stl", ascii_stl().replacen("endfacet", "", 1).into_bytes(), "line 9: a facet without `endfacet`"),
        ("a.stl", ascii_stl().replacen("vertex 0 0 0", "vertex 0 0", 1).into_bytes(), "line 4: a vertex takes three"),
        ("a.stl", ascii_stl().replacen("vertex 0 0 0", "vertex 0 0 x", 1).into_bytes(), "line 4: a vertex takes three"),
        ("a.stl", ascii_stl().replacen("vertex 0 0 0", "vertex 0 0 nan", 1).into_bytes(), "a vertex at 0 0 NaN"),
        ("a.stl", ascii_stl().replacen("solid t", "solidity", 1).into_bytes(), "truncated or not STL"),
        ("a.stl", pointer.clone(), "this is a Git LFS pointer"),
        ("a.dae", pointer, "run `git lfs pull`"),
        ("a.obj", page, "this is a web page"),
        ("a.obj", b"v 1 2 3\nv 1 2 4\nv 1 3 4\nf 0 1 2\n".to_vec(), "count from 1"),
        ("a.stl", Vec::new(), ""),
        ("a.ply", Vec::new(), "meshes of type `ply` cannot be read"),
        ("a.obj", b"v 1 2 3\nf 1 2 9\n".to_vec(), "a face refers to vertex 2 of 1"),
        ("a.obj", obj().replace("f 1 3 2", "f -1 -2 -5").into_bytes(), "a face refers to vertex -5 of 4"),
        ("a.obj", obj().replace("f 1 3 2", "f 1 3 /2").into_bytes(), "unusable line"),
        ("a.obj", obj().replacen("v 0 0 0", "v 0 0", 1).into_bytes(), "unusable line \"v 0 0\""),
        ("a.obj", obj().replacen("v 0 0 0", "v 0 0 0 0", 1).into_bytes(), "unusable line"),
        ("a.obj", obj().replacen("v 0 0 0", "v 0 0 inf", 1).into_bytes(), "a vertex at 0 0 inf"),
        ("a.obj", b"v 1 2 3\n".to_vec(), "no triangles"),
        ("a.dae", b"<COLLADA/>".to_vec(), "no triangles"),
        ("a.dae", dae("-1", "Z_UP", "").into_bytes(), "the unit of -1 metres"),
        ("a.dae", dae("1", "Z_UP", own).into_bytes(), "refer to each other"),
        ("a.dae", dae("1", "Z_UP", "<node><instance_geometry url='#q'/></node>").into_bytes(), "no element has the id"),
    ] {
        let error = read(name, &bytes, ONE).expect_err(name);
        assert!(error.contains(what), "{what}: {error}");
    }
}

#[test]
fn damaged_bytes_never_panic() {
    let plain = dae("1", "Z_UP", "<node id='n'><instance_geometry url='#g'/></node>");
    let files = [
        ("a.stl", binary_stl(b"")),
        ("a.stl", ascii_stl().into_bytes()),
        ("a.obj", obj().into_bytes()),
        ("a.dae", plain.into_bytes()),
    ];
    let mut random = crate::test_random(7);
    for (name, bytes) in files {
        for _ in 0..1500 {
            let mut bytes = bytes.clone();
            for _ in 0..1 + random() % 4 {
                let at = random() as usize % bytes.len();
                match random() % 3 {
                    0 => bytes[at] = random() as u8,
                    1 => bytes.truncate(at.max(1)),
                    _ => bytes[at] = b" -0919<>/\"ef\n"[random() as usize % 13],
                }
            }
            if let Ok(mesh) = read(name, &bytes, ONE) {
                assert!(mesh.triangles.iter().flatten().all(|i| (*i as usize) < mesh.vertices.len()));
                assert!(mesh.vertices.iter().all(|v| v.iter().all(|c| c.is_finite())));
            }
        }
    }
}
