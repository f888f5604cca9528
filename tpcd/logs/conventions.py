"""Conventions that a recording may have been read by wrongly, each with what would mend it.

A change takes a recording at rest to what it would be if one convention were another: the order of
a quaternion, which way a rotation is meant, the axes of Euler angles, sign, axes and order of the
wrench, a unit. Changes of different subjects can be made one after another. Nothing here assumes a
plane; what a change is worth is settled in `readings`.

With its four numbers turned by one place a quaternion still turns evenly about one fixed axis, but
another one, backwards: q' = a q* b for fixed a and b. So a wrong order looks like an inverted angle
where that axis is the plane's, and like a swing out of the plane elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tpcd.logs.log import Log, RotationNumbers
from tpcd.logs.plane import WrenchReading

Order = Literal["xyzw", "wxyz"]
EULER = ("ZYX", "XYZ", "zyx", "xyz", "ZYZ", "zyz", "ZXZ", "YXZ")
"""Axes that controllers use: KUKA and aircraft, ROS and SolidWorks, Kawasaki, games."""
Which = Literal["both", "pose", "command"]
"""Whose rotations."""


@dataclass(frozen=True)
class RotationReading:
    """How the rotations of a recording are meant, beside what its map says."""

    quaternion: Order = "xyzw"
    """Order in which the four numbers come that the map or the message calls x, y, z, w."""
    inverse: bool = False
    """They are from the world to the end effector, or a planar angle from z to x."""

    def of(self, log: Log) -> Log:
        """The recording with its rotations meant so."""
        if self.quaternion == "wxyz":
            log = _with_rotations(log, _wxyz, "both")
        return _with_rotations(log, _inverse, "both") if self.inverse else log


@dataclass(frozen=True, eq=False)
class AtRest:
    """k settled samples of a recording in three dimensions, and how they are read."""

    log: Log
    wrench: WrenchReading
    stiffness: Float[np.ndarray, " 3"]
    """[N/m, N/m, N·m/rad] in the plane."""
    scale: Float[np.ndarray, " 2"]
    """Factors of force and torque to what was read."""


@dataclass(frozen=True)
class Change:
    """One convention that would have to be another."""

    subject: str
    """What it is about; a hypothesis has at most one change of a subject."""
    said: str
    """The convention, as a clause."""
    remedy: str
    """What to change in the command or the map."""
    cost: float
    """Minus the logarithm of its prior odds: how rarely it is mistaken."""
    apply: Callable[[AtRest], AtRest]
    of_stiffness: bool = False
    """Whether it says that the stiffness is another."""


def changes_of(log: Log, wrench: WrenchReading, rotation: RotationReading) -> list[Change]:
    """The changes that can be tried on a recording that was read in this way."""
    parts = (_of_rotations(log, rotation), _of_wrench(log, wrench), _of_axes(log), _of_units(log))
    return [change for part in parts for change in part]


def _of_rotations(log: Log, rotation: RotationReading) -> list[Change]:
    if "rotation" in log.missing or log.command_rotations is None:
        return []
    kind = "quaternion" if log.numbers is None else log.numbers.kind
    apart = log.numbers is None or log.command_numbers is not None
    found = []
    other: Order = "wxyz" if rotation.quaternion == "xyzw" else "xyzw"
    turn = _wxyz if other == "wxyz" else _xyzw
    back = "without" if rotation.inverse else "with"
    way = "end effector to the world" if rotation.inverse else "world to the end effector"
    meant = "phi turns from z to x" if kind == "planar angle" else f"rotations are from the {way}"
    if kind == "quaternion":
        named = ", ".join(other)
        found += [
            Change("order", f"the quaternions are {named}", f"--quaternion {other}", 3.0,
                   _rotated(turn, "both")),
        ]  # fmt: skip
        parts: tuple[tuple[str, str, Which], ...] = (
            ("set point", "u_", "command"),
            ("pose", "", "pose"),
        )
        found += [
            Change("order", f"the quaternions of the {what} alone are {named}",
                   _remapped(log, prefix, other), 5.0, _rotated(turn, which))
            for what, prefix, which in parts
            if apart
        ]  # fmt: skip
    found.append(
        Change("sense", meant, f"{back} --invert_rotation", 4.0, _rotated(_inverse, "both"))
    )
    if apart:
        name = "u_phi" if kind == "planar angle" else "rotations of the set point"
        found += [
            Change("sense", f"the {name} alone turn the other way",
                   "turn those of the set point round in the recording", 6.0,
                   _rotated(_inverse, "command")),
        ]  # fmt: skip
    if kind == "Euler angles" and log.numbers is not None:
        found += [
            Change("order", f"the Euler angles are {axes}", f"--euler {axes}", 4.0,
                   _rotated(_about(axes), "both"))
            for axes in EULER
            if axes != log.numbers.euler
        ]  # fmt: skip
    if kind != "quaternion":
        found += [
            Change("unit of angles", f"angles are in {unit}",
                   _with_unit(log, _angles(log), short), 4.0,
                   _rotated(_scaled(factor), "both"))
            for unit, short, factor in (("degrees", "deg", math.pi / 180),
                                        ("radians", "rad", 180 / math.pi))
        ]  # fmt: skip
    return found


def _of_wrench(log: Log, wrench: WrenchReading) -> list[Change]:
    other = "tool" if wrench.frame == "world" else "world"
    sign = "without" if wrench.sign < 0 else "with"
    torque = "without" if wrench.torque_sign < 0 else "with"
    return [
        Change("sign", "the wrench is inverted", f"{sign} --invert_wrench", 3.0,
               lambda rest: _read(rest, sign=-rest.wrench.sign)),
        Change("frame", f"the wrench is given in {other} axes", f"--wrench_frame {other}", 3.0,
               lambda rest: _read(rest, frame=other)),
        Change("torque", "the torques alone turn the other way", f"{torque} --invert_torque", 6.0,
               lambda rest: _read(rest, torque_sign=-rest.wrench.torque_sign)),
        Change("channels", "forces and torques are exchanged",
               "map F_x F_y F_z to the columns of T_x T_y T_z, and these to theirs", 5.0,
               lambda rest: replace(rest, log=replace(
                   rest.log, forces=rest.log.torques, torques=rest.log.forces))),
    ]  # fmt: skip


def _of_axes(log: Log) -> list[Change]:
    """Sensors that are mounted a quarter of a turn or more round, and single axes of the force that
    are exchanged or count the other way."""
    planar = {"F_y", "T_x", "T_z"} <= log.missing
    found = []
    for order in ((0, 1, 2), (2, 1, 0)) if planar else permutations(range(3)):
        for signs in product((1.0, -1.0), (1.0,) if planar else (1.0, -1.0), (1.0, -1.0)):
            axes = np.zeros((3, 3))
            axes[range(3), order] = signs
            proper = np.linalg.det(axes) > 0
            turned = np.array_equal(axes, np.diag(signs))
            if np.all(np.array(signs) < 0) or (turned and sum(v < 0 for v in signs) != 1 + proper):
                continue
            if not proper and not planar and not turned:
                continue
            names = [f"{'-' * (v < 0)}F_{'xyz'[k]}" for k, v in zip(order, signs, strict=True)]
            shown = [name for k, name in enumerate(names) if not (planar and k == 1)]
            what = "forces and torques" if proper and not planar else "forces"
            said = (
                f"{what} are given along other axes, so that {', '.join(shown)} are what is called"
            )
            said += " F_x, F_z" if planar else " F_x, F_y, F_z"
            found.append(
                Change("axes", said, "map them so; where - stands, change the sign of the column",
                       6.0 if proper else 7.0, _along(axes, bool(proper) and not planar))
            )  # fmt: skip
    return found


def _along(axes: Float[np.ndarray, "3 3"], torques: bool) -> Callable[[AtRest], AtRest]:
    def apply(rest: AtRest) -> AtRest:
        log = replace(rest.log, forces=rest.log.forces @ axes.T)
        if torques:
            log = replace(log, torques=log.torques @ axes.T)
        return replace(rest, log=log)

    return apply


def _of_units(log: Log) -> list[Change]:
    places = [p + a for p in ("", "u_") for a in "xyz"]
    forces, torques = ("F_x", "F_y", "F_z"), ("T_x", "T_y", "T_z", "tau")
    return [
        Change("length", "positions look like millimetres", _with_unit(log, places, "mm"),
               3.0, lambda rest: _stretched(rest, 1e-3)),
        Change("length", "the stiffness is 1000 times too large", "check --stiffness", 3.5,
               lambda rest: replace(rest, stiffness=rest.stiffness * [1e-3, 1e-3, 1.0]), True),
        Change("length", "the stiffness is in N/mm", "give --stiffness in N/m, 1000 times as much",
               3.5, lambda rest: replace(rest, stiffness=rest.stiffness * [1e3, 1e3, 1.0]), True),
        Change("unit of angles", "the stiffness about the angle is in N·m/deg",
               "give --stiffness in N·m/rad, 57.3 times as much", 5.0,
               lambda rest: replace(
                   rest, stiffness=rest.stiffness * [1.0, 1.0, 180 / math.pi]), True),
        Change("force", "forces are in millinewtons", _with_unit(log, forces, "mN"),
               4.0, lambda rest: _weighed(rest, (1e-3, 1.0))),
        Change("force", "forces and torques are in mN and mN·m",
               f"{_with_unit(log, forces, 'mN')}; {_with_unit(log, torques, 'mNm')}", 4.0,
               lambda rest: _weighed(rest, (1e-3, 1e-3))),
        Change("force", "torques are in N·mm", _with_unit(log, torques, "Nmm"), 4.0,
               lambda rest: _weighed(rest, (1.0, 1e-3))),
    ]  # fmt: skip


def factor_of_stiffness(
    stated: Float[np.ndarray, " 3"],
    factors: Float[np.ndarray, " 3"],
    errors: Float[np.ndarray, " 3"],
    cost: float,
) -> Change:
    """The stiffness that forces and torque show, `factors` times the stated one; 1 where it is."""
    found = stated * factors
    told = [
        f"{factors[k]:.3g} (± {errors[k]:.1g}) times it {where}"
        for k, where in enumerate(("along x", "along z", "about the angle's axis"))
        if factors[k] != 1.0
    ]
    given = " ".join(f"{value:.3g}" for value in found)
    return Change(
        "factor",
        f"the stiffness is not what was stated but {', '.join(told)} (or the sensor's gain is)",
        f"--stiffness {given} if that is the controller's, else divide the wrench by its gain",
        cost,
        lambda rest: replace(rest, stiffness=found),
        of_stiffness=True,
    )


def torque_about(rest: AtRest, point: Float[np.ndarray, " 3"]) -> AtRest:
    """What it is where torques are taken about another point of the end effector's frame [m]."""
    return _read(rest, point=tuple(float(value) for value in point))


