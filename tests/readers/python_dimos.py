"""Python dimos 0.0.15, unmodified, as client, planner's executor, and coordinator.

`serve [NAME]` is its own ControlCoordinator with an arm of six joints in memory, until stdin ends. `client` uses its
RPC client, `execution` its PlanExecutionManager, `times` measures calls: each prints what it saw as one JSON object.
Their session takes its bus from the environment (ZENOH_SCOUT_ADDR, ZENOH_CONNECT, …).
"""

import json
import os
import sys
import threading
import time
from typing import Any

import numpy as np
import zenoh
from dimos.control.components import HardwareComponent, HardwareType, make_joints
from dimos.control.coordinator import ControlCoordinator
from dimos.control.tasks.trajectory_task.trajectory_task import joint_trajectory_task
from dimos.core.global_config import global_config
from dimos.core.rpc_client import RPCClient
from dimos.core.transport_factory import make_transport
from dimos.manipulation.execution_manager import PlanExecutionManager
from dimos.manipulation.planning.spec.enums import PlanningStatus
from dimos.manipulation.planning.spec.models import GeneratedPlan
from dimos.msgs.sensor_msgs.JointState import JointState
from dimos.msgs.trajectory_msgs.JointTrajectory import JointTrajectory
from dimos.msgs.trajectory_msgs.TrajectoryPoint import TrajectoryPoint
from dimos.msgs.trajectory_msgs.TrajectoryStatus import TrajectoryState, TrajectoryStatus

TASK = "joint_trajectory"


def serve(name=None):
    joints = make_joints("arm", 6)
    arm = HardwareComponent("arm", HardwareType.MANIPULATOR, joints=joints, adapter_type="mock")
    coordinator = ControlCoordinator(hardware=[arm], tasks=[joint_trajectory_task(joints)], instance_name=name)
    for port, value in (("coordinator_joint_state", JointState), ("coordinator_joint_command", JointState)):
        getattr(coordinator, port).transport = make_transport(port, value)
    coordinator.start()
    say({"serves": joints})
    sys.stdin.read()
    state = coordinator.task_invoke(TASK, "get_state", {}).name
    say({"positions": coordinator.get_joint_positions(), "state": state})
    coordinator.stop()


def client():
    remote, _ = connect()
    lists = ("list_joints", "list_hardware", "list_tasks")
    seen = {method: getattr(remote, method)() for method in (*lists, "get_joint_positions", "get_tick_count")}
    joints = seen["list_joints"]

    states = listen(1.0)
    seen["states"] = {"count": len(states), "name": states[-1].name, "frame_id": states[-1].frame_id}
    seen["states"]["age"] = time.time() - states[-1].ts
    seen["states"]["widths"] = [len(states[-1].position), len(states[-1].velocity), len(states[-1].effort)]

    here = remote.get_joint_positions()
    there = line(here, joints, 0.2)
    seen["execute"] = result(remote.execute_trajectory(there))
    seen["ended"] = until_ended(remote).name
    after = remote.get_joint_positions()
    seen["moved"] = [after[joint] - here[joint] for joint in joints]
    status = remote.task_invoke(TASK, "get_status", {"t_now": None})
    seen["status"] = [type(status).__name__, status.state.name, status.progress, status.time_remaining]

    seen["again"] = result(remote.execute_trajectory(there))
    # Planners leave numpy's numbers in lists.
    back = {"trajectory": line(after, joints, np.float64(-0.2)), "current_positions": after}
    assert type(back["trajectory"].points[1].positions[0]) is np.float64
    seen["by_task"] = result(remote.task_invoke(TASK, "execute", back))
    time.sleep(0.2)
    seen["active"] = remote.get_active_tasks()
    seen["status_within"] = fields(remote.task_invoke(TASK, "get_status", {"t_now": None}))
    seen["cancel"] = result(remote.cancel_trajectory())
    seen["cancelled"] = until_ended(remote).name
    seen["cancel_again"] = result(remote.task_invoke(TASK, "cancel", {}))

    seen["unknown_task"] = remote.task_invoke("nothing", "execute", {})
    seen["describe"] = remote.describe_task(TASK)
    seen["describe_unknown"] = remote.describe_task("nothing")
    seen["unknown_method"] = raised(lambda: remote.task_invoke(TASK, "levitate", {}))
    seen["unknown_argument"] = raised(lambda: remote.task_invoke(TASK, "cancel", {"hard": True}))
    seen["unknown_joint"] = result(remote.execute_trajectory(line({"elbow": 0.0}, ["elbow"], 0.1)))
    seen["estop"] = raised(lambda: remote.set_estop(True))
    remote.stop_rpc_client()
    say(seen)


def execution():
    remote, _ = connect()
    joints = remote.list_joints()
    manager = PlanExecutionManager(joint_names=joints, coordinator=remote, default_timeout=10.0)

    def plan(by, duration=1.0):
        trajectory = line(remote.get_joint_positions(), joints, by, duration)
        return GeneratedPlan(group_ids=("arm",), trajectory=trajectory, status=PlanningStatus.SUCCESS)

    def outcome(result):
        return [result.status.name, result.message]

    seen = {"blocking": outcome(manager.execute(plan(0.2)))}
    seen["not_blocking"] = outcome(manager.execute(plan(-0.2), blocking=False))
    seen["second"] = outcome(manager.execute(plan(0.1), blocking=False))
    # Another program's manager asks the coordinator itself.
    other = PlanExecutionManager(joint_names=joints, coordinator=remote, default_timeout=10.0)
    seen["other"] = outcome(other.execute(plan(0.1), blocking=False))
    seen["cancel"] = outcome(manager.cancel())
    seen["next"] = outcome(manager.execute(plan(0.1)))
    seen["idle"] = outcome(manager.wait())
    manager.close()
    remote.stop_rpc_client()
    say(seen)


