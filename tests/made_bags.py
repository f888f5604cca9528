"""Bags of ROS 1 and 2 and MCAP files with any clocks, written through rosbags."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from tpcd.logs.bags import POSE, WRENCH

TOPICS = {"pose": "/tcp_pose", "wrench": "/ft_sensor", "command": "/target_pose"}
FRAMES = {"pose": "base", "wrench": "base", "command": "base"}
BEGIN = 1_700_000_000.0
KINDS = ("ros1", "ros2", "mcap")
LATE = {"wrench": 0.003}
"""When the messages of a topic come after those of the others [s]."""
EVERY = {"command": 5}
"""Of how many samples one has a message."""


def write_bag(
    kind: str,
    path: Path,
    space: Mapping[str, np.ndarray],
    topics: Mapping[str, str] = TOPICS,
    frames: Mapping[str, str] = FRAMES,
    stamp: Callable[[str, float], float | None] = lambda role, time: BEGIN + time,
    recorder: Callable[[str, float], float] = lambda role, time: BEGIN + time,
    keep: Callable[[str, float], bool] = lambda role, time: True,
) -> Path:
    """A bag of samples in three dimensions; topics stand in it in the order of time.

    `stamp` is what the header says (None for no stamp), `recorder` when a message was recorded, and
    `keep` whether it came, all by role and the true time since the start [s].
    """
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    written = []
    for k, since in enumerate(space["time"].tolist()):
        for role in topics:
            time = since + LATE.get(role, 0.0)
            if k % EVERY.get(role, 1) == 0 and keep(role, time):
                stamped = stamp(role, time)
                message = _message(store, role, frames[role], stamped, space, k)
                written.append((time, role, round(1e9 * recorder(role, time)), message))
    written.sort(key=lambda entry: entry[0])
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        kinds = {role: WRENCH if role == "wrench" else POSE for role in topics}
        connections: dict[str, Any] = {
            role: writer.add_connection(topic, kinds[role], typestore=store)
            for role, topic in topics.items()
        }
        serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
        for _, role, nanoseconds, message in written:
            writer.write(connections[role], nanoseconds, bytes(serialize(message, kinds[role])))
    return path


def _message(
    store: Any, role: str, frame: str, stamp: float | None, space: Mapping[str, np.ndarray], k: int
) -> Any:
    types = store.types
    ros1 = "seq" in types["std_msgs/msg/Header"].__dataclass_fields__
    nanoseconds = 0 if stamp is None else round(1e9 * stamp)
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](
            sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000
        ),
        frame_id=frame,
        **({"seq": 0} if ros1 else {}),
    )
    if role == "wrench":
        vector = types["geometry_msgs/msg/Vector3"]
        force, torque = (vector(*space[name][k].tolist()) for name in ("force", "torque"))
        return types[WRENCH](
            header=header, wrench=types["geometry_msgs/msg/Wrench"](force=force, torque=torque)
        )
    place, turn = ("target", "turned") if role == "command" else ("position", "rotation")
    return types[POSE](
        header=header,
        pose=types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](*space[place][k].tolist()),
            orientation=types["geometry_msgs/msg/Quaternion"](*space[turn][k].tolist()),
        ),
    )
