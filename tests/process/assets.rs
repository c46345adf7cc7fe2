//! Files that blueprints fetch, with the real binary: listed, fetched on first use, checked, used, removed.

use std::io::Write;
use std::process::{Command, Output};

use serde_json::Value;

use crate::support::file_server::{FileServer, Misdeed};
use crate::support::program;
use crate::support::program::Home;

/// An archive with the description of the arm of the planner blueprint in it.
fn archive(home: &Home) -> Vec<u8> {
    let urdf = home.dimos("model expand builtin:yourarm").with(0).out;
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    zip.start_file("yourarm_description/urdf/arm.urdf", zip::write::SimpleFileOptions::default()).unwrap();
    zip.write_all(urdf.as_bytes()).unwrap();
    zip.finish().unwrap().into_inner()
}

fn sha256(home: &Home, bytes: &[u8]) -> String {
    std::fs::write(home.path().join("summed"), bytes).unwrap();
    let Output { stdout, .. } = Command::new("sha256sum").arg(home.path().join("summed")).output().unwrap();
    String::from_utf8(stdout).unwrap()[..64].to_owned()
}

fn blueprint(url: &str, sha256: &str) -> String {
    format!(
        "name: cell
include: [yourarm-planner]
assets:
  yourarm: {{url: \"{url}\", sha256: {sha256}}}
  other: {{url: \"https://nowhere.invalid/other.zip\", sha256: {sha256}}}
planner:
  robots:
    - {{name: arm, model_path: asset:yourarm/yourarm_description/urdf/arm.urdf, package_paths: {{d: asset:yourarm}}}}
"
    )
}

#[test]
fn a_run_fetches_what_it_uses_and_check_does_not() {
    let home = Home::new();
    let file = archive(&home);
    let server = FileServer::new(file.clone(), &[Misdeed::Cut(file.len() / 2)]);
    home.write("cell.yaml", &blueprint(&server.url("yourarm.zip"), &sha256(&home, &file)));

    let checked = home.dimos("check cell.yaml").with(0);
    assert!(checked.err.contains("yourarm is not downloaded yet: its contents were not checked"), "{}", checked.err);
    assert!(server.ranges().is_empty());
    let list = home.dimos("model assets list cell.yaml --json").with(0).json();
    let row = |list: &Value, name: &str| list.as_array().unwrap().iter().find(|a| a["name"] == name).unwrap().clone();
    assert_eq!((&row(&list, "yourarm")["state"], &row(&list, "other")["used"]), (&"not here".into(), &false.into()));

    let run = home.start("run cell.yaml --no-record");
    run.until(program::UP);
    assert!(run.err().contains("fetching yourarm from http://127.0.0.1"), "{}", run.err());
    assert_eq!(server.ranges(), [String::new(), format!("bytes={}-", file.len() / 2)]);
    home.dimos("plan arm 0.3 -0.2 0.5 0 0.4 0").with(0);
    run.end(rustix::process::Signal::TERM).with(143);

    // The next run has it.
    drop(server);
    home.run("cell.yaml --no-record").end(rustix::process::Signal::TERM).with(143);
    let list = home.dimos("model assets list cell.yaml").with(0).out;
    assert!(list.contains("here") && list.contains("cache/dimos/assets/"), "{list}");
    assert_eq!(home.dimos("model assets clean cell.yaml").with(0).out, "removed yourarm\n");
    assert_eq!(home.dimos("model assets clean cell.yaml").with(0).out, "nothing to remove\n");
    let offline = home.dimos("run cell.yaml --no-record").with(1);
    assert!(offline.err.contains("error: cell.yaml:4:3: the asset `yourarm`: http://127.0.0.1"), "{}", offline.err);
    assert!(offline.err.contains("connection refused\nhint: nothing listens at this address"), "{}", offline.err);
}

#[test]
fn assets_are_fetched_beforehand_and_then_their_files_are_checked() {
    let home = Home::new();
    let file = archive(&home);
    std::fs::write(home.path().join("a.zip"), &file).unwrap();
    let url = format!("file://{}", home.path().join("a.zip").display());
    let sum = sha256(&home, &file);
    let text = blueprint(&url, &sum).replace("https://nowhere.invalid/other.zip", &url);
    home.write("cell.yaml", &text);
    assert!(home.dimos("model assets fetch cell.yaml").with(0).out.contains("here"));
    assert!(!home.dimos("check cell.yaml").with(0).err.contains("not fetched"));

    home.write("wrong.yaml", &text.replace("urdf/arm.urdf", "urdf/arms.urdf"));
    home.dimos("check wrong.yaml").with(2).says(&["wrong.yaml:8:", "arms.urdf"]);
    home.write("joint.yaml", &text.replace("name: arm,", "name: arm, end_effector_link: flansch,"));
    home.dimos("check joint.yaml").with(2).says(&["the model has no link `flansch`", "its links: base_link"]);

    let other = sum.replace(|c: char| c.is_ascii_digit(), "a");
    home.write("sum.yaml", &text.replace(&sum, &other));
    let refused = home.dimos("run sum.yaml --no-record").with(1);
    assert!(refused.err.contains(&sum) && refused.err.contains(&other), "{}", refused.err);
}

#[test]
fn mistakes_of_assets_are_found_at_their_places() {
    let home = Home::new();
    let sum = "0".repeat(64);
    let cell = |assets: &str, path: &str| {
        format!(
            "include: [yourarm-planner]\nassets: {assets}\nplanner: {{robots: [{{name: arm, model_path: \"{path}\"}}]}}\n"
        )
    };
    let good = format!("{{yourarm: {{url: \"https://x.invalid/a.zip\", sha256: \"{sum}\"}}}}");
    home.write("good.yaml", &cell(&good, "asset:yourarm/a.urdf"));
    home.dimos("check good.yaml").with(0);
    for (assets, path, place, says) in [
        (&*good, "asset:yuorarm/a.urdf", "a.yaml:3:", "did you mean `yourarm`?"),
        ("{}", "asset:yourarm/a.urdf", "a.yaml:3:", "there is no asset `yourarm`"),
        (&good, "asset:yourarm/../a.urdf", "a.yaml:3:", "points outside its asset"),
        (&good.replace("https", "ftp"), "asset:yourarm/a.urdf", "a.yaml:2:", "is not the URL of a file"),
        (&good.replace("https://x.invalid", "file://x"), "asset:yourarm/a.urdf", "a.yaml:2:", "has no absolute path"),
        (&good.replace("x.invalid", ""), "asset:yourarm/a.urdf", "a.yaml:2:", "names no server"),
        (&good.replace(&sum, "0123"), "asset:yourarm/a.urdf", "a.yaml:2:", "64 hexadecimal digits"),
    ] {
        home.write("a.yaml", &cell(assets, path));
        home.dimos("check a.yaml").with(2).says(&[place, says]);
    }
}
