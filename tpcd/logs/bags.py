"""ROS 1 bags, ROS 2 bags and MCAP files, read through rosbags (extra `bags`).

Poses and set points are geometry_msgs/PoseStamped, wrenches WrenchStamped. The samples are those of
the pose; wrenches are interpolated to its times, a set point holds until the next one comes. Times
are those of the headers, or of the recorder where the headers have none or jump.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tpcd.logs.joining import join
from tpcd.logs.log import Log, LogError
from tpcd.logs.recorded import Recorded, common_clock, places
from tpcd.quality.sentinels import without_sentinels
from tpcd.quality.stream import Stream

POSE, WRENCH = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/WrenchStamped"
KINDS = {"pose": POSE, "wrench": WRENCH, "command": POSE}
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
CHANNELS = {
    "pose": _POSE,
    "wrench": ("F_x", "F_y", "F_z", "T_x", "T_y", "T_z"),
    "command": tuple(f"u_{name}" for name in _POSE),
}
SUFFIXES = (".bag", ".mcap", ".db3")
COMMAND_WORDS = (
    "command",
    "cmd",
    "target",
    "desired",
    "setpoint",
    "set_point",
    "reference",
    "goal",
    "equilibrium",
)
"""A topic whose name has one of these is taken for the set point."""


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file of such a kind, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in SUFFIXES or path.is_dir()


def read_bag(
    path: Path, topics: Sequence[str] = (), delays: Mapping[str, float] | None = None
) -> Log:
    """The recording in a bag; `topics` read pose=TOPIC, wrench=TOPIC, command=TOPIC, and `delays`
    say how late each is [s].

    Raises `LogError` for a bag that cannot be read and for topics that are missing or of another
    type, `ValueError` for malformed `topics`.
    """
    if not path.exists():
        raise LogError(path, "no such file", "give a bag, an MCAP file, or a table")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise LogError(path, "is a folder without metadata.yaml", "give the folder of a ROS 2 bag")
    named = _named(topics)
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise LogError(path, "bags need rosbags", "pip install 'tpcd[bags]'") from error
    try:
        store = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([path], default_typestore=store) as reader:
            types = {c.topic: c.msgtype for c in reader.connections}
            chosen = choose_topics(types, named, path)
            read = {role: _read(reader, topic, path) for role, topic in chosen.items()}
        return _joined(path, read, delays)
    except (AnyReaderError, OSError, ValueError) as error:
        if isinstance(error, LogError):
            raise
        problem = " ".join(str(error).split())
        raise LogError(path, f"cannot be read as a bag ({problem})", "record it again") from error


def choose_topics(types: dict[str, str], named: dict[str, str], path: Path) -> dict[str, str]:
    """The topic of each role; one that is not named is found by type and name if only one fits."""
    for role, topic in named.items():
        found = types.get(topic)
        if found != KINDS[role]:
            there = f"is {found}" if found else "is not in the bag"
            fitting = ", ".join(t for t, kind in types.items() if kind == KINDS[role]) or "none"
            raise LogError(
                path, f"topic {topic!r} {there}, expected {KINDS[role]}", f"there are: {fitting}"
            )
    chosen = dict(named)
    for role in ("command", "wrench", "pose"):
        if role in chosen:
            continue
        fitting = [t for t, k in types.items() if k == KINDS[role] and t not in chosen.values()]
        commands = [t for t in fitting if any(word in t.lower() for word in COMMAND_WORDS)]
        fitting = commands if role == "command" else fitting
        if len(fitting) == 1:
            chosen[role] = fitting[0]
        elif fitting or role != "command":
            found = ", ".join(fitting) or f"none of {KINDS[role]}"
            raise LogError(
                path, f"topics for the {role}: {found}", f"name one with --topics {role}=TOPIC"
            )
    return chosen


def _named(topics: Sequence[str]) -> dict[str, str]:
    named = {}
    for entry in topics:
        role, equals, topic = entry.partition("=")
        if not equals or role not in KINDS or not topic:
            raise ValueError(f"topics: found {entry!r}, expected pose=, wrench= or command=TOPIC")
        named[role] = topic
    return named


def _read(reader: Any, name: str, path: Path) -> Recorded:
    connections = [c for c in reader.connections if c.topic == name]
    recorded, stamps, values, frames = [], [], [], set()
    for connection, time, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        stamp = message.header.stamp
        recorded.append(time)
        stamps.append(1_000_000_000 * stamp.sec + stamp.nanosec)
        frames.add(message.header.frame_id)
        if connection.msgtype == POSE:
            p, q = message.pose.position, message.pose.orientation
            values.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        else:
            f, t = message.wrench.force, message.wrench.torque
            values.append((f.x, f.y, f.z, t.x, t.y, t.z))
    if not values:
        raise LogError(path, f"topic {name!r} has no messages", "name another with --topics")
    if len(frames) > 1:
        found = ", ".join(sorted(frames))
        raise LogError(path, f"topic {name!r} changes its frame ({found})", "split the recording")
    times = np.array(recorded, dtype=np.int64)
    at = places(reader, connections, times)
    order = np.argsort(at, kind="stable")
    return Recorded(
        name,
        frames.pop(),
        at[order],
        times[order],
        np.array(stamps, dtype=np.int64)[order],
        np.array(values, dtype=np.float64)[order],
    )


def _joined(path: Path, read: dict[str, Recorded], delays: Mapping[str, float] | None) -> Log:
    pose, wrench, command = read["pose"], read["wrench"], read.get("command")
    notes = [f"pose is {pose.name} in {pose.frame!r}, wrench is {wrench.name} in {wrench.frame!r}"]
    if wrench.frame != pose.frame:
        notes.append(
            "the frames differ: if the wrench is in axes of the tool, give --wrench_frame tool"
        )
    if command is not None:
        notes.append(f"set point is {command.name} in {command.frame!r}")
        if command.frame != pose.frame:
            raise LogError(
                path,
                f"the pose is in {pose.frame!r}, the set point in {command.frame!r}",
                "record both in one frame",
            )
    times, stamps, findings = common_clock(list(read.values()))
    streams = []
    for (role, topic), own, stamped in zip(read.items(), times, stamps, strict=True):
        columns = dict(zip(CHANNELS[role], topic.values.T, strict=True))
        columns, told = without_sentinels(columns, f"{topic.name}: ")
        values = np.stack(list(columns.values()), axis=1)
        streams.append(Stream(topic.name, CHANNELS[role], own, values, stamped))
        notes += told
    return join(path, streams, delays=delays, findings=findings, notes=notes)
