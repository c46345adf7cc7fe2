"""What 3D tools find in a log: reads the transforms, the description and the joint states with PyPI mcap and rosbags.

usage: read_scene.py LOG FRAME URDF

Writes the latched description to URDF. Prints JSON: the pose of FRAME in `map` by the latest transforms, the joint
states of the same moment, the frames, and the number of messages on each topic.
"""

import json
import sys
from collections import Counter
from pathlib import Path

import numpy
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

LATCHED = ("/robot_description", "/tf_static")


def matrix(transform):
    """A transform as a 4 × 4 matrix."""
    t, q = transform.translation, transform.rotation
    x, y, z, w = q.x, q.y, q.z, q.w
    return numpy.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), t.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), t.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), t.z],
            [0, 0, 0, 1],
        ]
    )


def placed(frames, name):
    """The pose of a frame in `map`: up its parents, as tf2 does."""
    if name == "map":
        return numpy.eye(4)
    parent, pose = frames[name]
    return placed(frames, parent) @ pose


def main():
    log, frame, urdf = sys.argv[1:]
    frames, states, found = {}, {}, None
    counts: Counter[str] = Counter()
    with open(log, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        attached = {a.name: a.data for a in reader.iter_attachments()}
        for _, channel, _, data in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            if channel.topic == "/robot_description":
                assert data.data.encode() == attached["robot_description.urdf"]
                Path(urdf).write_text(data.data)
            elif channel.topic == "/joint_states":
                states = dict(zip(data.name, data.position))
            elif channel.topic in ("/tf", "/tf_static"):
                for t in data.transforms:
                    frames[t.child_frame_id] = (t.header.frame_id, matrix(t.transform))
                if channel.topic == "/tf":
                    found = (placed(frames, frame), states)
    with AnyReader([Path(log)]) as reader:
        for connection in reader.connections:
            durability = connection.ext.offered_qos_profiles[0].durability.value
            assert (durability == 1) == (connection.topic in LATCHED), (connection.topic, durability)
        counted = Counter(
            connection.topic
            for connection, _, raw in reader.messages()
            if reader.deserialize(raw, connection.msgtype) is not None
        )
        assert counted == counts, (counted, counts)
    assert found, "no /tf"
    pose, states = found
    print(json.dumps({"pose": pose.tolist(), "joints": states, "frames": sorted(frames), "counts": counts}))


main()
