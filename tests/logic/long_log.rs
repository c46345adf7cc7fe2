//! A log of any length: the memory that its writer takes, and its index, judged by the mcap library for Python.

use std::collections::BTreeMap;
use std::fs::File;
use std::process::Command;

use dimos::clock::Mono;
use dimos::recording::log_writer::LogWriter;
use dimos::recording::messages::Text;

use crate::support::python::python_with;

/// Ten a second: an hour.
const CHUNKS: u64 = 36_000;

const READ: &str = "
import sys
from mcap.reader import make_reader
with open(sys.argv[1], 'rb') as file:
    reader = make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    part = [m.log_time for _, c, m in reader.iter_messages(topics=['/b'], start_time=30_000, end_time=30_010)]
    print(summary.statistics.message_count, len(summary.chunk_indexes), len(list(reader.iter_attachments())), part)
";

/// Memory of this process [bytes].
fn resident() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap();
    4096 * statm.split(' ').nth(1).unwrap().parse::<u64>().unwrap()
}

#[test]
fn a_log_of_an_hour_takes_no_more_memory_than_one_of_ten_minutes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.mcap");
    let mut log = LogWriter::create(File::create(&path).unwrap(), 0, &[], BTreeMap::new()).unwrap();
    log.keep_indexes_in(folder.path());
    let mut after_ten_minutes = 0;
    for time in 0..CHUNKS {
        for topic in ["/a", "/b", "/c", "/d", "/e", "/f", "/g", "/h", "/i", "/j"] {
            log.publish(topic, time, &Text { data: time.to_string() }).unwrap();
        }
        log.flush_soon();
        log.flush_if_due(Mono(time)).unwrap();
        if time == 6_000 {
            after_ten_minutes = resident();
        }
    }
    let grown = resident().saturating_sub(after_ten_minutes);
    assert!(grown < 1 << 20, "{grown} bytes more");
    log.finish().unwrap();
    // No file is left beside it.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);

    let Some(python) = python_with(&["mcap"]) else { return };
    let read = Command::new(python).args(["-c", READ]).arg(&path).output().unwrap();
    let said = String::from_utf8_lossy(&read.stdout);
    let times: Vec<u64> = (30_000..30_010).collect();
    assert_eq!(
        said.trim(),
        format!("{} {CHUNKS} 0 {times:?}", 10 * CHUNKS),
        "{}",
        String::from_utf8_lossy(&read.stderr)
    );
}
