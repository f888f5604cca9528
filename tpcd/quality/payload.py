"""What the sensor carries and reads at zero, from readings in several orientations.

In axes of the end effector the sensor reads, with nothing touched,

    F = b_F + W S up,    T = b_T + c x (W S up),

where up is against gravity, W < 0 the load's weight, S the rotation that turns axes of the end
effector into the sensor's, c the load's centre of mass from the point that torques are about.
Linear in b_F, W, and d = W rho for a small rotation rho of S beyond what is known of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution
from scipy.stats import t as student

from tpcd.logs.log import AXES
from tpcd.quality.quantity import LEVEL, Quantity, untold
from tpcd.quality.rests import Observed

FEWEST = 4
"""Orientations below which nothing is left to learn the error from."""
ALIGNED = np.radians(15.0)
"""A rotation of the sensor that would be known no better than this is taken as none [rad]."""
OUTLIER = 1e-3
"""Probability, over all rests, below which one that fits worst is left out as disturbed."""
TURNS = 20
"""Rounds in which a large rotation of the sensor is approached."""
USELESS = 1.0
"""An interval of weight that is wider, either way, than this part of it and of a newton tells
nothing."""
ORIENTATIONS = (
    "rest 10 s without contact in six orientations, so that each of the sensor's axes points up"
    " once and down once"
)


@dataclass(frozen=True, eq=False)
class Linear:
    """A least-squares fit whose observations each hold several components."""

    value: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    freedom: int
    """Of Student's t: components of one observation may share an error, so observations count."""
    scatter: float
    """Root mean square of what is left, for each degree of freedom."""
    squares: float

    def half_width(self, direction: Float[np.ndarray, " p"], level: float = LEVEL) -> float:
        """Half the interval of a combination of the values."""
        variance = float(direction @ self.covariance @ direction)
        return float(student.ppf(0.5 + level / 2, self.freedom)) * variance**0.5


