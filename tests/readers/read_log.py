"""Reads a log with three independent readers and compares every message with what dimos reads.

usage: read_log.py LOG EXPECTED, where EXPECTED has one JSON object per message: topic, log_time, data.
"""

import json
import math
import sys
from collections import defaultdict
from pathlib import Path

from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader


def plain(value):
    """A decoded message as JSON would have it: NaN is null."""
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, (list, tuple, bytes)):
        return [plain(v) for v in value]
    names = getattr(value, "__slots__", None) or vars(value)
    return {n: plain(getattr(value, n)) for n in names if not n.startswith("_")}


def check(reader, found, expected):
    """Same topics, same times, same contents, in the same order on each topic."""
    assert sorted(found) == sorted(expected), f"{reader}: topics {sorted(found)}, not {sorted(expected)}"
    for topic, messages in expected.items():
        assert len(found[topic]) == len(messages), f"{reader}: {topic}: {len(found[topic])}, not {len(messages)}"
        for i, (got, want) in enumerate(zip(found[topic], messages)):
            assert got == want, f"{reader}: {topic}[{i}]:\n  read {got}\n  want {want}"
    print(f"{reader}: {sum(len(m) for m in found.values())} messages on {len(found)} topics are the same")


def read_mcap(path):
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header, summary = reader.get_header(), reader.get_summary()
        assert header.profile == "ros2", header
        assert header.library.startswith("dimos/"), header
        attachments = {a.name: a.data for a in reader.iter_attachments()}
        assert attachments == {"blueprint.yaml": b"name: readers\n"}, attachments
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        assert metadata["dimos"]["run"] == "readers", metadata
        found = defaultdict(list)
        for _, channel, message, data in reader.iter_decoded_messages():
            assert message.publish_time == message.log_time
            found[channel.topic].append((message.log_time, plain(data)))
        assert summary.statistics.message_count == sum(map(len, found.values()))
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count > 0
    return found


def read_mcap_from_front_to_back(path):
    with open(path, "rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = defaultdict(list)
        for _, channel, message, data in reader.iter_decoded_messages():
            found[channel.topic].append((message.log_time, plain(data)))
    return found


def read_rosbags(path):
    found = defaultdict(list)
    with AnyReader([Path(path)]) as reader:
        for connection in reader.connections:
            qos = connection.ext.offered_qos_profiles
            assert len(qos) == 1 and qos[0].depth == 10, (connection.topic, qos)
            latched = connection.topic in ("/tf_static", "/robot_description")
            assert (qos[0].durability.value == 1) == latched, (connection.topic, qos)
        for connection, time, raw in reader.messages():
            data = plain(reader.deserialize(raw, connection.msgtype))
            found[connection.topic].append((time, without_type_name(data)))
    return found


def without_type_name(data):
    if isinstance(data, dict):
        return {k: without_type_name(v) for k, v in data.items() if k != "msgtype" and not k.startswith("__")}
    return data


def main():
    log, expected_path = sys.argv[1:]
    expected = defaultdict(list)
    for line in Path(expected_path).read_text().splitlines():
        entry = json.loads(line)
        expected[entry["topic"]].append((entry["log_time"], entry["data"]))
    check("mcap", read_mcap(log), expected)
    check("mcap, streaming", read_mcap_from_front_to_back(log), expected)
    check("rosbags", read_rosbags(log), expected)


main()
