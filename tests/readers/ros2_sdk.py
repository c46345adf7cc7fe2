"""zenoh-ros2-sdk as a node of ROS 2: what it sees of a run. `ros2_sdk.py PORT ARM TASK` prints one JSON object.

The SDK fetches definitions of messages by git; here it has those of rosbags, in a folder.
"""

import json
import os
import sys
import tempfile
import time
from typing import Any

from rosbags.typesys import Stores, get_typestore

os.environ["ZENOH_ROS2_SDK_CACHE"] = tempfile.mkdtemp()

from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.discovery import (
    get_service_names_and_types,
    get_topic_info,
    get_topic_names_and_types,
)
from zenoh_ros2_sdk.message_registry import get_registry
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.session import ZenohSession

PORT = int(sys.argv[1])
ROUTER = {"router_ip": "127.0.0.1", "router_port": PORT}
LATCHED = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)


def write_definitions():
    """Definitions of all messages of Jazzy, where the SDK looks first."""
    from pathlib import Path

    store, folder = get_typestore(Stores.ROS2_JAZZY), Path(tempfile.mkdtemp())
    for name in store.fielddefs:
        package, _, kind = name.split("/")
        text, _ = store.generate_msgdef(name, ros_version=2)
        path = folder / package / "msg" / f"{kind}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.split("=" * 80)[0])
    get_registry().messages_dir = folder


def listen(topic, kind, seconds, qos=None):
    """The messages of a topic."""
    seen: list[Any] = []
    subscriber = ROS2Subscriber(topic, kind, seen.append, qos=qos, **ROUTER)
    time.sleep(seconds)
    subscriber.close()
    return seen


def main():
    ZenohSession.get_instance(**ROUTER)
    write_definitions()
    seen: dict[str, Any] = {"topics": dict(get_topic_names_and_types(**ROUTER, timeout=2.0))}
    info = get_topic_info("/robot_description", **ROUTER, timeout=2.0, verbose=True)
    seen["services"] = dict(get_service_names_and_types(**ROUTER, timeout=2.0))
    seen["publisher"] = [info.publishers[0].node_name, info.publishers[0].qos] if info.publishers else []

    began = time.time()
    states = listen("/joint_states", "sensor_msgs/msg/JointState", 1.5)
    stamp = states[-1].header.stamp
    seen["joint_states"] = {
        "count": len(states),
        "name": list(states[-1].name),
        "position": list(states[-1].position),
        "age": time.time() - (stamp.sec + stamp.nanosec * 1e-9),
        "took": time.time() - began,
    }
    # It was published before this subscriber came.
    described = listen("/robot_description", "std_msgs/msg/String", 0.3, LATCHED)
    seen["robot_description"] = [message.data[:200] for message in described]
    fixed = listen("/tf_static", "tf2_msgs/msg/TFMessage", 0.3, LATCHED)
    moving = listen("/tf", "tf2_msgs/msg/TFMessage", 1.0)
    tree = {t.child_frame_id: t.header.frame_id for t in [*fixed[-1].transforms, *moving[-1].transforms]}
    seen["frames"] = {"tree": tree, "rate": len(moving)}
    rows = listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", 2.0)[-1].status
    seen["diagnostics"] = [
        [row.name, row.level if isinstance(row.level, int) else row.level[0], row.message] for row in rows
    ]
    print(json.dumps(seen), flush=True)


if __name__ == "__main__":
    main()