def fit(design: Float[np.ndarray, "r k p"], readings: Float[np.ndarray, "r k"]) -> Linear | None:
    """Least squares over r observations of k components; None where some combination of the
    parameters has no effect, or no observation is left to learn the error from."""
    observations, components, count = design.shape
    flat, target = design.reshape(-1, count), readings.ravel()
    freedom = observations - -(-count // components)
    if freedom < 1:
        return None
    scale = np.linalg.norm(flat, axis=0)
    if (scale == 0).any() or np.linalg.cond(flat / scale) > 1e8:
        return None
    inverse = np.linalg.inv((flat / scale).T @ (flat / scale)) / np.outer(scale, scale)
    value = inverse @ flat.T @ target
    left = target - flat @ value
    squares = float(left @ left)
    variance = squares / (len(target) - count)
    return Linear(value, variance * inverse, freedom, variance**0.5, squares)


@dataclass(frozen=True, eq=False)
class Load:
    """A fit of the forces."""

    linear: Linear
    """b_F, W, and W times the remaining rotation where `turned`."""
    rotation: Rotation
    """S, as far as it is known."""
    turned: bool
    kept: np.ndarray
    """The observations that count."""
    up: Float[np.ndarray, "r 3"]
    """In the sensor's axes, of those."""


def weigh(seen: Observed) -> Load | None:
    """Bias, weight and rotation of the sensor from forces; None where orientations are too few.

    Observations that do not fit, as where something was touched, are left out one by one, the
    worst first, a quarter of them at most.
    """
    if len(seen.force_axes) < 2 or len(seen) < FEWEST:
        return None
    kept = np.arange(len(seen))
    for _ in range(len(seen) // 4 + 1):
        found = _load(seen, kept)
        if found is None:
            return None
        worst = _worst(seen, found)
        if worst is None:
            break
        kept = np.delete(kept, worst)
    return found


def _load(seen: Observed, kept: np.ndarray) -> Load | None:
    axes = list(seen.force_axes)
    up, forces = seen.up[kept], seen.forces[kept][:, axes]
    rotation = _first_rotation(up, forces) if len(axes) == 3 else Rotation.identity()
    for turned in (True, False):
        known = rotation if turned else Rotation.identity()
        linear = None
        for _ in range(TURNS):
            linear = fit(_design(known.apply(up), axes, turned), forces)
            if linear is None or not turned or linear.value[len(axes)] == 0:
                break
            rest = _turn(linear.value, axes)
            if np.linalg.norm(rest) < 1e-9:
                break
            known = Rotation.from_rotvec(rest) * known
        if linear is None:
            continue
        wide = [linear.half_width(row) for row in np.eye(len(linear.value))[len(axes) + 1 :]]
        weight = abs(linear.value[len(axes)])
        if turned and (not weight or max(wide) > ALIGNED * weight):
            continue
        return Load(linear, known, turned, kept, known.apply(up))
    return None


def _first_rotation(up: np.ndarray, forces: np.ndarray) -> Rotation:
    """Where a large rotation is looked for from: F - mean against up - mean (Kabsch 1976)."""
    spread = (up - up.mean(0)).T @ (forces - forces.mean(0))
    left, size, right = np.linalg.svd(spread)
    if size[1] < 1e-3 * max(size[0], 1e-12):
        return Rotation.identity()
    best, least = Rotation.identity(), np.inf
    for sign in (1.0, -1.0):
        turn = right.T @ np.diag([1.0, 1.0, sign * np.linalg.det(right.T @ left.T)]) @ left.T
        turned = Rotation.from_matrix(sign * turn)
        found = fit(_design(turned.apply(up), [0, 1, 2], False), forces)
        # A load weighs down: of a rotation and its mirror image, the one with W < 0.
        if found is not None and found.value[3] < 0 and found.squares < least:
            best, least = turned, found.squares
    return best


def _design(up: np.ndarray, axes: list[int], turned: bool) -> np.ndarray:
    parts = [np.broadcast_to(np.eye(3), (len(up), 3, 3))[:, :, axes], up[:, :, None]]
    if turned:
        crossed = -skew(up)
        parts.append(crossed if len(axes) == 3 else crossed[:, :, _turning(axes)])
    return np.concatenate(parts, axis=2)[:, axes]


def _turning(axes: list[int]) -> list[int]:
    """The axis about which components stay among `axes`."""
    return [k for k in range(3) if k not in axes]


def _turn(value: np.ndarray, axes: list[int]) -> np.ndarray:
    """The remaining rotation vector, as a part of what was fitted."""
    rest = np.zeros(3)
    rest[[0, 1, 2] if len(axes) == 3 else _turning(axes)] = value[len(axes) + 1 :]
    return rest / value[len(axes)]


def skew(vectors: Float[np.ndarray, "r 3"]) -> Float[np.ndarray, "r 3 3"]:
    """Matrices that take a to v x a."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def _worst(seen: Observed, found: Load) -> int | None:
    """Which of the observations kept fits so badly that it was disturbed."""
    axes = list(seen.force_axes)
    design = _design(found.up, axes, found.turned)
    forces = seen.forces[found.kept][:, axes]
    count, parameters = len(forces), design.shape[2]
    best, p_best = None, OUTLIER / max(count, 1)
    for k in range(count):
        others = fit(np.delete(design, k, axis=0), np.delete(forces, k, axis=0))
        if others is None:
            continue
        rest = (count - 1) * len(axes) - parameters
        missed = forces[k] - design[k] @ others.value
        spread = others.scatter**2 * np.eye(len(axes)) + design[k] @ others.covariance @ design[k].T
        ratio = float(missed @ np.linalg.solve(spread, missed)) / len(axes)
        p = float(f_distribution.sf(ratio, len(axes), min(rest, others.freedom)))
        if p < p_best:
            best, p_best = k, p
    return best


def payload(seen: Observed, basis: str = "", free: str = "") -> tuple[Quantity, ...]:
    """Weight, biases, centre of mass and rotation of the sensor, or why they are not told.

    `basis` says what the observations are, `free` what is taken for granted.
    """
    names_force, names_torque = (
        tuple(f"{kind}_bias_{axis}" for axis in AXES) for kind in ("force", "torque")
    )
    found = weigh(seen)
    if found is None:
        reason = _why(seen)
        return (
            *untold(("weight",), "N", reason, ORIENTATIONS),
            *untold(names_force, "N", reason, ORIENTATIONS),
            *untold(names_torque, "N·m", reason, ORIENTATIONS),
            *untold(tuple(f"centre_of_mass_{axis}" for axis in AXES), "m", reason, ORIENTATIONS),
            *untold(tuple(f"sensor_rotation_{a}" for a in AXES), "rad", reason, ORIENTATIONS),
        )
    left = len(seen) - len(found.kept)
    basis = f"{len(found.kept)} {basis or 'rests'}, left {found.linear.scatter:.2g} N" + (
        f", {left} left out that do not fit" if left else ""
    )
    told = _forces(seen, found, "; ".join(part for part in (basis, free) if part))
    return (*told, *_torques(seen, found, told[0]))


def _why(seen: Observed) -> str:
    if len(seen.force_axes) < 2:
        return "fewer than two components of the force were recorded"
    if len(seen) < FEWEST:
        return f"the arm rests {len(seen)} times, and {FEWEST} are the least"
    return f"its orientations differ by {_spread(seen):.2g} degrees"


def _spread(seen: Observed) -> float:
    """How far up turns in the axes of the end effector, at most [degrees]."""
    length = np.linalg.norm(seen.up, axis=1, keepdims=True)
    unit = seen.up / np.where(length > 0, length, 1.0)
    return float(np.degrees(np.arccos(np.clip(unit @ unit.T, -1, 1)).max()))


def _forces(seen: Observed, found: Load, basis: str) -> tuple[Quantity, ...]:
    linear, axes = found.linear, list(seen.force_axes)
    unit = np.eye(len(linear.value))
    at = len(axes)
    weight, wide = float(linear.value[at]), linear.half_width(unit[at])
    told = []
    aligned = "" if found.turned else ", its axes taken as the end effector's"
    if wide > USELESS * max(abs(weight), 1.0):
        spread = f"orientations differ by {_spread(seen):.2g} degrees only"
        reason = f"{spread}, so weight and bias cannot be told apart"
        told += untold(("weight",), "N", reason, ORIENTATIONS)
    else:
        known = f"{basis}{aligned}; times the sensor's gain, which a known weight would show"
        told.append(Quantity("weight", "N", weight, (weight - wide, weight + wide), basis=known))
    for k, axis in enumerate(AXES):
        name = f"force_bias_{axis}"
        if k not in axes:
            told += untold((name,), "N", f"F_{axis} was not recorded", "record it")
            continue
        value = float(linear.value[axes.index(k)])
        half = linear.half_width(unit[axes.index(k)])
        if half > USELESS * max(abs(weight), abs(value), 1.0):
            reason = f"orientations differ by {_spread(seen):.2g} degrees only"
            told += untold((name,), "N", reason, ORIENTATIONS)
        else:
            told.append(Quantity(name, "N", value, (value - half, value + half), basis=basis))
    return (*told, *_rotation(seen, found, basis))


def _rotation(seen: Observed, found: Load, basis: str) -> tuple[Quantity, ...]:
    axes, linear = list(seen.force_axes), found.linear
    turning = [0, 1, 2] if len(axes) == 3 else _turning(axes)
    names = [f"sensor_rotation_{axis}" for axis in AXES]
    if not found.turned:
        reason = "the load is too light, or orientations differ too little, to show it to 15 degrees"
        return untold(names, "rad", reason, ORIENTATIONS)
    weight, vector = linear.value[len(axes)], found.rotation.as_rotvec()
    told = []
    for k, name in enumerate(names):
        if k not in turning:
            told += untold((name,), "rad", "readings are planar", "record all components")
            continue
        row = np.zeros(len(linear.value))
        row[len(axes) + 1 + turning.index(k)] = 1.0 / weight
        half, value = linear.half_width(row), float(vector[k])
        told.append(Quantity(name, "rad", value, (value - half, value + half), basis=basis))
    return tuple(told)


def _torques(seen: Observed, found: Load, weight: Quantity) -> tuple[Quantity, ...]:
    """Torque bias and centre of mass: T = b_T + c x G, with G the load's part of the force."""
    names = [f"torque_bias_{axis}" for axis in AXES]
    centres = [f"centre_of_mass_{axis}" for axis in AXES]
    axes = list(seen.torque_axes)
    if not axes:
        reason = "torques were not recorded"
        return (
            *untold(names, "N·m", reason, "record them"),
            *untold(centres, "m", reason, "record them"),
        )
    pull = found.linear.value[len(seen.force_axes)] * found.up
    design = np.concatenate(
        (np.broadcast_to(np.eye(3), (len(pull), 3, 3))[:, :, axes], -skew(pull)), axis=2
    )[:, axes]
    # In a planar recording the centre's part out of the plane turns nothing.
    free = [k for k in range(design.shape[2]) if k < len(axes) or np.abs(design[..., k]).max() > 0]
    linear = fit(design[..., free], seen.torques[found.kept][:, axes])
    relative = 0.0
    if weight.interval is not None and isinstance(weight.value, float) and weight.value:
        relative = (weight.interval[1] - weight.interval[0]) / 2 / abs(weight.value)
    told: list[Quantity] = []
    for k, name in enumerate((*names, *centres)):
        unit = "N·m" if k < 3 else "m"
        place = len(axes) + k - 3 if k >= 3 else (axes.index(k) if k in axes else None)
        if place is None or place not in free:
            told += untold((name,), unit, "readings are planar", "record all components")
            continue
        if linear is None or (k >= 3 and weight.value is None):
            reason = f"orientations differ by {_spread(seen):.2g} degrees only"
            told += untold((name,), unit, reason, ORIENTATIONS)
            continue
        row = np.eye(len(free))[free.index(place)]
        value, half = float(linear.value[free.index(place)]), linear.half_width(row)
        basis = f"left {linear.scatter:.2g} N·m"
        if k >= 3:
            half = float(np.hypot(half, relative * value))
            basis += "; from the point that torques are about, which rests alone do not show"
        told.append(Quantity(name, unit, value, (value - half, value + half), basis=basis))
    return tuple(told)
