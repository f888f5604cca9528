"""What the name of a column says of it: which entry of a column map, and in which unit."""

from __future__ import annotations

import re
from dataclasses import dataclass


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


COMMAND = _set(
    "command commanded commands cmd target targets desired des goal setpoint reference ref"
    " equilibrium attractor u"
)
OTHER = _set(
    "velocity velocities vel v twist speed acceleration acc accel joint joints stiffness damping"
    " rot_k temperature temp current currents voltage gripper error err std cov covariance jacobian"
    " motor raw jerk"
)
"""Words of columns that are none of these, unless a word of a place says so beside `current`."""
FORCE = _set("force forces frc f")
TORQUE = _set("torque torques trq moment moments mom t m")
WRENCH = _set("wrench wrenches ft loadcell")
PLACE = _set("position positions pos p tcp pose poses ee eef cartesian translation")
TURNED = _set("orientation ori quaternion quat q rotation rot")
VECTOR = _set("rotvec r rv axisangle")
EULER = _set("euler rpy")
TIMES = _set("time times timestamp timestamps stamp t sec secs seconds clock ms ns us")
MEASURED = _set("actual measured current tcp state ee")
_UNITS = {
    **{n: n for n in _set("m cm mm um in rad mrad deg N mN kN Nm mNm Nmm Ncm s ms us ns")},
    "nm": "Nm", "n": "N", "°": "deg", "degree": "deg", "degrees": "deg", "radians": "rad",
    "sec": "s", "seconds": "s", "msec": "ms", "newton": "N", "meter": "m", "metre": "m",
}  # fmt: skip
_FITTING = {
    "time": ("s", "ms", "us", "ns"),
    "length": ("m", "cm", "mm", "um", "in"),
    "angle": ("rad", "mrad", "deg"),
    "force": ("N", "mN", "kN"),
    "torque": ("Nm", "mNm", "Nmm", "Ncm"),
    "number": (),
}


@dataclass(frozen=True)
class Meaning:
    """What one column looks like."""

    name: str
    """Of the column map: x, qw, F_z, u_x, time, …"""
    column: str
    unit: str
    """As the name says; empty where it says nothing."""
    sure: int
    """Of two columns for one name the larger wins."""
    whole: bool = False
    """Its other words are of a whole pose or wrench rather than of a force or a position."""


def meaning(column: str) -> Meaning | None:
    """What a column's name says it is; None where it says nothing known."""
    text, unit = _without_unit(column)
    words = _words(text)
    if not words:
        return None
    if (
        len(words) <= 3
        and words[-1] in TIMES
        and not (set(words) & (FORCE | WRENCH | TORQUE - {"t"}))
    ):
        return Meaning("time", column, _fitting(unit or _named_unit(words[-1]), "time"), 2)
    axis, rest = _axis(words)
    others = set(rest)
    commanded = bool(others & COMMAND)
    placed = bool(others & (PLACE | TURNED | VECTOR))
    if others & (OTHER - ({"current"} if placed else set())):
        return None
    sure = 2 * bool(others & MEASURED) - len(rest)
    prefix = "u_" if commanded else ""
    whole = bool(others & ({"pose", "poses", "tcp", "ee", "eef"} | WRENCH))
    if text in ("A", "B", "C"):  # of KUKA's A-B-C angles, beside X, Y, Z
        return Meaning(f"e{'ABC'.index(text) + 1}", column, _fitting(unit, "angle"), -1)
    if words[-1] in ("phi", "roll", "pitch", "yaw"):
        name = {"phi": "phi", "yaw": "e1", "pitch": "e2", "roll": "e3"}[words[-1]]
        return Meaning(prefix + name, column, _fitting(unit, "angle"), sure)
    if words[-1] == "tau":
        return Meaning("tau", column, _fitting(unit, "torque"), sure)
    if axis is None:
        return None
    kinds = others - COMMAND
    if kinds & (FORCE | WRENCH) and axis in "xyz" and not kinds & TORQUE:
        return Meaning(f"F_{axis}", column, _fitting(unit, "force"), sure, whole)
    if kinds & TORQUE and axis in "xyz":
        return Meaning(f"T_{axis}", column, _fitting(unit, "torque"), sure)
    if kinds & TURNED or axis == "w":
        return Meaning(f"{prefix}q{axis}", column, "", sure)
    if kinds & VECTOR and axis in "xyz":
        return Meaning(f"{prefix}r{axis}", column, _fitting(unit, "angle"), sure)
    if kinds & EULER and axis in "xyz":
        # Of roll, pitch, yaw, turned in the order z, y, x.
        return Meaning(f"{prefix}e{'zyx'.index(axis) + 1}", column, _fitting(unit, "angle"), sure)
    if kinds & PLACE or not kinds or not kinds - MEASURED:
        return Meaning(
            f"{prefix}{axis}", column, _fitting(unit, "length"), sure, whole or not kinds
        )
    return None


def _axis(words: list[str]) -> tuple[str | None, list[str]]:
    """The axis that the last word ends with, and the words besides."""
    last = words[-1]
    if last in ("x", "y", "z", "w"):
        return last, words[:-1]
    if len(last) == 2 and last[1] in "xyzw" and last[0] in "ftmqrupv":
        return last[1], [*words[:-1], last[0]]
    match = re.fullmatch(r"(force|torque|pos|quat|q|tcp)([xyzw])", last)
    if match:
        return match[2], [*words[:-1], match[1]]
    return None, words


def _without_unit(column: str) -> tuple[str, str]:
    """The name without a unit in brackets or after its last blank or underscore."""
    match = re.fullmatch(r"(.*?)\s*[\[({<]\s*([^\])}>]*?)\s*[\])}>]\s*", column)
    if match:
        return match[1], _named_unit(match[2])
    match = re.fullmatch(
        r"(.+)[ _/](mm|cm|um|deg|rad|mrad|mN|kN|Nm|mNm|Nmm|Ncm|N|ms|us|ns|s|m)", column
    )
    if match and match[1].strip():
        return match[1], match[2]
    return column, ""


def _named_unit(text: str) -> str:
    plain = (
        text.replace("·", "").replace("*", "").replace("⋅", "").replace(".", "").replace(" ", "")
    )
    return _UNITS.get(plain, _UNITS.get(plain.lower(), ""))


def _fitting(unit: str, kind: str) -> str:
    """The unit where it can be one of that kind."""
    return unit if unit in _FITTING[kind] else ""


def _words(text: str) -> list[str]:
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", text)
    return [part.lower() for part in parts]
