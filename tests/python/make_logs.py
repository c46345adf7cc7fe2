"""Logs of other programs, by PyPI mcap: one function per kind. Usage: make_logs.py FOLDER JOINTS HOME (JSON lists).
Writes FOLDER/<kind>.mcap, or a folder <kind>, and prints the kinds."""

import json
import math
import os
import random
import struct
import sys
from pathlib import Path

from mcap.writer import CompressionType as C
from mcap.writer import IndexType, Writer

FOLDER, JOINTS, HOME = sys.argv[1], json.loads(sys.argv[2]), json.loads(sys.argv[3])
T = 1_800_000_000_000_000_000
MS = 1_000_000
STATES = "/joint_states"
SCHEMA = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def state(names, positions, time):
    out = bytearray()

    def align(n):
        while len(out) % n:
            out.append(0)

    def number(value):
        align(4)
        out.extend(struct.pack("<I", value))

    def text(value):
        number(len(value) + 1)
        out.extend(value.encode() + b"\0")

    out.extend(struct.pack("<iI", time // 10**9, time % 10**9))
    text("")
    number(len(names))
    for name in names:
        text(name)
    for values in (positions, (), ()):
        number(len(values))
        if values:
            align(8)
        for value in values:
            out.extend(struct.pack("<d", value))
    return b"\0\1\0\0" + bytes(out)


def pose(k):
    return [q + 0.1 * (j + 1) / 6 * math.sin(math.pi * k / 200) for j, q in enumerate(HOME)]


def motion(count=200, topic=STATES):
    return [(topic, T + k * 10 * MS, state(JOINTS, pose(k), T + k * 10 * MS)) for k in range(count)]


def write(name, messages, before=None, after=None, profile="ros2", publish=0, **options):
    path = os.path.join(FOLDER, name if name.endswith(".mcap") else name + ".mcap")
    options.setdefault("compression", C.ZSTD)
    options.setdefault("chunk_size", 4000)
    with open(path, "wb") as out:
        writer = Writer(out, **options)
        writer.start(profile=profile, library="make_logs")
        ids = {}
        if before:
            before(writer)
        for k, (topic, time, data) in enumerate(messages):
            if topic not in ids:
                schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", SCHEMA.encode())
                name, _, who = topic.partition("|")
                ids[topic] = writer.register_channel(name, "cdr", schema, {"who": who} if who else {})
            writer.add_message(ids[topic], time, data, time - publish, k)
        if after:
            after(writer)
        writer.finish()
    return path


def records(data):
    at = 8
    while at + 9 <= len(data) - 8:
        opcode, length = data[at], struct.unpack_from("<Q", data, at + 1)[0]
        yield at, opcode, length
        at += 9 + length


def changed(name, change, source="plain", **options):
    write(name, motion(), **options)
    path = os.path.join(FOLDER, name + ".mcap")
    data = bytearray(Path(path).read_bytes())
    data = change(data, [at for at, opcode, _ in records(data) if opcode == 6]) or data
    Path(path).write_bytes(data)


def plain():
    write("plain", motion())


def lz4():
    write("lz4", motion(), compression=C.LZ4)


def raw():
    write("raw", motion(), compression=C.NONE)


def no_chunks():
    write("no_chunks", motion(), use_chunking=False)


def indexes():
    kinds = [IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE, IndexType.ALL]
    for k, index in enumerate(kinds):
        for statistics in (True, False):
            for repeat in (True, False):
                options = {"index_types": index, "use_statistics": statistics, "repeat_channels": repeat}
                write(f"index_{k}{int(statistics)}{int(repeat)}", motion() + motion(50, "/other"), **options)


def out_of_order():
    parts = [motion()[k : k + 20] for k in range(0, 200, 20)]
    random.Random(3).shuffle(parts)
    write("out_of_order", [message for part in parts for message in part])


def out_of_order_no_chunks():
    messages = motion()
    random.Random(4).shuffle(messages)
    write("out_of_order_no_chunks", messages, use_chunking=False)


def other_order():
    def at(k):
        order = list(range(6)) if k < 100 else [5, 0, 2, 1, 4, 3]
        q = pose(k)
        return state([JOINTS[j] for j in order], [q[j] for j in order], T + k * 10 * MS)

    write("other_order", [(STATES, T + k * 10 * MS, at(k)) for k in range(200)])


def other_joints():
    wheels = [(STATES, T + k * 10 * MS + 1, state(["wheel0", "wheel1"], [9.0, 8.0], T)) for k in range(200)]
    write("other_joints", sorted(motion() + wheels, key=lambda m: m[1]))


def growing():
    def at(k):
        n = 3 if k < 5 else 6
        return state(JOINTS[:n], pose(k)[:n], T + k * 10 * MS)

    write("growing", [(STATES, T + k * 10 * MS, at(k)) for k in range(200)])


def in_parts():
    def at(k):
        part = slice(0, 3) if k % 2 else slice(3, 6)
        return state(JOINTS[part], pose(k)[part], T + k * 10 * MS)

    write("in_parts", [(STATES, T + k * 10 * MS, at(k)) for k in range(200)])


def two_publishers():
    other = [(STATES + "|b", T + k * 10 * MS + MS, state(JOINTS, [0.0] * 6, T + k * 10 * MS + MS)) for k in range(200)]
    write("two_publishers", sorted(motion() + other, key=lambda m: m[1]))


def slow_publishers():
    """Two publishers at 10 Hz in one channel, as rosbag2 records them: no step is fast."""

    def at(k):
        q = pose(k) if k % 2 else [q + 0.3 for q in pose(k)]
        return state(JOINTS, q, T + k * 50 * MS)

    write("slow_publishers", [(STATES, T + k * 50 * MS, at(k)) for k in range(200)])


def uneven_publishers():
    """One publisher at 20 Hz and one at 10 Hz in one channel."""

    def at(k):
        q = [q + 0.3 for q in pose(k)] if k % 3 == 2 else pose(k)
        return state(JOINTS, q, T + k * 33 * MS)

    write("uneven_publishers", [(STATES, T + k * 33 * MS, at(k)) for k in range(200)])


def two_channels():
    """Two publishers whose positions are nearly the same."""
    own = [(STATES, T + k * 100 * MS, state(JOINTS, pose(k), T + k * 100 * MS)) for k in range(200)]
    near = []
    for k, (_, time, _) in enumerate(own):
        near.append((STATES + "|b", time + 50 * MS, state(JOINTS, [q + 0.01 for q in pose(k)], time)))
    write("two_channels", sorted(own + near, key=lambda m: m[1]))


def restarted():
    """A driver that was restarted has another channel from then on."""
    messages = motion()
    write("restarted", messages[:100] + [(STATES + "|b", time, data) for _, time, data in messages[100:]])


def joint_twice():
    messages = motion()
    for k in (70, 71):
        names, positions = [*JOINTS, JOINTS[2]], [*pose(k), 0.0]
        messages[k] = (STATES, messages[k][1], state(names, positions, messages[k][1]))
    write("joint_twice", messages)


def disordered_chunks():
    messages = motion()
    for k in range(0, 200, 20):
        part = messages[k : k + 20]
        random.Random(k).shuffle(part)
        messages[k : k + 20] = part
    write("disordered_chunks", messages)


def wrong_map():
    """The index of chunks names another channel than the chunks and their message indexes have."""
    own, other = motion(), motion(topic="/other")
    third = [("/third", time + 2_000 * MS, data) for _, time, data in motion(20)]
    path = write("wrong_map", [message for pair in zip(own, other) for message in pair] + third)
    data = bytearray(Path(path).read_bytes())
    for at, opcode, _ in list(records(data)):
        if opcode == 8:
            length = struct.unpack_from("<I", data, at + 9 + 32)[0]
            for entry in range(at + 9 + 36, at + 9 + 36 + length, 10):
                if struct.unpack_from("<H", data, entry)[0] == 1:
                    struct.pack_into("<H", data, entry, 3)
    # The summary has no checksum.
    struct.pack_into("<I", data, len(data) - 12, 0)
    Path(path).write_bytes(data)


def no_profile():
    write("no_profile", motion(), profile="")


def late():
    """The first message of the states is two hours after the log began."""
    hours = 7_200_000 * MS
    later = [(topic, time + hours, data) for topic, time, data in motion(20)]
    write("late", [("/other", T, motion(1)[0][2]), *later])


def equal_attachments():
    def before(writer):
        for _ in range(2):
            writer.add_attachment(1, 2, "same.txt", "text/plain", b"the same")
            writer.add_metadata("same", {"a": "b"})

    write("equal_attachments", motion(), before)


def partly():
    """The length of the tenth message of a chunk is wrong."""

    def change(data, chunks):
        inside = chunks[3] + 9 + 40
        at = inside
        for _ in range(10):
            at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
        data[at + 3] ^= 0x7F

    changed("partly", change, compression=C.NONE)


def swallowed():
    """A message of a chunk has become another kind of record."""

    def change(data, chunks):
        data[chunks[3] + 9 + 40] = 0x80

    changed("swallowed", change, compression=C.NONE)


def hidden():
    """A chunk has become a kind of record of another program."""

    def change(data, chunks):
        data[chunks[3]] = 0x86

    changed("hidden", change)


def whole_turn():
    def at(k):
        q = [HOME[0] + 3.0 + 0.002 * k, *HOME[1:]]
        q[0] -= 2 * math.pi if q[0] > math.pi else 0.0
        return state(JOINTS, q, T + k * 10 * MS)

    write("whole_turn", [(STATES, T + k * 10 * MS, at(k)) for k in range(200)])


def gap():
    def at(k):
        return T + k * 10 * MS + (5_000 * MS if k > 100 else 0)

    def q(k):
        return [q + (0.3 if k > 100 else 0.0) for q in HOME]

    write("gap", [(STATES, at(k), state(JOINTS, q(k), at(k))) for k in range(200)])


def elsewhere():
    write("elsewhere", motion(topic="/robot/joint_states"))


def bad_message():
    messages = motion()
    messages[70] = (STATES, messages[70][1], b"\0\1\0\0\7")
    write("bad_message", messages)


def chunk_crc():
    def change(data, chunks):
        data[chunks[3] + 9 + 24] ^= 1

    changed("chunk_crc", change)


def first_crc():
    def change(data, chunks):
        data[chunks[0] + 9 + 24] ^= 1

    changed("first_crc", change)


def flipped():
    def change(data, chunks):
        data[chunks[3] + 1500] ^= 0x10

    changed("flipped", change, compression=C.NONE)


def broken():
    def change(data, chunks):
        at = chunks[3] + 9 + 40
        data[at : at + 40] = bytes(40)

    changed("broken", change)


def first_broken():
    def change(data, chunks):
        at = chunks[0] + 9 + 40
        data[at : at + 40] = bytes(40)

    changed("first_broken", change)


def length():
    def change(data, chunks):
        data[chunks[3] + 2] ^= 0x7F

    changed("length", change)


def cut():
    def change(data, chunks):
        return data[: chunks[6] + 50]

    changed("cut", change)


def times():
    write("times", motion(), profile="ros1", publish=5 * MS)


def attached():
    def before(writer):
        writer.add_attachment(1, 2, "big.bin", "application/octet-stream", bytes(17 << 20))
        writer.add_attachment(1, 2, "small.txt", "text/plain", b"small")

    def after(writer):
        writer.add_attachment(1, 2, "late.txt", "text/plain", b"late")
        writer.add_metadata("late", {"a": "b"})
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", SCHEMA.encode())
        writer.register_channel("/silent", "cdr", schema)

    write("attached", motion(), before, after)


def bad_attachment():
    path = write(
        "bad_attachment", motion(), lambda writer: writer.add_attachment(1, 2, "a.txt", "text/plain", b"intact")
    )
    data = Path(path).read_bytes().replace(b"intact", b"infact")
    Path(path).write_bytes(data)


def giant():
    blob = b"\0\1\0\0" + state(["x" * (17 << 20)], [0.0], T)[4:]
    write("giant", [("/blob", T, blob), *motion()], chunk_size=1 << 30)


def bag(name, missing=False, third=None):
    os.makedirs(os.path.join(FOLDER, name), exist_ok=True)
    names = [f"{name}_0.mcap", f"{name}_1.mcap"] + ([f"{name}_2.mcap"] if missing or third is not None else [])
    if third is not None:
        Path(FOLDER, name, f"{name}_2.mcap").write_bytes(third)
    with open(os.path.join(FOLDER, name, "metadata.yaml"), "w") as out:
        listed = "".join(f"    - {n}\n" for n in names)
        out.write(
            f"rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  relative_file_paths:\n{listed}"
        )
    for k in range(2):
        own = motion()[100 * k : 100 * k + 100]
        other = motion(topic="/other")[100 * k : 100 * k + 100]
        # The ids of the channels are swapped in the second file.
        pairs = zip(own, other) if k == 0 else zip(other, own)
        write(f"{name}/{name}_{k}", [message for pair in pairs for message in pair])


def split():
    bag("split")


def split_missing():
    bag("split_missing", missing=True)


def split_empty():
    bag("split_empty", third=b"")


def split_no_log():
    bag("split_no_log", third=b"this is no log")


def unrelated():
    os.makedirs(os.path.join(FOLDER, "unrelated"), exist_ok=True)
    for run in ("a", "b"):
        about = {"run": run, "wall_offset_ns": "1"}
        write(f"unrelated/{run}", motion(), lambda writer, about=about: writer.add_metadata("dimos", about))


if __name__ == "__main__":
    made = [
        plain, lz4, raw, no_chunks, indexes, out_of_order, out_of_order_no_chunks, other_order, other_joints, growing,
        in_parts, two_publishers, whole_turn, gap, elsewhere, bad_message, chunk_crc, first_crc, flipped, broken,
        first_broken, length, cut, times, attached, bad_attachment, giant, split, split_missing, unrelated,
        slow_publishers, uneven_publishers, two_channels, restarted, joint_twice, disordered_chunks, wrong_map,
        no_profile, late, equal_attachments, partly, swallowed, hidden, split_empty, split_no_log,
    ]  # fmt: skip
    for make in made:
        make()
    print(json.dumps(sorted(os.listdir(FOLDER))))
