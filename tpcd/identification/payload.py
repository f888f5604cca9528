"""Weight, biases, centre of mass, rotation and point of the sensor as quantities.

The equations are those of `load`; here is what their solution tells, and what it does not.
"""

from __future__ import annotations

import numpy as np

from tpcd.identification.load import FEWEST, Load, least_squares, skew, turning_axes, weigh
from tpcd.identification.quantity import Quantity, untold
from tpcd.identification.rests import Observed
from tpcd.logs.log import AXES

LEVER = 2e-3
"""What a lever is off by where it is told beside springs that turn: rotations of x to u, and of u
while x lags, add like vectors to first order only (1.3 mm in made recordings) [m]."""
USELESS = {"N": 1.0, "N·m": 0.1}
"""An interval that is wider, either way, than the value and this tells nothing."""
EXPLAINED = 0.7
"""A weight that explains less of what forces at rest change by is none, where more is left than
sensors are off by."""
UPWARDS = (
    "no weight along the world's z explains the forces at rest ({:.2g} N are left): z is not up,"
    " the rotations are not the sensor's, or something was touched"
)
PLANAR = "readings are planar"
HANGING = "what hangs on the sensor shows its centre of mass from that point, and not the point"
WEIGHTLESS = "the load's weight is not told apart from none"
TWISTED = "torques scatter too much beside what is pressed"
LEVERS = "a lever of the contact looks the same while no stiffness about the axes is told"
LOADS = "press along two directions that are not parallel, each at two loads, under the springs"
ORIENTATIONS = (
    "rest 10 s without contact in six orientations, so that each of the sensor's axes points up"
    " once and down once"
)


def payload(seen: Observed, basis: str = "", free: str = "") -> tuple[Quantity, ...]:
    """Weight, biases, centre of mass, rotation and point of the sensor, or why they are not told.

    `basis` says what the observations are, `free` what is taken for granted.
    """
    found = weigh(seen)
    if found is None or (seen.edges is None and not _explains(seen, found)):
        reason = _why(seen) if found is None else UPWARDS.format(found.linear.scatter)
        kinds = (("force_bias", "N"), ("torque_bias", "N·m"), ("centre_of_mass", "m"),
                 ("sensor_rotation", "rad"), ("sensor_point", "m"))  # fmt: skip
        told = untold(("weight",), "N", reason, ORIENTATIONS)
        for kind, unit in kinds:
            told += untold([f"{kind}_{axis}" for axis in AXES], unit, reason, ORIENTATIONS)
        return told
    left = len(seen) - len(found.kept)
    count = len(found.kept) if seen.edges is None else len(seen.edges)
    basis = f"{count} {basis or 'rests'}, left {found.linear.scatter:.2g} N" + (
        f", {left} left out that do not fit" if left else ""
    )
    told = _forces(seen, found, "; ".join(part for part in (basis, free) if part))
    return (*told, *_torques(seen, found, told[0]))


def _explains(seen: Observed, found: Load) -> bool:
    """Whether a weight along the world's z is what forces at rest change by, but for what sensors
    are off by."""
    forces = seen.forces[found.kept][:, list(found.axes)]
    changes = float(((forces - forces.mean(0)) ** 2).sum())
    small = found.linear.scatter <= USELESS["N"]
    return small or found.linear.squares < (1.0 - EXPLAINED) * changes


def _why(seen: Observed) -> str:
    if len(seen.force_axes) < 2:
        return "fewer than two components of the force were recorded"
    if len(seen) < FEWEST:
        count = f"{len(seen)} orientation{'' if len(seen) == 1 else 's'}"
        return f"the arm rests in {count}, and {FEWEST} are the least"
    return f"its orientations differ by {_spread(seen):.2g} degrees only"


def _spread(seen: Observed) -> float:
    """How far up turns in the axes of the end effector, at most, from its mean [degrees]."""
    mean = seen.up.mean(0)
    along = (
        seen.up @ mean / np.maximum(np.linalg.norm(mean) * np.linalg.norm(seen.up, axis=1), 1e-12)
    )
    return float(np.degrees(np.arccos(np.clip(along, -1, 1)).max()))


