"""What numbers of an episode can be in SI units: how far away, how far apart, how large.

Bounds follow from what an arm does. A command may lie as far from the pose as the springs are
stretched by what is felt, w / K, which for a soft arm is more than a metre; so a jump is an error
only where pose and wrench do not go along with it.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from tpcd.contract import COUNTED, LARGEST_ANGLE, LARGEST_LENGTH
from tpcd.data.table import row_name
from tpcd.errors import EpisodeError
from tpcd.planar import short_way

COMMAND_COLUMNS = ("u_x", "u_z", "u_phi")
POSE_COLUMNS = ("x", "z", "phi")
WRENCH_COLUMNS = ("F_x", "F_z", "tau")
LARGEST_JUMP = 0.5
"""Commands, or poses, of neighbouring rows may be this far apart in any case [m]."""
LARGEST_TURN = 2.0
"""The same of their angles [rad]."""
UNEXPLAINED = 0.5
"""Beyond that, this part of a jump must be the arm's motion, or what its springs are stretched."""
LARGEST_WRENCH = 1e4
"""Forces and torques beyond this [N, N·m] are taken for millinewtons or a fault."""


def check_columns(
    path: Path, commands: np.ndarray, poses: np.ndarray, wrenches: np.ndarray, unusual: bool
) -> None:
    """Refuse what is not finite, or no number in SI units, lengths and angles only where they are
    not said to be `unusual`; raises `EpisodeError` naming the row."""
    length = (math.inf if unusual else LARGEST_LENGTH, "m", "millimetres")
    angle = (math.inf if unusual else LARGEST_ANGLE, "rad", COUNTED)
    force, torque = (LARGEST_WRENCH, "N", "millinewtons"), (LARGEST_WRENCH, "N·m", "mN·m")
    columns = (
        (COMMAND_COLUMNS, commands, (length, length, angle)),
        (POSE_COLUMNS, poses, (length, length, angle)),
        (WRENCH_COLUMNS, wrenches, (force, force, torque)),
    )
    for names, values, limits in columns:
        for axis, name in enumerate(names):
            _check_column(path, name, values[:, axis], limits[axis])


def check_jumps(
    path: Path,
    commands: np.ndarray,
    poses: np.ndarray,
    wrenches: np.ndarray,
    stiffness: np.ndarray,
) -> None:
    """Refuse jumps that neither motion nor stretched springs explain; raises `EpisodeError`.

    A step of command or pose beyond `LARGEST_JUMP` is explained if the change of
    x - u - w / K with it is less than `UNEXPLAINED` of the step.
    """
    away = short_way(poses - commands)
    strange = short_way(np.diff(away - wrenches / stiffness, axis=0))
    jumps: list[tuple[int, float, str, str]] = []
    for what, names, values in (
        ("command", COMMAND_COLUMNS, commands),
        ("pose", POSE_COLUMNS, poses),
    ):
        steps = short_way(np.diff(values, axis=0))
        position, angle = f"columns {names[0]}, {names[1]}", f"column {names[2]}"
        frame, in_rad = f"check the frame of the {what}s", f"check that {names[2]} is in rad"
        for columns, part, verb, largest, unit, remedy in (
            (position, slice(0, 2), "jumps", LARGEST_JUMP, "m", frame),
            (angle, slice(2, 3), "turns", LARGEST_TURN, "rad", in_rad),
        ):
            sizes, odd = (np.linalg.norm(each[:, part], axis=1) for each in (steps, strange))
            for k in np.flatnonzero((sizes > largest) & (odd > UNEXPLAINED * sizes))[:1]:
                told = (
                    f"{row_name(int(k) + 1, path)}, {columns}: the {what} {verb} by"
                    f" {sizes[k]:.3g} {unit}, and pose and wrench do not go along with"
                    f" {odd[k]:.3g} {unit} of it; expected at most {largest:g} {unit}"
                )
                jumps.append((int(k), -float(sizes[k]), told, remedy))
    if jumps:
        _, _, told, remedy = min(jumps)
        remedy += ", check the units and the stiffness, or split the episode there"
        raise EpisodeError(path, told, remedy)


def _check_column(path: Path, name: str, column: np.ndarray, limit: tuple[float, str, str]) -> None:
    finite = np.isfinite(column)
    if not finite.all():
        row = int(np.argmin(finite))
        raise EpisodeError(
            path,
            f"{row_name(row, path)}, column {name}: found {column[row]}, expected a finite number",
            "measure the step again, or split the episode there",
        )
    largest, unit, likely = limit
    if len(column) and np.abs(column).max() > largest:
        row = int(np.argmax(np.abs(column) > largest))
        raise EpisodeError(
            path,
            f"{row_name(row, path)}, column {name}: found {column[row]:g}, expected {unit}"
            f" (at most {largest:.3g}); it looks like {likely}",
            f"convert the column to {unit}",
        )
