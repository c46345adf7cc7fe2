//! Reads a file of settings and shows every mistake in it, each at its line: `every_mistake FILE`.

use dimos_yaml::{Diag, Located, Missing, Tree, read, render};
use serde::Deserialize;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Camera {
    name: String,
    rate: Located<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    cameras: Vec<Camera>,
}

fn main() -> Result<(), String> {
    let file = std::env::args().nth(1).ok_or("give a file")?;
    let text = std::fs::read_to_string(&file).map_err(|error| format!("{file}: {error}"))?;
    let mut tree = Tree::new();
    let source = tree.add_source(&file, text);
    let settings = tree.parse(source).and_then(|root| read::<Settings>(&mut tree, root, Missing::Report).0);
    for camera in settings.iter().flat_map(|settings| &settings.cameras) {
        if *camera.rate > 120.0 {
            let at = tree.label(camera.rate.at); // what serde cannot know is checked later, at the same place
            tree.report(Diag::error(format!("{} is too fast", camera.name)).at(at).hint("at most 120 Hz"));
        }
    }
    tree.diags().iter().for_each(|diag| eprintln!("{}", render(&tree, diag, false)));
    match settings.filter(|_| !tree.has_errors()) {
        Some(settings) => println!("{settings:?}"),
        None => return Err(format!("{} mistakes", tree.errors())),
    }
    Ok(())
}
