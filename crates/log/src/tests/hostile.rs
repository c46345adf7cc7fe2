//! Truncated, damaged and malicious files.

use super::*;

#[test]
fn every_prefix_of_a_log_is_read_up_to_the_cut() {
    let (folder, path) = folder();
    let notices = Notices::default();
    let (recorder, mut ring, _notes) = start(&path, &notices);
    for n in 0..60 {
        tick(n).into_iter().for_each(|s| ring.push(s).unwrap());
        // Several flushes, for several chunks to cut.
        std::thread::sleep(std::time::Duration::from_millis(8));
    }
    recorder.finish().unwrap();
    let (whole, end) = read(&path).unwrap();
    assert!(end.is_none());
    let bytes = std::fs::read(&path).unwrap();
    let cut = folder.path().join("cut.mcap");
    let mut longest = 0;
    for length in (0..bytes.len()).step_by(61).chain(bytes.len() - 40..bytes.len()) {
        std::fs::write(&cut, &bytes[..length]).unwrap();
        match read(&cut) {
            Ok((entries, Some(ReplayError::Cut { at, .. }))) => {
                assert!(at <= length as u64);
                let of = |entries: &[Entry]| entries.iter().map(|e| (e.topic.clone(), e.log_time)).collect::<Vec<_>>();
                assert_eq!(of(&entries), of(&whole[..entries.len()]), "cut at {length}");
                assert!(entries.len() >= longest, "a longer prefix has fewer messages");
                longest = entries.len();
            }
            Err(ReplayError::NotMcap { .. }) => assert!(length < 8),
            other => panic!("cut at {length}: {:?}", other.map(|(e, end)| (e.len(), end))),
        }
    }
    assert_eq!(longest, whole.len());
}

/// A live log ends at its newest chunk, wherever its writer is; only without a writer it is cut.
#[test]
fn a_live_log_is_not_cut() {
    let (folder, path) = folder();
    record(&path, (0..60).flat_map(tick));
    let bytes = std::fs::read(&path).unwrap();
    let part = folder.path().join("part.mcap");
    for length in [bytes.len() / 3, bytes.len() - 100, bytes.len() - 3] {
        std::fs::write(&part, &bytes[..length]).unwrap();
        let writer = std::fs::File::options().append(true).open(&part).unwrap();
        files::mark_as_being_written(&writer);
        let (live, end) = read(&part).unwrap();
        assert!(end.is_none(), "{length} of {} bytes: {end:?}", bytes.len());
        assert!(LogReader::open(&part).unwrap().info().live);
        drop(writer);
        let (ended, end) = read(&part).unwrap();
        assert!(matches!(end, Some(ReplayError::Cut { .. })), "{end:?}");
        assert_eq!(ended.len(), live.len());
        assert!(!LogReader::open(&part).unwrap().info().live);
    }
    // A damaged log is cut, also while it is being written.
    std::fs::write(&part, [&bytes[..bytes.len() - 100], &[0; 100]].concat()).unwrap();
    let writer = std::fs::File::options().append(true).open(&part).unwrap();
    files::mark_as_being_written(&writer);
    let (_, end) = read(&part).unwrap();
    assert!(matches!(end, Some(ReplayError::Cut { .. })), "{end:?}");
}

#[test]
fn hostile_bytes_are_an_error_and_no_panic() {
    let (folder, path) = folder();
    record(&path, (0..20).flat_map(tick));
    let good = std::fs::read(&path).unwrap();
    let bad = folder.path().join("bad.mcap");
    // A small own generator: the same bytes on every machine.
    let mut seed = 0x2545_f491_4f6c_dd1d_u64;
    let mut random = move || {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        seed
    };
    for _ in 0..400 {
        let mut bytes = good.clone();
        for _ in 0..1 + random() % 8 {
            let at = random() as usize % bytes.len();
            bytes[at] = [random() as u8, 0, 0xff, 0x7f][random() as usize % 4];
        }
        std::fs::write(&bad, &bytes).unwrap();
        if let Ok((entries, _)) = read(&bad) {
            assert!(entries.len() < 10_000);
        }
    }
}

#[test]
fn lengths_beyond_the_bounds_are_rejected_unread() {
    use mcap::records::op;
    let (folder, _) = folder();
    let path = folder.path().join("huge.mcap");
    let record = |opcode: u8, length: u64, body: &[u8]| [&[opcode], &length.to_le_bytes()[..], body].concat();
    let chunk = |unpacked: u64, compression: &str, data: &[u8]| {
        let mut body = [0u64.to_le_bytes(), 1u64.to_le_bytes(), unpacked.to_le_bytes()].concat();
        body.extend([0; 4]);
        body.extend((compression.len() as u32).to_le_bytes());
        body.extend(compression.as_bytes());
        body.extend((data.len() as u64).to_le_bytes());
        body.extend(data);
        record(op::CHUNK, body.len() as u64, &body)
    };
    let inner = record(op::MESSAGE, u64::MAX, &[1; 30]);
    let cases = [
        record(op::HEADER, u64::MAX, &[]),
        record(op::MESSAGE, 64 << 20, &vec![0; 64 << 20]),
        chunk(1 << 40, "zstd", &[0x28, 0xb5, 0x2f, 0xfd, 0, 0]),
        chunk(1 << 20, "zstd", b"not compressed"),
        chunk(inner.len() as u64, "", &inner),
        chunk(10, "lz4", &[0; 10]),
    ];
    for (i, case) in cases.iter().enumerate() {
        std::fs::write(&path, [mcap::MAGIC, case].concat()).unwrap();
        let (entries, end) = read(&path).unwrap();
        assert!(
            entries.is_empty() && matches!(end, Some(ReplayError::Cut { .. } | ReplayError::Damaged { .. })),
            "case {i}: {end:?}"
        );
    }
}
