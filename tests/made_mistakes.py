"""Conventions mistaken when a recording is read, each with the option that mends it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from tests.made_logs import Setting
from tpcd.logs.importing import Importing, import_log
from tpcd.logs.log import Log, LogError
from tpcd.quality.finding import Finding, Weight

TURNED = Setting(
    base=Rotation.from_euler("xyz", [0.3, 0.5, 2.0]),
    tool=Rotation.from_euler("xyz", [3.0, 0.2, 0.1]),
    origin=(0.4, -0.2, 0.1),
    point=(0.01, 0.02, -0.05),
    in_tool=True,
    sign=-1.0,
)
ALONG, DOWN = Setting(), Setting(tool=Rotation.from_euler("x", 180, degrees=True), in_tool=True)
Mistake = Callable[[Log, Importing], tuple[Log, Importing]]


def w_first(rotation: Rotation) -> Rotation:
    return Rotation.from_quat(rotation.as_quat()[:, [3, 0, 1, 2]])


def wrong_order(log: Log, choices: Importing) -> tuple[Log, Importing]:
    turned = log.command_rotations
    assert turned is not None
    told = replace(log, rotations=w_first(log.rotations), command_rotations=w_first(turned))
    return told, choices


def inverse(log: Log, choices: Importing) -> tuple[Log, Importing]:
    turned = log.command_rotations
    assert turned is not None
    return replace(log, rotations=log.rotations.inv(), command_rotations=turned.inv()), choices


def inverted_wrench(log: Log, choices: Importing) -> tuple[Log, Importing]:
    return log, replace(choices, wrench=replace(choices.wrench, sign=-choices.wrench.sign))


def other_axes(log: Log, choices: Importing) -> tuple[Log, Importing]:
    frame = "world" if choices.wrench.frame == "tool" else "tool"
    return log, replace(choices, wrench=replace(choices.wrench, frame=frame))


def inverted_torque(log: Log, choices: Importing) -> tuple[Log, Importing]:
    return replace(log, torques=-log.torques), choices


def exchanged(log: Log, choices: Importing) -> tuple[Log, Importing]:
    return replace(log, forces=log.torques, torques=log.forces), choices


def other_point(log: Log, choices: Importing) -> tuple[Log, Importing]:
    moved = tuple(np.array(choices.wrench.point) + [0.03, 0.0, 0.1])
    return log, replace(choices, wrench=replace(choices.wrench, point=moved))


def millimetres(log: Log, choices: Importing) -> tuple[Log, Importing]:
    target = log.command_positions
    assert target is not None
    # An arm that is at home where its millimetres are few: no number looks odd by itself.
    start = log.positions[0]
    origin = np.array(choices.plane.origin) - start
    return (
        replace(
            log,
            positions=1e3 * (log.positions - start),
            command_positions=1e3 * (target - start),
        ),
        replace(choices, plane=replace(choices.plane, origin=tuple((1e3 * origin).tolist()))),
    )


MISTAKES: dict[str, tuple[Mistake, str]] = {
    "order": (wrong_order, "--quaternion wxyz"),
    "sense": (inverse, "--invert_rotation"),
    "sign": (inverted_wrench, "--invert_wrench"),
    "frame": (other_axes, "--wrench_frame"),
    "torque": (inverted_torque, "--invert_torque"),
    "channels": (exchanged, "map F_x F_y F_z to the columns of T_x T_y T_z"),
    "point": (other_point, "--wrench_point"),
    "length": (millimetres, "positions look like millimetres"),
}


def convention_doubts(log: Log, choices: Importing) -> list[Finding]:
    """What an import says of conventions, doubted or in the error that it stops with."""
    try:
        found = import_log(log, choices)
    except LogError as error:
        return [Finding("convention", Weight.SERIOUS, error.problem, remedy=error.remedy)]
    return [each for each in found.account.doubts if each.kind == "convention"]


PAIRS = [
    pair
    for pair in combinations(MISTAKES, 2)
    # What another point does to torques is told once the rest is mended.
    if "point" not in pair
]
