"""Outlines read off a shape's signed distance: its zero level set on a grid, by contourpy.

Used where certainty counts more than time: checks of a prior, maps of the latent plane,
figures. The simulator uses `boundary_points` instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import contourpy
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from tpcd.shape.protocol import Shape

HALF_WIDTH = 0.2
"""Half the side of the square that is searched for level sets [m]."""
FINE = (0.0005, 0.0001)
"""Grid steps at which a latent that fails on a coarser grid is looked at again [m]."""
COARSENING = 4
"""Fine grid steps in one coarse step; the fine grid is evaluated only near the outline."""
SMALLEST_SIZE, LARGEST_SIZE = 0.015, 0.36
"""Plausible longer side of the bounding box of a held object at scale 1 [m]."""


@dataclass(frozen=True, eq=False)
class LevelSet:
    """What one latent decodes to."""

    closed: tuple[Float64[np.ndarray, "_ 2"], ...]
    """Closed curves [m], longest first; the last vertex does not repeat the first."""
    open_count: int
    """Curves that leave the searched square."""

    @property
    def plausible(self) -> bool:
        """Exactly one closed outline of plausible size and nothing else."""
        if len(self.closed) != 1 or self.open_count:
            return False
        return SMALLEST_SIZE <= float(np.ptp(self.closed[0], axis=0).max()) <= LARGEST_SIZE


def decode(
    shape: Shape,
    latent: Float[Tensor, " z"],
    spacing: float = 0.002,
    half_width: float = HALF_WIDTH,
) -> LevelSet:
    """Zero level set of one latent on a grid of `spacing` [m] over a centred square."""
    return next(decode_many(shape, latent[None], spacing, half_width))


def decode_many(
    shape: Shape,
    latents: Float[Tensor, "count z"],
    spacing: float = 0.004,
    half_width: float = HALF_WIDTH,
) -> Iterator[LevelSet]:
    """Zero level sets of many latents, one after another."""
    coarse = 2 * max(1, round(half_width / (COARSENING * spacing))) + 1
    steps = COARSENING * (coarse - 1) + 1
    ticks = np.linspace(-half_width, half_width, steps)
    axis = torch.from_numpy(ticks)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij")[::-1], dim=-1).to(latents)
    for latent in latents:
        with torch.no_grad():
            values = _near_zero_values(shape, latent, grid)
        yield _contours(ticks, values.double().cpu().numpy())


def decodes_plausibly(
    shape: Shape, latents: Float[Tensor, "count z"], spacing: float = 0.004
) -> Bool[np.ndarray, " count"]:
    """Whether each latent decodes to exactly one closed outline of plausible size.

    What fails at `spacing` [m] is looked at again at each of `FINE`: a coarse grid cuts necks and
    tips that are thinner than it.
    """
    good = np.zeros(len(latents), dtype=bool)
    for step in (spacing, *FINE):
        again = latents[torch.from_numpy(~good).to(latents.device)]
        good[~good] = [found.plausible for found in decode_many(shape, again, step)]
    return good


def _near_zero_values(
    shape: Shape, latent: Float[Tensor, " z"], grid: Float[Tensor, "n n 2"]
) -> Float[Tensor, "n n"]:
    """Signed distances on a grid: exact near the zero level set, elsewhere of the right sign.

    A coarse grid tells where the distance exceeds twice the diagonal of its cells; there,
    the fine grid takes the value of the nearest coarse point.
    """
    coarse = grid[::COARSENING, ::COARSENING]
    rough = shape.signed_distance(coarse.reshape(-1, 2), latent).reshape(coarse.shape[:2])
    n = grid.shape[0]
    nearest = ((torch.arange(n) + COARSENING // 2) // COARSENING).clamp(max=len(coarse) - 1)
    values = rough[nearest[:, None], nearest[None, :]]
    step = float((grid[COARSENING, 0] - grid[0, 0]).norm())
    near = values.abs() < 2 * 2**0.5 * step
    values[near] = shape.signed_distance(grid[near], latent)
    return values


def _contours(ticks: np.ndarray, values: np.ndarray) -> LevelSet:
    lines = contourpy.contour_generator(ticks, ticks, values).lines(0.0)
    closed = [line for line in lines if len(line) > 3 and np.array_equal(line[0], line[-1])]
    closed.sort(key=len, reverse=True)
    curves = tuple(np.asarray(line[:-1], dtype=np.float64) for line in closed)
    return LevelSet(curves, len(lines) - len(closed))
