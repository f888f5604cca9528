"""What a recording tells of arm and sensor without any model of contact.

Rests in several orientations weigh the load; whatever is touched, w = K (x - u) in equilibrium,
which shows stiffness, bias, friction, rotation and point of the sensor; and motion shows lags.
Nothing here assumes a plane: a planar recording is one with `missing` components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tpcd.identification.blocks import block_edges, correlation_time
from tpcd.identification.impedance import NAMES, PRESS, computed, impedance
from tpcd.identification.load import weigh
from tpcd.identification.parity import Parity, spring_wrench
from tpcd.identification.payload import ORIENTATIONS, payload, useless
from tpcd.identification.quantity import Quantity, quantity, untold
from tpcd.identification.rests import UP, Observed, find_rests, observe_rests, recorded_axes
from tpcd.identification.springs import springs
from tpcd.logs.log import AXES, Log

CLEARER = 4.0
"""One frame is told by rests where the other leaves so many times more, in squares."""


def identify(log: Log, stiffness: Sequence[float] | None = None) -> tuple[Quantity, ...]:
    """Payload, biases, frame, stiffness, lags and friction, each with an interval or the reason
    why `log` does not tell it.

    `stiffness` is what the controller was given, along and about x, y, z
    [N/m, N/m, N/m, N·m/rad, N·m/rad, N·m/rad], or in x, z and phi of a plane; the gain of the
    sensor needs it. Samples that findings leave out are not used.
    """
    if stiffness is not None and len(stiffness) == 3:
        x, z, phi = stiffness
        stiffness = (x, np.nan, z, np.nan, phi, np.nan)
    if stiffness is not None and len(stiffness) != 6:
        raise ValueError(
            f"stiffness has {len(stiffness)} numbers, expected six (or three: x, z, phi)"
        )
    sampled = springs(log)
    if sampled is None:
        return (*_from_rests(log), *_without_commands())
    parity, told = impedance(sampled, stiffness)
    if computed(parity):
        return told
    if (late := _late(told)) is not None:
        # What comes late turns round late, as friction does.
        log = _earlier(log, late)
        sampled = springs(log)
        assert sampled is not None
        parity, again = impedance(sampled, stiffness)
        told = _with_lag(again, told)
    load = _from_parity(parity, stiffness)
    turn = _sensor_turn(load)
    if turn is not None:
        # A turned sensor reads less than the whole force along an axis, by the square of the turn.
        straight = springs(_unturned(log, parity.frame, turn))
        assert straight is not None
        _, again = impedance(straight, stiffness)
        told = again if late is None else _with_lag(again, told)
    return (*told, *load)


def _late(told: Sequence[Quantity]) -> float | None:
    """By how much the wrench is late, where that is told apart from none [s]; damping of the arm
    looks like one that is early."""
    lag = quantity(told, "wrench_lag")
    if lag.interval is None or not isinstance(lag.value, float) or lag.interval[0] <= 0.0:
        return None
    return lag.value


def _earlier(log: Log, by: float) -> Log:
    """The recording with the wrench taken earlier [s], where it is there."""
    kept = log.only(log.times + by <= log.times[-1])

    def moved(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
        columns = [np.interp(kept.times + by, log.times, column) for column in values.T]
        return np.stack(columns, axis=1)

    return replace(kept, forces=moved(log.forces), torques=moved(log.torques))


def _with_lag(again: Sequence[Quantity], before: Sequence[Quantity]) -> tuple[Quantity, ...]:
    """What is told once a lag is taken away, and the lag."""
    lag = quantity(before, "wrench_lag")
    return tuple(lag if each.name == "wrench_lag" else each for each in again)


def _sensor_turn(load: Sequence[Quantity]) -> Rotation | None:
    """Rotation of the sensor where it is told in all axes, and is told apart from none."""
    found = [quantity(load, f"sensor_rotation_{axis}") for axis in AXES]
    values = [each.value for each in found if isinstance(each.value, float)]
    intervals = [each.interval for each in found if each.interval is not None]
    if len(values) < 3 or all(low <= 0.0 <= high for low, high in intervals):
        return None
    return Rotation.from_rotvec(values)


def _unturned(log: Log, frame: str, turn: Rotation) -> Log:
    """The recording with the wrench as a sensor along the end effector's axes would read it."""
    back = turn.inv()
    if frame == "world":
        back = log.rotations * back * log.rotations.inv()
    return replace(log, forces=back.apply(log.forces), torques=back.apply(log.torques))


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
    """Payload, bias, rotation and point of the sensor from what it reads besides K (x - u), which
    is all that the world presses with. Intervals hold those of both ends of the stiffness."""
    found = parity.stiffness()
    known = found[0] != 0
    if stiffness is not None:
        # Times the gain, as the sensor reads it, is what the data tell.
        given = parity.sign * np.nan_to_num(np.array(stiffness, dtype=float))
        found = tuple(np.where(known, each, given) for each in found)
        known = known | (given != 0)
    tables = []
    for each in found:
        seen = _beside_springs(parity, each, bool(known[3:].all()))
        tables.append(payload(seen, "blocks of time", "weight beyond what the springs carry"))
    return tuple(_hull(same) for same in zip(*tables, strict=True))


