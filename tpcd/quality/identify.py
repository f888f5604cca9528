"""What a recording tells of arm and sensor without any model of contact.

Rests in several orientations weigh the load; whatever is touched, w = K (x - u) in equilibrium,
which shows stiffness, bias, friction, rotation and point of the sensor; and motion shows lags.
Nothing here assumes a plane: a planar recording is one with `missing` components.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tpcd.logs.log import Log
from tpcd.quality.blocks import block_edges, correlation_time
from tpcd.quality.impedance import LOADS, NAMES, PRESS, impedance
from tpcd.quality.parity import Parity, displacements
from tpcd.quality.payload import ORIENTATIONS, payload, weigh
from tpcd.quality.quantity import Quantity, untold
from tpcd.quality.rests import find_rests, observe, observe_rests
from tpcd.quality.springs import springs

CLEARER = 4.0
"""One frame is told by rests where the other leaves so many times more, in squares."""


def identify(log: Log, stiffness: Sequence[float] | None = None) -> tuple[Quantity, ...]:
    """Payload, biases, frame, stiffness, lags and friction, each with an interval or the reason
    why `log` does not tell it.

    `stiffness` is what the controller was given, along and about x, y, z
    [N/m, N/m, N/m, N·m/rad, N·m/rad, N·m/rad]; the gain of the sensor needs it. Samples that
    findings leave out are not used.
    """
    if stiffness is not None and len(stiffness) != 6:
        raise ValueError(f"stiffness has {len(stiffness)} numbers, expected six")
    sampled = springs(log)
    if sampled is None:
        return (*_from_rests(log), *_without_commands())
    parity, told = impedance(sampled, stiffness)
    load = _from_parity(parity, stiffness)
    by_name = {each.name: each for each in load}
    for each in told:
        before = by_name.get(each.name)
        if before is None or not before.told or (each.told and _width(each) < _width(before)):
            by_name[each.name] = each
    return tuple(by_name.values())


def _width(told: Quantity) -> float:
    return np.inf if told.interval is None else told.interval[1] - told.interval[0]


def _from_rests(log: Log) -> tuple[Quantity, ...]:
    """Payload from stretches in which the arm stood still, in the frame that fits them."""
    rests = find_rests(log)
    free = "if nothing was touched there"
    seen = {frame: observe_rests(log, rests, frame) for frame in ("tool", "world")}
    left = {frame: weigh(each) for frame, each in seen.items()}
    squares = {k: v.linear.squares / len(v.kept) for k, v in left.items() if v is not None}
    if len(squares) < 2:
        reason = "the arm does not rest in orientations that differ enough"
        frame = Quantity("wrench_frame", "", reason=reason, motion=ORIENTATIONS)
        return (frame, *payload(seen["tool"], free=free))
    best = min(squares, key=lambda each: squares[each])
    ratio = squares["world" if best == "tool" else "tool"] / max(squares[best], 1e-300)
    if ratio < CLEARER:
        reason = f"axes of world and tool fit the rests alike; taken as {best}"
        frame = Quantity("wrench_frame", "", reason=reason, motion=ORIENTATIONS)
    else:
        basis = f"the other leaves {ratio**0.5:.3g} times more of the force"
        frame = Quantity("wrench_frame", "", best, basis=basis)
    return (frame, *payload(seen[best], free=free))


def _from_parity(parity: Parity, stiffness: Sequence[float] | None) -> tuple[Quantity, ...]:
    """Payload from w - K (x - u), which holds none of what is touched, over blocks of time."""
    sampled = parity.springs
    log = sampled.log
    known = parity.stiffness(stiffness)
    left = []
    for letter, given, part in (("F", log.forces, known[:3]), ("T", log.torques, known[3:])):
        spring = displacements(sampled, letter, parity.axes) * part
        if parity.axes != parity.frame:
            spring = (
                sampled.in_world(spring, "tool")
                if parity.axes == "tool"
                else sampled.turned(spring, "tool")
            )
        left.append(given - spring)
    series = [column for part in left for column in part.T if np.ptp(column) > 0]
    time = max((correlation_time(column) for column in series), default=1.0)
    edges = np.append(block_edges(len(log), time), len(log))
    groups = [np.arange(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    seen = observe(log, groups, parity.frame, left[0], left[1])
    return payload(seen, "blocks of w - K (x - u)", "weight beyond what the springs carry")


def _without_commands() -> tuple[Quantity, ...]:
    reason, motion = "no set points were recorded", f"record the commands, and {PRESS}"
    names = [
        f"{kind}_{axis}" for kind in ("stiffness", "gain", "arm_friction") for axis in NAMES
    ]
    return (
        *untold([name for name in names if name[-2:-1] != "r" and "gain" not in name], "", reason, motion),
        *untold(("pose_lag", "wrench_lag"), "s", reason, motion),
        *untold([f"sensor_point_{axis}" for axis in "xyz"], "m", reason, LOADS),
    )