def _forces(seen: Observed, found: Load, basis: str) -> tuple[Quantity, ...]:
    linear, axes, at = found.linear, list(found.axes), len(found.axes)
    weight, unit = found.weight, np.eye(len(linear.value))
    wide = linear.half_width(unit[at])
    reason = f"orientations differ by {_spread(seen):.2g} degrees only, so weight and bias cannot"
    reason += " be told apart"
    aligned = "" if found.turned else ", its axes taken as the end effector's"
    known = f"{basis}{aligned}; times the sensor's gain, which a known weight would show"
    told = [_bounded("weight", "N", weight, wide, known)]
    if useless(told[0]):
        told = [Quantity("weight", "N", reason=reason, motion=ORIENTATIONS)]
    for k, axis in enumerate(AXES):
        name = f"force_bias_{axis}"
        if k not in axes:
            told += untold((name,), "N", f"F_{axis} was not recorded", "record it")
            continue
        value, half = float(linear.value[axes.index(k)]), linear.half_width(unit[axes.index(k)])
        bias = _bounded(name, "N", value, half, basis)
        if useless(bias):
            bias = Quantity(name, "N", reason=reason, motion=ORIENTATIONS)
        told.append(bias)
    turning, vector = turning_axes(axes), found.rotation.as_rotvec()
    for k, axis in enumerate(AXES):
        name = f"sensor_rotation_{axis}"
        if not found.turned:
            why = "the forces are too small, or differ too little, to show it to 15 degrees"
            told += untold((name,), "rad", why, ORIENTATIONS)
        elif k not in turning:
            told += untold((name,), "rad", PLANAR, "record all components")
        else:
            half = linear.half_width(unit[at + 1 + turning.index(k)])
            told.append(_bounded(name, "rad", float(vector[k]), half, basis))
    return tuple(told)


def useless(told: Quantity) -> bool:
    """Whether the interval of a force or torque holds so much that it tells nothing."""
    if told.interval is None or not isinstance(told.value, float) or told.unit not in USELESS:
        return False
    half = (told.interval[1] - told.interval[0]) / 2
    return half > max(abs(told.value), USELESS[told.unit])


def _bounded(name: str, unit: str, value: float, half: float, basis: str) -> Quantity:
    return Quantity(name, unit, value, (value - half, value + half), basis=basis)


def _torques(seen: Observed, found: Load, weight: Quantity) -> tuple[Quantity, ...]:
    """Torque bias, centre of mass and point of the sensor."""
    kinds = (("torque_bias", "N·m"), ("centre_of_mass", "m"), ("sensor_point", "m"))
    names = [(f"{kind}_{axis}", unit) for kind, unit in kinds for axis in AXES]
    axes = list(seen.torque_axes)
    pull = found.weight * found.rotation.apply(seen.up[found.kept])
    torques = seen.torques[found.kept]
    parts = [np.broadcast_to(np.eye(3), (len(pull), 3, 3)), -skew(pull)]
    if seen.pressed is not None and seen.twisted is not None:
        parts.append(skew(found.rotation.apply(seen.pressed[found.kept])))
        torques = torques - found.rotation.apply(seen.twisted[found.kept])
    design = np.concatenate(parts, axis=2)[:, axes]
    loaded = weight.interval is not None and weight.interval[0] * weight.interval[1] > 0
    if weight.told and not loaded:
        # No load, no moment.
        design[..., 3:6] = 0.0
    # In a planar recording the parts out of the plane turn nothing.
    free = [k for k in range(design.shape[2]) if axes and np.abs(design[..., k]).max() > 0]
    linear = least_squares(design[..., free], torques[:, axes], seen.edges) if free else None
    relative = 0.0
    if weight.interval is not None and found.weight:
        relative = (weight.interval[1] - weight.interval[0]) / 2 / abs(found.weight)
    told: list[Quantity] = []
    for k, (name, unit) in enumerate(names):
        if not axes:
            told.append(
                Quantity(name, unit, reason="torques were not recorded", motion="record them")
            )
        elif k >= 6 and len(parts) < 3:
            reason = HANGING if seen.pressed is None else LEVERS
            told.append(Quantity(name, unit, reason=reason, motion=LOADS))
        elif weight.told and not loaded and 3 <= k < 6:
            told.append(Quantity(name, unit, reason=WEIGHTLESS, motion=ORIENTATIONS))
        elif k not in free:
            told.append(Quantity(name, unit, reason=PLANAR, motion="record all components"))
        elif linear is None or not weight.told:
            reason = f"orientations differ by {_spread(seen):.2g} degrees only"
            told.append(Quantity(name, unit, reason=reason, motion=ORIENTATIONS))
        else:
            at = free.index(k)
            value, half = float(linear.value[at]), linear.half_width(np.eye(len(free))[at])
            basis = f"left {linear.scatter:.2g} N·m"
            if 3 <= k < 6:
                half = float(np.hypot(half, relative * value))
                half = float(np.hypot(half, 0.0 if seen.twisted is None else LEVER))
                basis += "; from the point that torques are about, in the sensor's axes"
            found_here = _bounded(name, unit, value, half, basis)
            if useless(found_here):
                found_here = Quantity(name, unit, reason=TWISTED, motion=ORIENTATIONS)
            told.append(found_here)
    return tuple(told)
