"""Writers of log files as robots write them: each format by its own library."""

import json
import re

import hdf5storage
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from mcap.writer import Writer as McapLibraryWriter
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from robotid.base.exceptions import DataError
from robotid.data.log import COLUMNS

JOINT_STATE = "sensor_msgs/msg/JointState"
FIELDS = {"position": "q", "velocity": "v", "effort": "tau"}


def refused(text):
    return pytest.raises(DataError, match="^" + re.escape(text) + "$")


def assert_same(back, log, names=("t", "q", "v", "tau")):
    for name in names:
        np.testing.assert_array_equal(getattr(back, name), getattr(log, name), name)


def messages_of(log):
    """Yield (stamp [s], names, position, velocity, effort) of each row, names ever reordered."""
    n = len(log.joints)
    for k, t in enumerate(log.t):
        order = np.roll(np.arange(n), k)
        names = [log.joints[j] for j in order]
        rows = [[] if (x := getattr(log, key)) is None else x[k, order] for key in FIELDS.values()]
        yield t, names, *rows


def to_ns(t):
    return round(t * 1e9)


def joint_state(types, stamp, names, position, velocity, effort):
    """Return a message of rosbags; a header stamp in ns."""
    time = types.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    fields = {"stamp": time, "frame_id": ""}
    if "seq" in dict(types.fielddefs["std_msgs/msg/Header"][1]):
        fields["seq"] = 0
    header = types.types["std_msgs/msg/Header"](**fields)
    arrays = [np.asarray(x, dtype=np.float64) for x in (position, velocity, effort)]
    return types.types[JOINT_STATE](header, list(names), *arrays)


def write_bag(path, topics, types, plugin=StoragePlugin.SQLITE3):
    """Write {topic: (type, messages with the time of recording [s])} as .bag, or as a folder."""
    is_ros1 = path.suffix == ".bag"
    serialize = types.serialize_ros1 if is_ros1 else types.serialize_cdr
    folder = {"version": 9, "storage_plugin": plugin}
    with Bag1Writer(path) if is_ros1 else Bag2Writer(path, **folder) as bag:
        for topic, (kind, messages) in topics.items():
            connection = bag.add_connection(topic, kind, typestore=types)
            for t, message in messages:
                bag.write(connection, to_ns(t), serialize(message, kind))
    return path


def states_of(types, messages, delay=0.0):
    """Return joint states as ``write_bag`` takes them; delay of the time of recording [s]."""
    return JOINT_STATE, [(m[0] + delay, joint_state(types, to_ns(m[0]), *m[1:])) for m in messages]


def types_of(path):
    return get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)


def write_states(path, topics, *, delay=0.0, others=(), **how):
    """Write {topic: joint states}; others are topics of text, one message each."""
    types, text = types_of(path), "std_msgs/msg/String"
    written = {topic: (text, [(5e-9, types.types[text]("hello"))]) for topic in others}
    written |= {topic: states_of(types, messages, delay) for topic, messages in topics.items()}
    return write_bag(path, written, types, **how)


def write_mcap(path, messages, topic="/joint_states", delay=lambda k: 0.0):
    """Write with the library of MCAP itself; delay of the time of recording by number [s]."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    definition, _ = types.generate_msgdef(JOINT_STATE, ros_version=2)
    with path.open("wb") as file:
        writer = McapWriter(file)
        schema = writer.register_msgdef(JOINT_STATE, definition)
        for k, (t, names, *arrays) in enumerate(messages):
            sec, nanosec = divmod(to_ns(t), 10**9)
            message = {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}}
            message |= {"name": names} | dict(zip(FIELDS, map(list, arrays), strict=True))
            now = to_ns(t + delay(k))
            writer.write_message(topic, schema, message, log_time=now, publish_time=now)
        writer.finish()
    return path


def wide(log, text=str):
    """Return the arrays as a user's script holds them: (N, n), and the names of the joints."""
    names = {"time": log.t, "q": log.q, "dq": log.v, "ddq": log.a, "tau": log.tau}
    arrays = {name: x for name, x in names.items() if x is not None}
    return arrays | {"joints": np.array(log.joints, dtype=text)}


def write_mat73(path, content):
    """Write MATLAB v7.3."""
    hdf5storage.savemat(
        str(path), content, format="7.3", appendmat=False, store_python_metadata=False
    )
    return path


def write_mat5(path, content):
    scipy.io.savemat(path, content)
    return path


CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
#: Names of the points of what was measured, wanted and put out, before control_msgs 4 and since.
POINTS = {"old": ("actual", "desired", None), "new": ("feedback", "reference", "output")}