def _read(rest: AtRest, **fields: object) -> AtRest:
    return replace(rest, wrench=replace(rest.wrench, **fields))  # pyright: ignore[reportArgumentType]


def _stretched(rest: AtRest, factor: float) -> AtRest:
    log = rest.log
    target = log.command_positions
    scaled = replace(
        log,
        positions=factor * log.positions,
        command_positions=None if target is None else factor * target,
    )
    return replace(rest, log=scaled)


def _weighed(rest: AtRest, factors: tuple[float, float]) -> AtRest:
    force, torque = factors
    log = replace(rest.log, forces=force * rest.log.forces, torques=torque * rest.log.torques)
    return replace(rest, log=log, scale=rest.scale * factors)


def _rotated(
    change: Callable[[RotationNumbers], RotationNumbers], which: Which
) -> Callable[[AtRest], AtRest]:
    return lambda rest: replace(rest, log=_with_rotations(rest.log, change, which))


def _with_rotations(
    log: Log, change: Callable[[RotationNumbers], RotationNumbers], which: Which
) -> Log:
    """The recording with other rotations of pose, set point or both."""
    numbers, turned = log.numbers, log.command_rotations
    if which != "command":
        new = change(_numbers(numbers, log.rotations))
        log = replace(log, numbers=new, rotations=new.rotations())
    if turned is None or which == "pose":
        return log
    if numbers is not None and log.command_numbers is None:
        # The set point has no rotation of its own: it is that of the start.
        kept = Rotation.from_quat(np.tile(log.rotations[:1].as_quat(), (len(log), 1)))
        return replace(log, command_rotations=kept)
    new = change(_numbers(log.command_numbers, turned))
    return replace(log, command_numbers=new, command_rotations=new.rotations())


