"""A client of ROS 2 over rmw_zenoh that uses none of our code: eclipse-zenoh, and rosbags for types and bytes.

Reads one command per line from stdin, as JSON, and answers each with one line. The first line has port, domain, distro
and namespace.
"""

import dataclasses
import json
import math
import random
import struct
import sys
import threading
import time
import uuid
from pathlib import Path

import numpy
import zenoh

sys.path.insert(0, str(Path(__file__).parent.parent / "python"))
import ros_types

ACTION = ros_types.ACTION
LIFECYCLE = {0: "UNKNOWN", 1: "ACCEPTED", 2: "EXECUTING", 3: "CANCELING", 4: "SUCCEEDED", 5: "CANCELED", 6: "ABORTED"}


def main():
    client = Client(**json.loads(sys.stdin.readline()))
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        command = json.loads(line)
        print(json.dumps(getattr(client, command.pop("do"))(**command)), flush=True)
    client.session.close()


class Client:
    def __init__(self, port, domain=0, distro="jazzy", namespace=""):
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
            "scouting/multicast/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.domain, self.namespace = domain, namespace
        self.store = ros_types.store_of(distro)
        self.gid, self.sequence = uuid.uuid4().bytes, 0
        self.goals, self.statuses, self.watched = {}, [], {}

    def key(self, name, kind):
        """The key of a topic or service."""
        package, kind_name = kind.rsplit("/", 1)
        wire = f"{package.replace('/', '::')}::dds_::{kind_name}_/{self.store.hash_rihs01(kind)}"
        return f"{self.domain}/{self.whole(name)}/{wire}"

    def whole(self, name):
        return f"{self.namespace}/{name}" if self.namespace else name

    def make(self, kind, **fields):
        """A message with every field: what is not given is empty."""
        values = {}
        for name, description in self.store.fielddefs[kind][1]:
            values[name] = fields.get(name, self.empty(description))
        return self.message_class(kind)(**values)

    def message_class(self, kind):
        """The class of a message; those that ros_types composes have none yet."""
        if kind not in self.store.types:
            names = [name for name, _ in self.store.fielddefs[kind][1]]
            made = dataclasses.make_dataclass(kind.replace("/", "__"), names, namespace={"__msgtype__": kind})
            self.store.types[kind] = made
        return self.store.types[kind]

    def empty(self, description):
        kind, rest = description
        if kind == ros_types.Nodetype.NAME:
            return self.make(rest)
        if kind == ros_types.Nodetype.BASE:
            return {"string": "", "bool": False, "float64": 0.0}.get(rest[0], 0)
        inner, count = rest
        if inner[0] == ros_types.Nodetype.BASE and inner[1][0] != "string":
            return numpy.zeros(count if kind == ros_types.Nodetype.ARRAY else 0, dtype=inner[1][0])
        return []

    def encode(self, kind, **fields):
        self.message_class(kind)
        return bytes(self.store.serialize_cdr(self.make(kind, **fields), kind))

    def decode(self, payload, kind):
        self.message_class(kind)
        for _, description in self.store.fielddefs[kind][1]:
            self.classes(description)
        return self.store.deserialize_cdr(payload.to_bytes(), kind)

    def classes(self, description):
        """Makes the classes of a field's messages."""
        kind, rest = description
        if kind == ros_types.Nodetype.NAME:
            self.message_class(rest)
            for _, inner in self.store.fielddefs[rest][1]:
                self.classes(inner)
        elif kind != ros_types.Nodetype.BASE:
            self.classes(rest[0])

    def attachment(self):
        self.sequence += 1
        return struct.pack("<qqB", self.sequence, time.time_ns(), 16) + self.gid

    def call(self, name, kind, payload, timeout=5.0):
        """The reply of a service; None if none came. The attachment must come back."""
        attachment = self.attachment()
        replies = self.session.get(
            self.key(name, kind),
            payload=payload,
            attachment=attachment,
            timeout=timeout,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in replies:
            if reply.ok is not None:
                assert reply.ok.attachment.to_bytes() == attachment, "the reply has another attachment"
                return self.decode(reply.ok.payload, f"{kind}_Response")
        return None

    # What a test asks.

    def trigger(self, name):
        reply = self.call(name, "std_srvs/srv/Trigger", b"\x00\x01\x00\x00\x00")
        return None if reply is None else [bool(reply.success), reply.message]

    def controllers(self):
        reply = self.call(
            "controller_manager/list_controllers",
            "controller_manager_msgs/srv/ListControllers",
            b"\x00\x01\x00\x00\x00",
        )
        return [[c.name, c.state, c.type, list(c.claimed_interfaces)] for c in reply.controller]

    def hardware(self):
        reply = self.call(
            "controller_manager/list_hardware_components",
            "controller_manager_msgs/srv/ListHardwareComponents",
            b"\x00\x01\x00\x00\x00",
        )
        return [
            [
                c.name,
                c.plugin_name,
                c.state.label,
                [i.name for i in c.state_interfaces],
                [i.is_claimed for i in c.command_interfaces],
            ]
            for c in reply.component
        ]

    def tokens(self):
        """All tokens of the graph, without the numbers of sessions and parts."""
        replies = self.session.liveliness().get(f"@ros2_lv/{self.domain}/**", timeout=3.0)
        keys = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        return sorted("/".join(key[5:]) for key in keys)

    def hashes(self):
        """Names of types with the hashes that rosbags computes."""
        wire = {}
        for kind in ros_types.NAMES:
            package, name = kind.rsplit("/", 1)
            wire[f"{package.replace('/', '::')}::dds_::{name}_"] = self.store.hash_rihs01(kind)
        return wire

    def joint_states(self, seconds):
        """How many came, and the last positions."""
        seen = []
        kind = "sensor_msgs/msg/JointState"
        subscriber = self.session.declare_subscriber(self.key("joint_states", kind), lambda s: seen.append(s.payload))
        time.sleep(seconds)
        subscriber.undeclare()
        last = self.decode(seen[-1], kind) if seen else None
        return {"count": len(seen), "position": [] if last is None else list(last.position)}

    def watch(self, task):
        """Follows feedback and states of an action from now on."""
        action = f"{task}/follow_joint_trajectory/_action"
        self.watched[task] = [
            self.session.declare_subscriber(self.key(f"{action}/feedback", f"{ACTION}_FeedbackMessage"), self.feedback),
            self.session.declare_subscriber(
                self.key(f"{action}/status", "action_msgs/msg/GoalStatusArray"), self.status
            ),
        ]
        return True

    def feedback(self, sample):
        message = self.decode(sample.payload, f"{ACTION}_FeedbackMessage")
        goal = self.goals.get(bytes(message.goal_id.uuid).hex())
        if goal is not None:
            body = message.feedback
            goal["feedback"].append(
                [
                    list(body.joint_names),
                    list(body.desired.positions),
                    list(body.actual.positions),
                    list(body.error.positions),
                    getattr(body, "index", None),
                ]
            )

    def status(self, sample):
        message = self.decode(sample.payload, "action_msgs/msg/GoalStatusArray")
        self.statuses.append({bytes(s.goal_info.goal_id.uuid).hex(): LIFECYCLE[s.status] for s in message.status_list})

    def goal(self, task, joints, points, path=None, end=None, late=0.0, stamp=0.0):
        """Sends a goal: rows of (time, positions, velocities). Returns its number; None if it was rejected."""
        number = uuid.uuid4()
        rows = [
            self.make(
                "trajectory_msgs/msg/JointTrajectoryPoint",
                positions=numpy.array(p, dtype=float),
                velocities=numpy.array(v, dtype=float),
                time_from_start=self.duration(t),
            )
            for t, p, v in points
        ]

        def tolerances(given):
            return [
                self.make("control_msgs/msg/JointTolerance", name=joint, position=limit)
                for joint, limit in (given or {}).items()
            ]

        header = self.make("std_msgs/msg/Header", stamp=self.make("builtin_interfaces/msg/Time", **parts(stamp)))
        trajectory = self.make("trajectory_msgs/msg/JointTrajectory", header=header, joint_names=joints, points=rows)
        goal = self.make(
            f"{ACTION}_Goal",
            trajectory=trajectory,
            path_tolerance=tolerances(path),
            goal_tolerance=tolerances(end),
            goal_time_tolerance=self.duration(late),
        )
        identifier = self.identifier(number.hex)
        self.goals[number.hex] = {"feedback": [], "result": None}
        payload = self.encode(f"{ACTION}_SendGoal_Request", goal_id=identifier, goal=goal)
        reply = self.call(f"{task}/follow_joint_trajectory/_action/send_goal", f"{ACTION}_SendGoal", payload)
        if reply is None or not reply.accepted:
            return None
        self.await_result(task, number.hex)
        return number.hex

    def identifier(self, goal):
        octets = numpy.frombuffer(bytes.fromhex(goal), dtype=numpy.uint8)
        return self.make("unique_identifier_msgs/msg/UUID", uuid=octets)

    def duration(self, seconds):
        return self.make("builtin_interfaces/msg/Duration", **parts(seconds))

    def await_result(self, task, goal):
        """Asks for the result, which comes at the end of the motion."""
        payload = self.encode(f"{ACTION}_GetResult_Request", goal_id=self.identifier(goal))

        def ask():
            reply = self.call(
                f"{task}/follow_joint_trajectory/_action/get_result", f"{ACTION}_GetResult", payload, 60.0
            )
            if reply is not None:
                self.goals[goal]["result"] = [
                    LIFECYCLE[reply.status],
                    int(reply.result.error_code),
                    reply.result.error_string,
                ]

        threading.Thread(target=ask, daemon=True).start()

    def result(self, goal, timeout=20.0):
        """The result of a goal: state, code, text; None if it has none in time."""
        deadline = time.monotonic() + timeout
        while self.goals[goal]["result"] is None and time.monotonic() < deadline:
            time.sleep(0.01)
        return self.goals[goal]["result"]

    def result_of_unknown(self, task):
        payload = self.encode(f"{ACTION}_GetResult_Request", goal_id=self.identifier(uuid.uuid4().hex))
        reply = self.call(f"{task}/follow_joint_trajectory/_action/get_result", f"{ACTION}_GetResult", payload)
        return LIFECYCLE[reply.status]

    def fed_back(self, goal):
        return self.goals[goal]["feedback"]

    def states(self, goal):
        """The states that the goal was published with, in order."""
        seen = []
        for statuses in self.statuses:
            if goal in statuses and statuses[goal] not in seen:
                seen.append(statuses[goal])
        return seen

    def cancel(self, task, goal=None):
        """Cancels a goal, or all: the return code, and which are cancelled."""
        identifier = self.identifier(goal or "00" * 16)
        info = self.make("action_msgs/msg/GoalInfo", goal_id=identifier)
        payload = self.encode("action_msgs/srv/CancelGoal_Request", goal_info=info)
        reply = self.call(f"{task}/follow_joint_trajectory/_action/cancel_goal", "action_msgs/srv/CancelGoal", payload)
        return [int(reply.return_code), [bytes(g.goal_id.uuid).hex() for g in reply.goals_canceling]]

    def garbage(self, task, seed, count):
        """Sends damaged requests to all services of an action; they cost only this client."""
        dice = random.Random(seed)
        goal = self.make(f"{ACTION}_Goal")
        whole = self.encode(f"{ACTION}_SendGoal_Request", goal_id=self.identifier(uuid.uuid4().hex), goal=goal)
        services = [
            ("send_goal", f"{ACTION}_SendGoal"),
            ("get_result", f"{ACTION}_GetResult"),
            ("cancel_goal", "action_msgs/srv/CancelGoal"),
        ]
        for _ in range(count):
            part, kind = dice.choice(services)
            attachment = dice.choice([self.attachment(), b"", b"x", dice.randbytes(33)])
            replies = self.session.get(
                self.key(f"{task}/follow_joint_trajectory/_action/{part}", kind),
                payload=damaged(dice, whole),
                attachment=attachment,
                timeout=0.02,
            )
            del replies
        return True


def parts(seconds):
    """Whole seconds and nanoseconds."""
    whole = math.floor(seconds)
    return {"sec": whole, "nanosec": round((seconds - whole) * 1e9)}


def damaged(dice, payload):
    """A payload that is cut, changed or repeated, or claims a length that it has not."""
    kind = dice.randrange(5)
    if kind == 0:
        return dice.randbytes(dice.randrange(0, 2000))
    if kind == 1:
        return payload[: dice.randrange(len(payload) + 1)]
    if kind == 2:
        return payload * dice.randrange(2, 200)
    changed = bytearray(payload)
    if kind == 3:
        at = dice.randrange(len(changed) - 4)
        changed[at : at + 4] = dice.choice([b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x01\x00"])
        return bytes(changed)
    for _ in range(dice.randrange(1, 8)):
        changed[dice.randrange(len(changed))] = dice.randrange(256)
    return bytes(changed)


if __name__ == "__main__":
    main()