def controller_types(era, path):
    """Return a store that knows the controller's state as control_msgs of an era defines it."""
    types = types_of(path)
    lines = ["std_msgs/Header header", "string[] joint_names"]
    lines += [f"trajectory_msgs/JointTrajectoryPoint {name}" for name in POINTS[era] if name]
    lines += ["trajectory_msgs/JointTrajectoryPoint error"]
    types.register(get_types_from_msg("\n".join(lines), CONTROLLER))
    return types


def controller_state(types, era, log, k, *, output=None):
    """Return row k of a log as a controller tells it; output: positions that it put out."""
    header = joint_state(types, to_ns(log.t[k]), [], [], [], []).header
    rows = {name: () if (x := getattr(log, name)) is None else x[k] for name in COLUMNS.values()}
    duration = types.types["builtin_interfaces/msg/Duration"](0, 0)

    def point(q=(), v=(), tau=()):
        arrays = [np.asarray(x, dtype=np.float64) for x in (q, v, (), tau)]
        return types.types[POINT](*arrays, duration)

    torque = rows["tau"] if log.has_torque else np.full(len(log.joints), np.nan)
    points = {
        POINTS[era][0]: point(rows["q"], rows["v"], torque),
        POINTS[era][1]: point(rows["q_ref"], rows["v_ref"], rows["tau_ref"]),
        POINTS[era][2]: point(() if output is None else output[k]),
        "error": point(rows["q_ref"] - rows["q"]),
    }
    points.pop(None, None)
    return types.types[CONTROLLER](header=header, joint_names=list(log.joints), **points)


def write_controller(path, log, era, *, states=(), output=None, plugin=StoragePlugin.MCAP):
    """Write a controller's states as .bag, or as a folder; and joint states."""
    types = controller_types(era, path)
    rows = [(t, controller_state(types, era, log, k, output=output)) for k, t in enumerate(log.t)]
    topics = {"/arm_controller/state": (CONTROLLER, rows)}
    topics |= {"/joint_states": states_of(types, states)} if states else {}
    return write_bag(path, topics, types, plugin)


def write_idl_controller(path, log):
    """Write a controller's states as an MCAP whose types are defined in IDL."""
    types = controller_types("new", path)
    points = "".join(
        f"      trajectory_msgs::msg::JointTrajectoryPoint {x};\n" for x in POINTS["new"]
    )
    idl = (
        f"{'=' * 80}\nIDL: {CONTROLLER}\n"
        "module control_msgs {\n  module msg {\n    struct JointTrajectoryControllerState {\n"
        "      std_msgs::msg::Header header;\n      sequence<string> joint_names;\n"
        f"{points}      trajectory_msgs::msg::JointTrajectoryPoint error;\n"
        "    };\n  };\n};\n"
    )
    with path.open("wb") as file:
        writer = McapLibraryWriter(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(CONTROLLER, "ros2idl", idl.encode())
        channel = writer.register_channel("/controller_state", "cdr", schema)
        for k, t in enumerate(log.t):
            raw = types.serialize_cdr(controller_state(types, "new", log, k), CONTROLLER)
            writer.add_message(channel, to_ns(t), bytes(raw), to_ns(t))
        writer.finish()
    return path


def write_lerobot(folder, episodes, names, *, version="v2.1", rate=50):
    """Write {episode: (state, action)} as a LeRobot dataset: version 2 has a file per episode."""
    width = next(iter(episodes.values()))[0].shape[1]
    features = {
        name: {"dtype": "float32", "shape": [width], "names": names[name]}
        for name in ("observation.state", "action")
    }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    info = {"codebase_version": version, "total_episodes": len(episodes), "fps": rate}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info | {"features": features}))
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    tables = {}
    for number, (state, action) in episodes.items():
        frames = np.arange(len(state))
        vectors = pa.list_(pa.float32(), width)
        tables[number] = pa.table(
            {
                "observation.state": pa.array(list(state.astype(np.float32)), vectors),
                "action": pa.array(list(action.astype(np.float32)), vectors),
                "timestamp": pa.array((frames / rate).astype(np.float32)),
                "frame_index": frames,
                "episode_index": np.full(len(state), number),
            }
        )
    if version.startswith("v3"):
        pq.write_table(pa.concat_tables(tables.values()), chunk / "file-000.parquet")
        return folder
    for number, table in tables.items():
        pq.write_table(table, chunk / f"episode_{number:06d}.parquet")
    return folder