def _numbers(numbers: RotationNumbers | None, rotations: Rotation) -> RotationNumbers:
    return RotationNumbers("quaternion", rotations.as_quat()) if numbers is None else numbers


def _wxyz(numbers: RotationNumbers) -> RotationNumbers:
    """Numbers taken for x, y, z, w that are w, x, y, z."""
    if numbers.kind != "quaternion":
        return numbers
    return replace(numbers, entries=numbers.entries[:, [1, 2, 3, 0]])


def _xyzw(numbers: RotationNumbers) -> RotationNumbers:
    """The same back."""
    return replace(numbers, entries=numbers.entries[:, [3, 0, 1, 2]])


def _inverse(numbers: RotationNumbers) -> RotationNumbers:
    if numbers.kind == "quaternion":
        return replace(numbers, entries=numbers.entries * [-1.0, -1.0, -1.0, 1.0])
    if numbers.kind == "Euler angles":
        turned = numbers.rotations().inv().as_quat()
        return RotationNumbers("quaternion", turned)
    return replace(numbers, entries=-numbers.entries)


def _about(axes: str) -> Callable[[RotationNumbers], RotationNumbers]:
    return lambda numbers: replace(numbers, euler=axes)


def _scaled(factor: float) -> Callable[[RotationNumbers], RotationNumbers]:
    return lambda numbers: replace(numbers, entries=factor * numbers.entries)


def _angles(log: Log) -> list[str]:
    names = ("rx", "ry", "rz", "e1", "e2", "e3", "phi")
    return [p + name for p in ("", "u_") for name in names]


def _with_unit(log: Log, names: Sequence[str], unit: str) -> str:
    """Entries of the map with another unit, for the columns that the recording was read from."""
    entries = [f"{n}={log.columns[n]}:{unit}" for n in names if n in log.columns]
    return f"--map {' '.join(entries)}" if entries else f"convert {', '.join(names)} from {unit}"


def _remapped(log: Log, prefix: str, order: Order) -> str:
    """The map of one quaternion in another order."""
    names = [prefix + name for name in ("qx", "qy", "qz", "qw")]
    columns = [log.columns.get(name, "") for name in names]
    if not all(columns):
        return f"correct the order where the {'set point' if prefix else 'pose'} is published"
    moved = columns[1:] + columns[:1] if order == "wxyz" else columns[-1:] + columns[:-1]
    pairs = zip(names, moved, strict=True)
    return "--map " + " ".join(f"{name}={column}" for name, column in pairs)
