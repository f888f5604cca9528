"""What an import found, in sentences for the person who decides whether to take it.

`findings` say what was done; `doubts` are what speaks against using it as it is, such as a wrench
that looks inverted, given in other axes, or a motion that is not planar.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tpcd.logs.log import Log
from tpcd.logs.plane import PlanarLog, Plane, WrenchReading, project
from tpcd.logs.settled import Settled

OUT_OF_PLANE_MOTION = 0.1
"""Motion out of the plane beyond this part of that within it is doubtful."""
OUT_OF_PLANE_FORCE = 0.2
"""The same of forces."""
CLEARER = 0.5
"""Another reading of the wrench is named where it leaves so little of what this one leaves."""
FELT = 1.0
"""Forces K (x - u) below this show nothing about the wrench [N]."""
MISSED = 0.5
"""A reading that leaves this part of K (x - u) or less fits it."""


@dataclass(frozen=True)
class Account:
    """Sentences on one import."""

    findings: tuple[str, ...]
    doubts: tuple[str, ...]


def left_out(planar: PlanarLog) -> Account:
    """How much motion and force the plane leaves out."""
    inside, outside = (
        np.ptp(planar.poses[:, :2], axis=0).max(),
        np.ptp(planar.motion_left_out[:, 0]),
    )
    swing = planar.motion_left_out[:, 1].max()
    force = np.abs(planar.wrench_left_out[:, 0]).max()
    torque = np.abs(planar.wrench_left_out[:, 1:]).max()
    held = np.linalg.norm(planar.wrenches[:, :2], axis=1).max()
    finding = (
        f"the plane leaves out {_told(1e3 * outside)} mm of motion (within it {1e3 * inside:.3g}"
        f" mm), {_told(math.degrees(swing))} degrees of rotation, {_told(force)} N of force (within"
        f" it {held:.3g} N) and {_told(torque)} N·m of torque"
    )
    doubts = []
    if outside > OUT_OF_PLANE_MOTION * inside:
        doubts.append("much of the motion is out of the plane: check --plane_x and --plane_z")
    if force > OUT_OF_PLANE_FORCE * held:
        doubts.append("much of the force is out of the plane: check the plane and --wrench_frame")
    return Account((finding,), tuple(doubts))


def compare_readings(
    log: Log,
    plane: Plane,
    wrench: WrenchReading,
    settled: Settled,
    stiffness: Float[np.ndarray, " 3"],
) -> Account:
    """Whether the forces at rest are K (x - u), or would be if they were read otherwise.

    Tries both signs, and world and tool axes, on the settled rows.
    """
    expected = spring_wrench(settled, stiffness)[:, :2]
    if settled.commands is None or not len(expected):
        return Account((), ())
    size = math.sqrt((expected**2).mean())
    if np.abs(expected).max() < FELT:
        return Account((), ("K (x - u) is nowhere more than 1 N: no contact is felt",))
    found: dict[tuple[str, float], float] = {}
    for frame in ("world", "tool"):
        if frame == "tool" and log.missing:
            continue
        for sign in (wrench.sign, -wrench.sign):
            reading = replace(wrench, frame=frame, sign=sign)
            forces = project(log, plane, reading).wrenches[:, :2]
            rows = np.stack([forces[first:end].mean(0) for first, end in settled.stretches])
            found[frame, sign] = math.sqrt(((rows - expected) ** 2).mean()) / size
    own = found[wrench.frame, wrench.sign]
    best = min(found, key=lambda reading: found[reading])
    finding = f"forces at rest differ from K (x - u) by {own:.0%} of its size"
    if own <= MISSED:
        return Account((finding,), ())
    if found[best] > CLEARER * own:
        return Account(
            (finding,),
            ("no sign or frame of the wrench fits K (x - u): check stiffness, plane and units",),
        )
    words = []
    if best[1] != wrench.sign:
        words.append("inverted (see --invert_wrench)")
    if best[0] != wrench.frame:
        words.append(f"given in {best[0]} axes (see --wrench_frame)")
    doubt = f"the wrench looks {' and '.join(words)}: then {found[best]:.0%} would be left"
    return Account((finding,), (doubt,))


def spring_wrench(settled: Settled, stiffness: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "k 3"]:
    """K (x - u) of the settled rows [N, N, N·m]; NaN where commands are unknown."""
    if settled.commands is None:
        return np.full((len(settled.rows), 3), np.nan)
    away = settled.rows[:, :3] - settled.commands
    away[:, 2] = np.remainder(away[:, 2] + math.pi, 2 * math.pi) - math.pi
    return stiffness * away


def _told(value: float) -> str:
    """A number for people; what is below any sensor is 0."""
    return f"{value:.2g}" if abs(value) > 1e-6 else "0"
