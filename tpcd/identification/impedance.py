"""Stiffness, friction, lag and frames of an arm under impedance control, as quantities.

All of it comes from w beside K (x - u), which needs no model of what is touched. A gain of the
sensor and an error of the stiffness look alike: only their product is told.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tpcd.identification.blocks import Estimate
from tpcd.identification.lags import pose_lag, wrench_lag
from tpcd.identification.parity import Axis, Parity, choose_frames, displacements, readings
from tpcd.identification.quantity import Quantity, untold
from tpcd.identification.springs import Springs

NAMES = ("x", "y", "z", "rx", "ry", "rz")
UNITS = ("N", "N·m")
EXACT = 1e-9
"""A part of the wrench's variance that no sensor's noise is below; written digits are."""
WIDEST = 10.0
"""Ends of a stiffness that are further apart, in ratio, tell nothing."""
CLOSE = 1.5
"""Ends of a stiffness that are further apart, in ratio, leave more to be done."""
PRESS = "press along the axis at three loads, both ways, the largest ten times what friction holds"
TWIST = "turn about the axis against something fixed, at three loads, both ways"
TILT = "turn the end effector by 45 degrees about two axes, pressing before and after"


def impedance(
    springs: Springs, stiffness: Sequence[float] | None
) -> tuple[Parity, tuple[Quantity, ...]]:
    """The parity fit in the frames that fit best, and what it tells."""
    parity, frame_told, axes_told = choose_frames(springs)
    if computed(parity):
        return parity, _computed(parity)
    told = [*_frames(parity, frame_told, axes_told), _sign(parity)]
    told += [_stiffness(parity, k) for k in range(6)]
    told += [_gain(parity, k, stiffness) for k in range(6)]
    told += [_between(parity, k, "zero") for k in range(6)]
    told += [_between(parity, k, "friction") for k in range(6)]
    told += [pose_lag(parity), wrench_lag(parity)]
    return parity, tuple(told)


def computed(parity: Parity) -> bool:
    """Whether the wrench is K (x - u) to the last digits in every axis: no sensor reads so."""
    slopes = _slopes(parity)
    return bool(slopes) and all(explained > 1 - EXACT for _, explained in slopes.values())


def _slopes(parity: Parity) -> dict[str, tuple[float, float]]:
    """Of each axis that changes, the slope of w over x - u and the part of w that it explains."""
    springs, found = parity.springs, {}
    for name in NAMES:
        letter, k = "T" if name.startswith("r") else "F", "xyz".index(name[-1])
        if k not in springs.axes(letter):
            continue
        wrench = readings(springs, letter, parity.frame, parity.frame)[:, k]
        away = displacements(springs, letter, parity.frame)[:, k]
        wrench, away = wrench - wrench.mean(), away - away.mean()
        both, own, other = wrench @ away, wrench @ wrench, away @ away
        if own > 0 and other > 0:
            found[name] = both / other, both**2 / (own * other)
    return found


def _computed(parity: Parity) -> tuple[Quantity, ...]:
    """What a wrench tells that was computed from the pose: the stiffness that it was computed with,
    and nothing of sensor or friction."""
    basis = "w is K (x - u) to the last digits, so no sensor's noise is in it"
    told = [Quantity("wrench_source", "", "computed from x - u, not measured", basis=basis)]
    slopes = _slopes(parity)
    for k, axis in enumerate(NAMES):
        name, unit = f"stiffness_{axis}", "N/m" if k < 3 else "N·m/rad"
        if axis in slopes:
            told.append(Quantity(name, unit, slopes[axis][0], basis="what w was made with"))
        else:
            told.append(Quantity(name, unit, reason=_missing(parity, k)))
    reason, motion = "the wrench was computed from x - u", "record a force sensor beside it"
    for kind, units in (("gain", ("", "")), ("parity_zero", UNITS), ("arm_friction", UNITS)):
        for k, axis in enumerate(NAMES):
            told += untold((f"{kind}_{axis}",), units[k // 3], reason, motion)
    told += [pose_lag(parity), *untold(("wrench_lag",), "s", reason, motion)]
    return tuple(told)


def _frames(parity: Parity, frame: bool, axes: bool) -> list[Quantity]:
    turned = f"the end effector turned by {np.degrees(parity.springs.spread):.2g} degrees at most"
    found = []
    for name, value, told in (
        ("wrench_frame", parity.frame, frame),
        ("stiffness_frame", parity.axes, axes),
    ):
        if told:
            basis = "leaves least of w - K (x - u), in blocks throughout"
            found.append(Quantity(name, "", value, basis=basis))
        else:
            reason = f"axes of world and tool fit alike ({turned}); taken as {value}"
            found.append(Quantity(name, "", reason=reason, motion=TILT))
    return found


def _sign(parity: Parity) -> Quantity:
    found = [np.sign(float(axis.low.value)) for axis in parity.told if axis.told]
    reason = "the wrench goes with x - u in no axis"
    if found and len(set(found)) > 1:
        reason = "it differs from axis to axis: check the map of columns and the frames"
    elif found:
        words = "of the world on the arm" if found[0] > 0 else "inverted: of the arm on the world"
        return Quantity("wrench_sign", "", words, basis=f"{len(found)} axes agree")
    return Quantity("wrench_sign", "", reason=reason, motion=PRESS)


def _axis(parity: Parity, k: int) -> Axis | None:
    return next((axis for axis in parity.told if axis.name == NAMES[k]), None)


def _missing(parity: Parity, k: int) -> str:
    letter = "FT"[k // 3]
    if k % 3 in parity.springs.axes(letter):
        return "x - u or the wrench never changes along it"
    return "set point or wrench was not recorded along it"


def _unexplained(axis: Axis) -> str:
    return (
        f"x - u explains {axis.explained:.0%} of the wrench along it, no more than friction and"
        " drift could"
    )


def _stiffness(parity: Parity, k: int) -> Quantity:
    name, unit = f"stiffness_{NAMES[k]}", "N/m" if k < 3 else "N·m/rad"
    motion, axis = PRESS if k < 3 else TWIST, _axis(parity, k)
    if axis is None:
        return Quantity(name, unit, reason=_missing(parity, k), motion=motion)
    if not axis.told:
        return Quantity(name, unit, reason=_unexplained(axis), motion=motion)
    sign = np.sign(float(axis.low.value))
    low, high = sorted(float(sign * end) for end in axis.interval)
    if high > WIDEST * low:
        return Quantity(name, unit, reason=_unexplained(axis), motion=motion)
    basis = (
        f"w against x - u in {parity.axes} axes, which explains {axis.explained:.0%}; times the"
        " sensor's gain, which these data cannot tell apart"
    )
    wide = motion if high > CLOSE * low else ""
    return Quantity(name, unit, abs(axis.stiffness), (low, high), basis=basis, motion=wide)


def _gain(parity: Parity, k: int, stiffness: Sequence[float] | None) -> Quantity:
    name, motion = f"gain_{NAMES[k]}", PRESS if k < 3 else TWIST
    if stiffness is None or not np.isfinite(stiffness[k]):
        reason = "gain and stiffness are known by their product only, and no stiffness was given"
        return Quantity(name, "", reason=reason, motion="give the controller's stiffness")
    found = _stiffness(parity, k)
    if found.interval is None or not isinstance(found.value, float):
        return Quantity(name, "", reason=found.reason, motion=motion)
    low, high = (end / stiffness[k] for end in found.interval)
    basis = "if the stiffness is as given; its error looks the same"
    return Quantity(
        name, "", found.value / stiffness[k], (low, high), basis=basis, motion=found.motion
    )


def _between(parity: Parity, k: int, kind: str) -> Quantity:
    """What is left with either end of the stiffness: the interval holds both."""
    unit = "N" if k < 3 else "N·m"
    name = f"{'parity_zero' if kind == 'zero' else 'arm_friction'}_{NAMES[k]}"
    motion, axis = PRESS if k < 3 else TWIST, _axis(parity, k)
    if axis is None:
        return Quantity(name, unit, reason=_missing(parity, k), motion=motion)
    if not _stiffness(parity, k).told:
        return Quantity(name, unit, reason=_unexplained(axis), motion=motion)
    ends: tuple[Estimate, Estimate] = axis.zero if kind == "zero" else axis.friction
    bounds = [float(v) for end in ends for v in end.bounds()]
    sign = 1.0 if kind == "zero" else np.sign(float(axis.low.value))
    low, high = sorted((sign * min(bounds), sign * max(bounds)))
    value = float(sign * np.mean([float(end.value) for end in ends]))
    if kind == "zero":
        basis = f"w where x = u, in {parity.axes} axes: bias and what the load weighs together"
    else:
        dead = abs(value) / abs(axis.stiffness)
        short = f"{1e3 * dead:.2g} mm" if k < 3 else f"{np.degrees(dead):.2g} degrees"
        basis = f"part of w - K (x - u) that has the sign of the last motion: stops {short} short"
    return Quantity(name, unit, value, (low, high), basis=basis)
