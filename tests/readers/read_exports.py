"""Reads what `dimos log export` wrote with other people's libraries, and compares it with the CSV of the same log.

usage: read_exports.py LOG FOLDER, where FOLDER has table.csv, table.parquet, bag/ and set/frames.json
(the calls of LeRobot, at the tick rate).
"""

import csv
import json
import math
import sys
from pathlib import Path

import polars
import pyarrow.parquet as pq
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

log, folder = map(Path, sys.argv[1:])


def same(a, b):
    return a == b or (math.isnan(a) and math.isnan(b))


# The table: the same columns and the same numbers, bit for bit, for two readers.
with (folder / "table.csv").open() as file:
    rows = list(csv.DictReader(file))
table = pq.read_table(folder / "table.parquet")
assert table.num_rows == len(rows) > 100, (table.num_rows, len(rows))
names = [name for name in rows[0] if name != "time"]
assert table.column_names == ["time", "log_time", *names], table.column_names
lazy = polars.read_parquet(folder / "table.parquet")
for name in names:
    wanted = [float(row[name]) if row[name] else math.nan for row in rows]
    for reader, column in (("pyarrow", table[name].to_pylist()), ("polars", lazy[name].to_list())):
        assert all(map(same, column, wanted)), f"{reader}: {name}"
assert lazy["log_time"].is_sorted() and lazy["log_time"].dtype == polars.Int64
assert all(abs(t - float(row["time"])) < 1e-9 for t, row in zip(table["time"].to_pylist(), rows))
print(f"table: {table.num_rows} rows, {table.num_columns} columns are the same")

# The bag: every message of the log.
with log.open("rb") as recorded:
    summary = make_reader(recorded).get_summary()
counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
with Reader(folder / "bag") as bag:
    found = {topic: info.msgcount for topic, info in bag.topics.items()}
    assert found == {topic: counts.get(topic, 0) for topic in found} and sum(found.values()) == sum(counts.values())
    assert bag.duration == summary.statistics.message_end_time - summary.statistics.message_start_time + 1
with AnyReader([folder / "bag"]) as bag:
    read = sum(1 for c, _, raw in bag.messages() if bag.deserialize(raw, c.msgtype) is not None)
assert read == sum(counts.values()), (read, counts)
print(f"bag: {read} messages are the same")

# What LeRobot was given.
settings, frames = json.loads((folder / "set/frames.json").read_text())
count, fps, feature = len(frames), settings["fps"], settings["features"]["observation.state"]
assert settings["robot_type"] == "arm" and not settings["use_videos"], settings
assert feature == settings["features"]["action"] and feature["shape"] == [len(feature["names"])], feature
assert all(len(row[key]) == feature["shape"][0] for key in ("observation.state", "action") for row in frames)
assert {row["task"] for row in frames} == {"wave"}
# States are those of the table, frame by frame, and actions its commands, where there are some.
known = [row for row in rows if all(row[name] for name in names if name.endswith(".position"))]
for i, joint in enumerate(name.removesuffix(".pos") for name in feature["names"]):
    if f"{joint}.position" not in rows[0]:
        continue
    states = [row["observation.state"][i] for row in frames]
    actions = [row["action"][i] for row in frames]
    assert abs(len(known) - count) <= max(2, count // 50), (len(known), count)
    near = sum(abs(s - float(row[f"{joint}.position"])) < 1e-6 for s, row in zip(states, known))
    assert near >= 0.9 * count or count != len(known), f"{joint}: {near} of {count}"
    commands = [float(row[f"{joint}.command"]) for row in known if row[f"{joint}.command"]]
    assert abs(max(actions) - max(commands + actions)) < 1e-6, joint
print(f"LeRobot: {count} frames at {fps} Hz are the same")