def _beside_springs(parity: Parity, stiffness: Float[np.ndarray, " 6"], torques: bool) -> Observed:
    """Every sample, with K (x - u) as what is pressed; torques' part only where it is known."""
    sampled = parity.springs
    log = sampled.log

    def in_tool(vectors: Float[np.ndarray, "n 3"], frame: str) -> Float[np.ndarray, "n 3"]:
        return vectors if frame == "tool" else sampled.turned(vectors, "tool")

    pressed, twisted = (
        in_tool(spring_wrench(parity, letter, part), parity.axes)
        for letter, part in (("F", stiffness[:3]), ("T", stiffness[3:]))
    )
    forces, torque = in_tool(log.forces, parity.frame), in_tool(log.torques, parity.frame)
    left = [column for column in (forces - pressed).T if np.ptp(column) > 0]
    time = max((correlation_time(column) for column in left), default=1.0)
    return Observed(
        in_tool(np.broadcast_to(UP, forces.shape), "world"),
        forces,
        torque,
        log.times,
        recorded_axes(log, "F"),
        recorded_axes(log, "T"),
        pressed,
        twisted if torques else None,
        block_edges(len(log), time),
    )


def _hull(same: Sequence[Quantity]) -> Quantity:
    """The first, with an interval as wide about every other value as about its own: what is left
    at an end of the stiffness is no noise, but what wrong springs leave. Of a rotation it holds all
    intervals: friction and damping, which are as they fit best, turn what is pressed with too."""
    untold_ones = [each for each in same if not each.told]
    if untold_ones:
        return untold_ones[0]
    found = same[0]
    if found.interval is not None and isinstance(found.value, float):
        own = [end - found.value for end in found.interval]
        ends = [float(each.value) + end for each in same for end in own]  # pyright: ignore
        if found.name.startswith("sensor_rotation"):
            ends += [end for each in same for end in each.interval or ()]
        found = replace(found, interval=(min(ends), max(ends)))
    if not useless(found):
        return found
    reason = "the stiffness is known too roughly for what is left beside it"
    return replace(found, value=None, interval=None, basis="", reason=reason, motion=ORIENTATIONS)


def _without_commands() -> tuple[Quantity, ...]:
    reason, motion = "no set points were recorded", f"record the commands, and {PRESS}"
    told = [
        Quantity(f"{kind}_{axis}", units[len(axis) - 1], reason=reason, motion=motion)
        for kind, units in (("stiffness", ("N/m", "N·m/rad")), ("arm_friction", ("N", "N·m")))
        for axis in NAMES
    ]
    return (*told, *untold(("pose_lag", "wrench_lag"), "s", reason, motion))
