"""The node: publishes what a run has, and passes on trajectories, stops and cancels."""

from __future__ import annotations

import importlib
import threading
import time
from functools import partial
from typing import Any, Callable, Optional, Tuple

import rclpy
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from dimos_client import Client, DimosError, NoRun

from .goals import Goal, follow
from .messages import Messages

JOINTS, TRANSFORMS = 100.0, 25.0  # messages a second
AGAIN = 1.0  # s until a run that is not there is looked for again
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def make(name: str, /, **fields: Any) -> Any:
    """A message. `byte` is an object of bytes in rclpy."""
    package, _, kind = name.split("/")
    if kind == "DiagnosticStatus":
        fields["level"] = bytes([fields["level"]])
    return getattr(importlib.import_module(f"{package}.msg"), kind)(**fields)


class Dimos(Node):  # type: ignore[misc]
    """A run as a node."""
    def __init__(self) -> None:
        super().__init__("dimos")
        run = self.declare_parameter("run", "").value
        self.run: Optional[str] = run or None
        self.command = bool(self.declare_parameter("command", False).value)
        self.messages, self.ended = Messages(make), threading.Event()
        group = ReentrantCallbackGroup()
        self.joints = self.create_publisher(JointState, "joint_states", 10)
        self.tf = self.create_publisher(TFMessage, "tf", 100)
        self.tf_static = self.create_publisher(TFMessage, "tf_static", LATCHED)
        self.description = self.create_publisher(String, "robot_description", LATCHED)
        self.diagnostics = self.create_publisher(DiagnosticArray, "diagnostics", 10)
        for name, act in (("stop", self.stop), ("cancel", self.cancel)):
            self.create_service(Trigger, f"dimos/{name}", partial(self.answer, act), callback_group=group)
        with Client.connect(self.run) as client:
            status = client.status()
        self.run = status["run"]  # also after a restart of the run it is this one
        for task in (t["name"] for t in status["tasks"] if t["type"] == "trajectory"):
            ActionServer(self, FollowJointTrajectory, f"{task}/follow_joint_trajectory", partial(self.execute, task),
                         goal_callback=self.may_command, cancel_callback=lambda _: CancelResponse.ACCEPT,
                         callback_group=group)
        self.threads = [threading.Thread(target=self.repeat, args=(publish,), daemon=True)
                        for publish in (self.publish_joints, self.publish_transforms, self.publish_diagnostics)]
        for thread in self.threads:
            thread.start()

    def repeat(self, publish: Callable[[Client], None]) -> None:
        """Publishes until the node ends; waits for a run that is not there."""
        while not self.ended.is_set():
            try:
                with Client.connect(self.run) as client:
                    publish(client)
            except NoRun:
                pass
            except DimosError as error:
                self.get_logger().warning(str(error))
            self.ended.wait(AGAIN)

    def publish_joints(self, client: Client) -> None:
        """Joint states of all arms."""
        for state in client.joint_states(JOINTS):
            self.joints.publish(self.messages.joint_state(state))
            if self.ended.is_set():
                return

    def publish_transforms(self, client: Client) -> None:
        """The description of the robots once, then the poses of their links."""
        described = client.call("robot_description")
        if described["urdf"] is None:
            self.ended.wait()
            return
        self.description.publish(String(data=described["urdf"]))
        self.tf_static.publish(self.messages.transforms(described["fixed"], time.time()))
        while not self.ended.wait(1 / TRANSFORMS):
            reply = client.call("transforms")
            self.tf.publish(self.messages.transforms(reply["transforms"], reply["stamp"]))

    def publish_diagnostics(self, client: Client) -> None:
        """Arms and tick, once a second."""
        while not self.ended.wait(1.0):
            self.diagnostics.publish(self.messages.diagnostics(client.status(), time.time()))

    def answer(self, act: Callable[[Client], Tuple[bool, str]], _: Any, response: Any) -> Any:
        """Stops or cancels over a new connection, which waits for no other request."""
        try:
            with Client.connect(self.run) as client:
                response.success, response.message = act(client)
        except DimosError as error:
            response.success, response.message = False, str(error)
        return response

    @staticmethod
    def stop(client: Client) -> Tuple[bool, str]:
        """Holds all arms; it fails if one did not confirm."""
        arms = client.call("stop")["arms"]
        return all(said == "confirmed" for said in arms.values()), ", ".join(f"{a}: {said}" for a, said in arms.items())

    @staticmethod
    def cancel(client: Client) -> Tuple[bool, str]:
        """Ends all motions."""
        client.call("cancel")
        return True, "all motions decelerate to rest"

    def may_command(self, _: Any) -> GoalResponse:
        """Goals are for nodes that were started to command."""
        if not self.command:
            self.get_logger().warning("a goal was rejected: start the node with -p command:=true")
        return GoalResponse.ACCEPT if self.command else GoalResponse.REJECT

    def execute(self, task: str, handle: Any) -> Any:
        """Executes a goal; the lease is that of its connection."""
        result, goal = FollowJointTrajectory.Result(), Goal.read(handle.request)

        def feedback(desired: Any, actual: Any) -> None:
            handle.publish_feedback(FollowJointTrajectory.Feedback(
                **self.messages.feedback(goal.joints, desired, actual)))

        try:
            with Client.connect(self.run) as client:
                end = follow(client, task, goal, feedback,
                             lambda: handle.is_cancel_requested or self.ended.is_set(), time.time())
            result.error_code, result.error_string = end.code, end.text
            (handle.canceled if end.cancelled else handle.succeed if end.code == 0 else handle.abort)()
        except DimosError as error:
            result.error_code, result.error_string = FollowJointTrajectory.Result.INVALID_GOAL, str(error)
            handle.abort()
        return result


def main() -> None:
    """Runs the node until Ctrl-C."""
    rclpy.init()
    executor = MultiThreadedExecutor(num_threads=8)
    node = Dimos()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.ended.set()  # motions of goals are cancelled
        executor.shutdown(timeout_sec=8.0)


if __name__ == "__main__":
    main()
