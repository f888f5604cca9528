"""Which columns of a table look by their names like what: a map to begin with.

A name is cut into words where letters change their case, at digits and at signs; units in brackets
do not count. `TCP_Pos_X [mm]`, `wrench.force.x` and `desired_pose_x` are told apart by the words
for set points, for forces and torques, and by the last letter.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

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
"""A topic or column whose name has one of these is taken for the set point."""
_KINDS = {
    "force": ("F_{}", ("force", "forces", "f", "frc")),
    "torque": ("T_{}", ("torque", "torques", "t", "m", "moment", "trq")),
    "turn": ("q{}", ("q", "quat", "quaternion", "orientation", "rot", "rotation")),
}
_TIME = ("time", "timestamp", "stamp", "t", "seconds", "secs", "sec")


def suggest_map(names: Iterable[str]) -> list[str]:
    """Entries NAME=COLUMN for the columns whose names tell what they are, none twice."""
    found: dict[str, str] = {}
    for column in names:
        name = _guess(column)
        if name and name not in found:
            found[name] = column
    return [f"'{name}={column}'" if " " in column else f"{name}={column}"
            for name, column in found.items()]  # fmt: skip


def _guess(column: str) -> str:
    bare = re.sub(r"[\[(].*?[\])]", "", column)
    words = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", bare)
    words = [word.lower() for word in words]
    joined = "_".join(words)
    if not words:
        return ""
    if words[-1] in _TIME and len(words) <= 2:
        return "time"
    command = "u_" if words[0] == "u" or any(word in joined for word in COMMAND_WORDS) else ""
    axis = words[-1][-1] if words[-1][-1] in "xyzw" and len(words[-1]) <= 2 else ""
    if not axis:
        return ""
    kinds = [*words[:-1], words[-1][:-1]]
    for kind, (form, known) in _KINDS.items():
        if any(word in known for word in kinds):
            if axis == "w" and kind != "turn":
                return ""
            if command and kind != "turn":
                return ""  # a force that is asked for is no reading
            return command + form.format(axis)
    return "" if axis == "w" or words[-1][:-1] not in ("", "p", "d", "u") else command + axis