def mapped(name, domain):
    os.environ["COORDINATOR"] = name
    global_config.update(zenoh_domain=domain)
    remote, _ = connect()
    joints = remote.list_joints()
    seen = {"joints": joints, "states": listen(0.5)[-1].name}
    seen["execute"] = result(remote.execute_trajectory(line(remote.get_joint_positions(), ["arm/shoulder"], 0.1)))
    until_ended(remote)
    seen["held"] = result(remote.execute_trajectory(line(remote.get_joint_positions(), ["tool/spin"], 0.1, 3.0)))
    remote.stop_rpc_client()
    say(seen)


def gripper():
    remote, _ = connect()

    def task(method, **arguments):
        return remote.task_invoke("arm_gripper", method, arguments)

    seen = {"tasks": remote.list_tasks(), "set": task("set_normalized", values=[0.5])}
    seen["beyond"] = task("set_normalized", values=[1.5])
    seen["two"] = task("set_normalized", values=[0.5, 0.5])
    time.sleep(1.5)
    seen["normalized"], seen["native"] = task("get_normalized"), task("get_position")
    seen["by_name"] = task("set_position", values=[0.0], t_now=None)
    remote.stop_rpc_client()
    say(seen)


def far():
    remote, _ = connect()
    joints = remote.list_joints()
    seen = {"joints": joints, "states": len(listen(1.0))}
    seen["execute"] = result(remote.execute_trajectory(line(remote.get_joint_positions(), joints, 0.1)))
    seen["ended"] = until_ended(remote).name
    remote.stop_rpc_client()
    say(seen)


def begin():
    """Begins a slow motion of all joints, and leaves."""
    remote, _ = connect()
    say(result(remote.execute_trajectory(line(remote.get_joint_positions(), remote.list_joints(), 1.0, 20.0))))
    remote.stop_rpc_client()


def times():
    remote, _ = connect()
    took = {}
    status = ("get_status", lambda: remote.task_invoke(TASK, "get_status", {"t_now": None}))
    positions = ("get_joint_positions", remote.get_joint_positions)
    for method, call in (positions, ("list_joints", remote.list_joints), status):
        for _ in range(20):
            call()
        each = []
        for _ in range(300):
            began = time.perf_counter()
            call()
            each.append(1e3 * (time.perf_counter() - began))
        each.sort()
        took[method] = {"p50": each[150], "p99": each[297], "max": each[-1]}
    states = listen(2.0)
    ages = sorted(1e3 * state.age for state in states)
    took["states"] = {"rate": len(states) / 2.0, "p50": ages[len(ages) // 2], "p99": ages[len(ages) * 99 // 100]}
    remote.stop_rpc_client()
    say(took)


def raw():
    """Sends what stdin has, as one query per line {method, hex, attachment}; prints each answer, or its absence."""
    remote, rpc = connect()
    for text in sys.stdin:
        query = json.loads(text)
        answers: list[dict[str, Any]] = []
        done = threading.Event()

        def reply(reply, answers=answers):
            good = reply.ok is not None
            value = reply.ok if good else reply.err
            answers.append({"ok": good, "encoding": str(value.encoding), "hex": value.payload.to_bytes().hex()})

        handler = zenoh.handlers.Callback(reply, drop=done.set)
        key = f"dimos/rpc/{os.environ.get('COORDINATOR', 'ControlCoordinator')}/{query['method']}"
        more = {"attachment": query["attachment"].encode()} if query.get("attachment") else {}
        rpc.session.get(
            key,
            handler,
            target=zenoh.QueryTarget.ALL,
            timeout=query.get("timeout", 5.0),
            payload=bytes.fromhex(query["hex"]),
            **more,
        )
        done.wait(10.0)
        say({"answers": answers})
    remote.stop_rpc_client()


def connect():
    remote = RPCClient.remote(ControlCoordinator, os.environ.get("COORDINATOR"))
    return remote, remote.rpc


def listen(duration):
    """Returns the joint states that come in this time, each with its age at arrival."""
    states = []
    transport = make_transport("coordinator_joint_state", JointState)

    def take(state):
        state.age = time.time() - state.ts
        states.append(state)

    transport.start()
    unsubscribe = transport.subscribe(take)
    time.sleep(0.3)
    states.clear()
    time.sleep(duration)
    unsubscribe()
    return list(states)


def line(here, joints, by, duration=1.0):
    ends = [[here[joint] + way for joint in joints] for way in (0.0, by)]
    points = [TrajectoryPoint(time_from_start=t, positions=p) for t, p in zip((0.0, duration), ends)]
    return JointTrajectory(joint_names=list(joints), points=points)


def until_ended(remote):
    for _ in range(100):
        state = remote.task_invoke(TASK, "get_state", {})
        if state is not TrajectoryState.EXECUTING:
            break
        time.sleep(0.05)
    return state


def result(result):
    return [type(result).__name__, result.status.name, result.message]


def fields(status):
    assert isinstance(status, TrajectoryStatus), status
    return [status.state.name, status.progress, status.time_elapsed, status.time_remaining]


def raised(call):
    try:
        return call()
    except Exception as error:
        return [type(error).__name__, str(error)]


def say(value):
    print(json.dumps(value), flush=True)


if __name__ == "__main__":
    globals()[sys.argv[1]](*sys.argv[2:])
    sys.stdout.flush()
    # Their threads may outlive the session.
    os._exit(0)
