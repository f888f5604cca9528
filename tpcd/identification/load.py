"""What the sensor carries and reads at zero, from readings in several orientations.

In axes of the end effector the sensor reads

    F = b_F + S (f + W up),    T = b_T + S t + r x' (S f) + c x (W S up),

where up is against gravity, W < 0 the load's weight, and f, t what the world is known to press
with, about the end effector's origin: nothing in the air, K (x - u) under an impedance controller.
S turns axes of the end effector into the sensor's; r is the point that torques are about, from the
origin, and c the load's centre of mass from that point, both in the sensor's axes (r x' F is
F x r). Linear in b_F, W, and a small rotation beyond what is known of S; then in b_T, c and r. A
wrench that is recorded with the other sign has all of them with the other sign but S, r and c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution
from scipy.stats import t as student

from tpcd.identification.blocks import moments, solve
from tpcd.identification.quantity import LEVEL
from tpcd.identification.rests import Observed

FEWEST = 4
"""Orientations below which nothing is left to learn the error from."""
ALIGNED = np.radians(15.0)
"""A rotation of the sensor that would be known no better than this is taken as none [rad]."""
OUTLIER = 1e-3
"""Probability, over all rests, below which one that fits worst is left out as disturbed."""
WORST = 1e10
"""Condition of the normal equations beyond which a combination of parameters has no effect."""
TURNS = 20
"""Rounds in which a large rotation of the sensor is approached."""


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


def least_squares(
    design: Float[np.ndarray, "r c p"],
    readings: Float[np.ndarray, "r c"],
    edges: Int[np.ndarray, " B"] | None = None,
) -> Linear | None:
    """Least squares over r observations of c components; None where some combination of the
    parameters has no effect, or no observation is left to learn the error from.

    With `edges` blocks of observations count as one: their errors are those of the jackknife.
    """
    observations, components, count = design.shape
    flat, target = design.reshape(-1, count), readings.ravel()
    freedom = observations - -(-count // components)
    scale = np.linalg.norm(flat, axis=0)
    if freedom < 1 or (scale == 0).any():
        return None
    products = (flat / scale).T @ (flat / scale)
    if np.linalg.cond(products) > WORST:
        return None
    inverse = np.linalg.inv(products) / np.outer(scale, scale)
    value = inverse @ flat.T @ target
    left = target - flat @ value
    squares = float(left @ left)
    variance = squares / (len(target) - count)
    if edges is None:
        return Linear(value, variance * inverse, freedom, variance**0.5, squares)
    sums = moments(np.column_stack((target, flat)), edges * components)
    whole = sums.sum(0)
    parts = np.stack([solve(rest[1:, 1:], rest[1:, :1])[:, 0] for rest in whole - sums])
    away = parts - parts.mean(0)
    blocks = len(edges)
    covariance = (blocks - 1) / blocks * away.T @ away
    return Linear(value, covariance, blocks - 1, variance**0.5, squares)


@dataclass(frozen=True, eq=False)
class Load:
    """A fit of the forces."""

    linear: Linear
    """b_F, W, and the remaining rotation where `turned`."""
    rotation: Rotation
    """S, as far as it is known."""
    turned: bool
    kept: Int[np.ndarray, " k"]
    """The observations that count."""
    axes: tuple[int, ...]
    """Components of the force."""

    @property
    def weight(self) -> float:
        """W [N]."""
        return float(self.linear.value[len(self.axes)])


def weigh(seen: Observed) -> Load | None:
    """Bias, weight and rotation of the sensor from forces; None where orientations are too few.

    Rests that do not fit, as where something was touched, are left out one by one, the worst
    first, a quarter of them at most.
    """
    if len(seen.force_axes) < 2 or len(seen) < FEWEST:
        return None
    found = _load(seen, np.arange(len(seen)))
    for _ in range(0 if seen.edges is not None else len(seen) // 4):
        worst = None if found is None else _worst(seen, found)
        if found is None or worst is None:
            break
        found = _load(seen, np.delete(found.kept, worst))
    return found


def _load(seen: Observed, kept: Int[np.ndarray, " k"]) -> Load | None:
    axes = list(seen.force_axes)
    forces, at = seen.forces[kept][:, axes], len(axes)
    pressed = np.zeros((len(kept), 3)) if seen.pressed is None else seen.pressed[kept]
    plain = _fitted(seen, kept, Rotation.identity(), None, seen.edges)
    weight = 0.0 if plain is None else float(plain.value[at])
    known = Rotation.identity()
    if at == 3 and seen.pressed is None:
        known = _first_rotation(seen.up[kept], forces)
    for _ in range(TURNS):
        if not weight and not pressed.any():
            break
        linear = _fitted(seen, kept, known, weight or 1e-9, None)
        if linear is None:
            break
        rest, weight = _turn(linear.value, axes), float(linear.value[at])
        if np.linalg.norm(rest) < 1e-9:
            linear = _fitted(seen, kept, known, weight, seen.edges)
            if linear is None:
                break
            wide = [linear.half_width(row) for row in np.eye(len(linear.value))[at + 1 :]]
            if max(wide) > ALIGNED:
                break
            return Load(linear, known, True, kept, tuple(axes))
        known = Rotation.from_rotvec(rest) * known
    if plain is None:
        return None
    return Load(plain, Rotation.identity(), False, kept, tuple(axes))


def _fitted(
    seen: Observed,
    kept: Int[np.ndarray, " k"],
    known: Rotation,
    weight: float | None,
    edges: Int[np.ndarray, " B"] | None,
) -> Linear | None:
    design, target = _equations(seen, kept, known, weight)
    return least_squares(design, target[:, list(seen.force_axes)], edges)


def _equations(
    seen: Observed, kept: Int[np.ndarray, " r"], known: Rotation, weight: float | None
) -> tuple[Float[np.ndarray, "r c p"], Float[np.ndarray, "r 3"]]:
    """Columns of b_F, W and, unless `weight` is None, the remaining rotation; what they make."""
    axes = list(seen.force_axes)
    up, target = known.apply(seen.up[kept]), seen.forces[kept]
    parts = [np.broadcast_to(np.eye(3), (len(up), 3, 3))[:, :, axes], up[:, :, None]]
    force = np.zeros_like(up)
    if seen.pressed is not None:
        force = known.apply(seen.pressed[kept])
        target = target - force
    if weight is not None:
        parts.append(-skew(force + weight * up)[:, :, turning_axes(axes)])
    return np.concatenate(parts, axis=2)[:, axes], target


def _first_rotation(up: np.ndarray, forces: np.ndarray) -> Rotation:
    """Where a large rotation is looked for from: F - mean against up - mean (Kabsch 1976)."""
    spread = (up - up.mean(0)).T @ (forces - forces.mean(0))
    left, size, right = np.linalg.svd(spread)
    if size[1] < 1e-3 * max(size[0], 1e-12):
        return Rotation.identity()
    # A load weighs down: W < 0.
    turn = right.T @ np.diag([1.0, 1.0, -np.linalg.det(right.T @ left.T)]) @ left.T
    return Rotation.from_matrix(-turn)


def turning_axes(axes: list[int]) -> list[int]:
    """Rotations that leave readings among `axes`."""
    return [0, 1, 2] if len(axes) == 3 else [k for k in range(3) if k not in axes]


def _turn(value: np.ndarray, axes: list[int]) -> np.ndarray:
    """The remaining rotation vector, as a part of what was fitted."""
    rest = np.zeros(3)
    rest[turning_axes(axes)] = value[len(axes) + 1 :]
    return rest


def skew(vectors: Float[np.ndarray, "r 3"]) -> Float[np.ndarray, "r 3 3"]:
    """Matrices that take a to v x a."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def _worst(seen: Observed, found: Load) -> int | None:
    """Which of the observations kept fits so badly that it was disturbed."""
    axes = list(found.axes)
    weight = found.weight if found.turned else None
    design, target = _equations(seen, found.kept, found.rotation, weight)
    forces = target[:, axes]
    count, parameters = len(forces), design.shape[2]
    best, p_best = None, OUTLIER / max(count, 1)
    for k in range(count):
        others = least_squares(np.delete(design, k, axis=0), np.delete(forces, k, axis=0))
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
