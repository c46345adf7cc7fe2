"""Hashes of the ROS 2 types that a run speaks, as rosbags computes them: `ros_types.py` prints DISTRO, type and hash.

rosbags has the messages of the distributions. Services and actions are messages to it, which are composed here as ROS
composes them: REP 2016, and the type descriptions of rosidl."""

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORES = {"jazzy": Stores.ROS2_JAZZY, "kilted": Stores.ROS2_KILTED, "lyrical": Stores.ROS2_LYRICAL}
MESSAGES = [
    "sensor_msgs/msg/JointState",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/String",
    "diagnostic_msgs/msg/DiagnosticArray",
    "action_msgs/msg/GoalStatusArray",
]

TOLERANCE = "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
COMPONENT_TOLERANCE = "string joint_name\nuint16 component\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
GOAL = """trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
control_msgs/JointTolerance[] path_tolerance
control_msgs/JointComponentTolerance[] component_path_tolerance
control_msgs/JointTolerance[] goal_tolerance
control_msgs/JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance
"""
RESULT = "int32 error_code\nstring error_string\n"
FEEDBACK = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
INDEX
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
MULTI_INDEX
"""
EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
ACTION = "control_msgs/action/FollowJointTrajectory"
CONTROLLER_STATE = """string name
string state
string type
bool is_async
uint16 update_rate
string[] claimed_interfaces
string[] required_command_interfaces
string[] required_state_interfaces
bool is_chainable
bool is_chained
string[] exported_state_interfaces
string[] reference_interfaces
controller_manager_msgs/ChainConnection[] chain_connections
"""
COMPONENT_STATE = """string name
string type
bool is_async
uint16 rw_rate
CLASS_TYPE
string plugin_name
lifecycle_msgs/State state
controller_manager_msgs/HardwareInterface[] command_interfaces
controller_manager_msgs/HardwareInterface[] state_interfaces
"""
MANAGER = "controller_manager_msgs"


def is_new(distro):
    """Whether it has control_msgs 6.3, whose feedback has indices of points, and ros2_control 5."""
    return distro != "jazzy"


def store_of(distro):
    """The types of a distribution, with those of control_msgs and of the services."""
    store = get_typestore(STORES[distro])
    # A `char` of ROS is an octet in its IDL, and so in the hash; rosbags has it as a character.
    constants, fields = store.fielddefs[EVENT_INFO]
    store.fielddefs[EVENT_INFO] = (constants, [octets(*field) for field in fields])
    new = is_new(distro)
    feedback = FEEDBACK.replace("MULTI_INDEX", "int32 multi_dof_index" if new else "")
    feedback = feedback.replace("INDEX", "int32 index" if new else "")
    component = COMPONENT_STATE.replace("CLASS_TYPE", "" if new else "string class_type")
    texts = {
        f"{MANAGER}/msg/ChainConnection": "string name\nstring[] reference_interfaces\n",
        f"{MANAGER}/msg/ControllerState": CONTROLLER_STATE,
        f"{MANAGER}/msg/HardwareComponentState": component,
        f"{MANAGER}/msg/HardwareInterface": "string name\nstring data_type\nbool is_available\nbool is_claimed\n",
        "control_msgs/msg/JointTolerance": TOLERANCE,
        "control_msgs/msg/JointComponentTolerance": COMPONENT_TOLERANCE,
        f"{ACTION}_Goal": GOAL,
        f"{ACTION}_Result": RESULT,
        f"{ACTION}_Feedback": feedback,
    }
    for name, text in texts.items():
        store.register(get_types_from_msg(text, name))
    uuid, time, boolean = ("unique_identifier_msgs/msg/UUID", "builtin_interfaces/msg/Time", base("bool"))
    compose(store, f"{ACTION}_FeedbackMessage", goal_id=uuid, feedback=f"{ACTION}_Feedback")
    service(store, f"{ACTION}_SendGoal", dict(goal_id=uuid, goal=f"{ACTION}_Goal"), dict(accepted=boolean, stamp=time))
    service(store, f"{ACTION}_GetResult", dict(goal_id=uuid), dict(status=base("int8"), result=f"{ACTION}_Result"))
    service(
        store,
        "action_msgs/srv/CancelGoal",
        dict(goal_info="action_msgs/msg/GoalInfo"),
        dict(return_code=base("int8"), goals_canceling=sequence("action_msgs/msg/GoalInfo")),
    )
    outcome = dict(success=boolean, message=base("string"))
    service(store, "std_srvs/srv/Trigger", {}, outcome)
    service(store, "std_srvs/srv/SetBool", dict(data=boolean), outcome)
    service(store, f"{MANAGER}/srv/ListControllers", {}, dict(controller=sequence(f"{MANAGER}/msg/ControllerState")))
    components = sequence(f"{MANAGER}/msg/HardwareComponentState")
    service(store, f"{MANAGER}/srv/ListHardwareComponents", {}, dict(component=components))
    service(store, "example_interfaces/srv/AddTwoInts", dict(a=base("int64"), b=base("int64")), dict(sum=base("int64")))
    return store


def octets(name, kind):
    """A field whose array of characters is one of octets."""
    if kind[0] == Nodetype.ARRAY and kind[1][0] == (Nodetype.BASE, ("char", 0)):
        kind = (kind[0], (base("uint8"), kind[1][1]))
    return name, kind


def base(kind):
    """A primitive type."""
    return (Nodetype.BASE, (kind, 0))


def sequence(name, most=0):
    """A list of messages; `most` 0: unbounded."""
    return (Nodetype.SEQUENCE, ((Nodetype.NAME, name), most))


def compose(store, name, **fields):
    """A message of these fields: names of messages, or descriptions."""
    described = [(key, (Nodetype.NAME, kind) if isinstance(kind, str) else kind) for key, kind in fields.items()]
    store.fielddefs[name] = ([], described)


def service(store, name, request, response):
    """A service: the message of its request, its response and its event."""
    compose(store, f"{name}_Request", **request)
    compose(store, f"{name}_Response", **response)
    compose(
        store,
        f"{name}_Event",
        info=EVENT_INFO,
        request=sequence(f"{name}_Request", 1),
        response=sequence(f"{name}_Response", 1),
    )
    compose(
        store,
        name,
        request_message=f"{name}_Request",
        response_message=f"{name}_Response",
        event_message=f"{name}_Event",
    )


NAMES = [
    *MESSAGES,
    *(f"{ACTION}_{part}" for part in ("SendGoal", "GetResult", "FeedbackMessage")),
    "action_msgs/srv/CancelGoal",
    f"{MANAGER}/srv/ListControllers",
    f"{MANAGER}/srv/ListHardwareComponents",
    "std_srvs/srv/Trigger",
    "std_srvs/srv/SetBool",
    "example_interfaces/srv/AddTwoInts",
]

if __name__ == "__main__":
    for distro in STORES:
        types = store_of(distro)
        for name in NAMES:
            print(distro, name, types.hash_rihs01(name))
