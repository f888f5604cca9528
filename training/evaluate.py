"""How good a prior is: the figures that stand in its card. All distances in mm here.

Each figure is measured on the shape as users load it, never by a training loss. The zero level
set of f is the decoded polygon; that f is the distance to it is checked on level sets traced on a
grid (`levelset`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from tpcd.shape.deepsdf import DeepSDFShape
from tpcd.shape.levelset import decode_many, decodes_plausibly

MM = 1000.0
DIRECTIONS = 180
"""Directions in which support functions are compared, all around."""
BAND = 0.003
"""Half-width of the band around outlines in which the gradient norm is measured [m]."""
TRACED, SPACING = 60, 0.0005
"""Latents whose zero level sets are traced, and the grid on which they are [m]."""


@dataclass(frozen=True)
class Spread:
    """Mean, 95th percentile and largest of absolute values."""

    mean: float
    p95: float
    max: float

    @staticmethod
    def of(values: np.ndarray) -> Spread:
        """Summarise |values|, rounded to 4 digits."""
        size = np.abs(values)
        figures = (size.mean(), np.quantile(size, 0.95), size.max())
        return Spread(*(round(float(figure), 4) for figure in figures))


def uniform_points(
    vertices: Float64[np.ndarray, "_ 2"], count: int = 1000
) -> Float64[np.ndarray, "count 2"]:
    """Points evenly spaced along an outline [m]."""
    closed = np.vstack((vertices, vertices[:1]))
    ends = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    at = np.linspace(0, ends[-1], count, endpoint=False)
    return np.stack([np.interp(at, ends, closed[:, i]) for i in (0, 1)], axis=1)


def support_of(
    polygon: Float64[np.ndarray, "p 2"], directions: int = DIRECTIONS
) -> Float64[np.ndarray, "2 k"]:
    """Support function in so many directions all around [m], and its derivative by the angle, which
    is where the outmost point lies along the edge of the half-plane that touches it."""
    angle = np.linspace(0, 2 * np.pi, directions, endpoint=False)
    outward = np.stack((np.cos(angle), np.sin(angle)))
    along = np.stack((-np.sin(angle), np.cos(angle)))
    outmost = polygon[(polygon @ outward).argmax(axis=0)].T
    return np.stack(((outmost * outward).sum(0), (outmost * along).sum(0)))


def outline_errors(
    shape: DeepSDFShape, latent: Float[Tensor, " z"], vertices: Float64[np.ndarray, "_ 2"]
) -> dict[str, Float64[np.ndarray, " _"]]:
    """Errors of one decoded outline at a true one, along the true outline [mm].

    `outline`: distance of 1000 points of the true outline from the decoded one; `support`:
    difference of the support functions in 180 directions.
    """
    decoded = shape.boundary_points(latent).detach().numpy().astype(float)
    points = shapely.points(uniform_points(vertices))
    return {
        "outline": MM * shapely.distance(shapely.LinearRing(decoded), points),
        "support": MM * (support_of(decoded)[0] - support_of(vertices)[0]),
    }


def eikonal_errors(
    shape: DeepSDFShape, latent: Float[Tensor, " z"], vertices: Float64[np.ndarray, "_ 2"]
) -> Float64[np.ndarray, " _"]:
    """| |grad f| - 1 | at 1000 points spread over a band of 3 mm about the outline."""
    true = uniform_points(vertices)
    edges = np.roll(true, -1, axis=0) - np.roll(true, 1, axis=0)
    normals = np.stack((edges[:, 1], -edges[:, 0]), axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    offsets = np.random.default_rng(0).uniform(-BAND, BAND, (len(true), 1))
    points = torch.tensor(true + offsets * normals).requires_grad_()
    value = shape.signed_distance(points, latent)
    gradient = torch.autograd.grad(value.sum(), points)[0]
    return (gradient.norm(dim=-1) - 1).abs().numpy()


def level_set_errors(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"]
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " count"]]:
    """How far the zero level set of f, traced at `SPACING`, is from the outline points [mm].

    First the distance of each traced point from the polygon of the outline points, all latents
    together, then for each latent the largest difference of the two support functions, NaN where
    the level set is not one closed curve.
    """
    outlines = shape.boundary_points(latents).detach().double().numpy()
    away, worst = [np.zeros(0)], np.full(len(latents), np.nan)
    for index, found in enumerate(decode_many(shape, latents, SPACING)):
        if len(found.closed) == 1:
            traced, ring = found.closed[0], shapely.LinearRing(outlines[index])
            away.append(MM * shapely.distance(ring, shapely.points(traced)))
            felt = support_of(traced)[0] - support_of(outlines[index])[0]
            worst[index] = MM * np.abs(felt).max()
    return np.concatenate(away), worst


def plausible_share(shape: DeepSDFShape, latents: Float[Tensor, "count z"]) -> float:
    """Share of latents whose level set is traced as exactly one closed curve of plausible size."""
    return float(decodes_plausibly(shape, latents, 0.003).mean())


def measure_prior(
    shape: DeepSDFShape,
    outlines: dict[str, Float64[np.ndarray, "_ 2"]],
    draws: int = 2000,
    seed: int = 1234,
) -> dict[str, object]:
    """Everything a card says about a prior that does not need other priors; what no draw tells is
    None."""
    per_outline: dict[str, dict[str, list[float]]] = {}
    pooled: dict[str, list[np.ndarray]] = {}
    for name, vertices in outlines.items():
        latent = shape.code_of(name)
        errors = outline_errors(shape, latent, vertices)
        errors["eikonal"] = eikonal_errors(shape, latent, vertices)
        spreads = {key: Spread.of(value) for key, value in errors.items()}
        per_outline[name] = {k: [s.mean, s.p95, s.max] for k, s in spreads.items()}
        for key, value in errors.items():
            pooled.setdefault(key, []).append(value)
    latents = shape.sample_latent(draws, torch.Generator().manual_seed(seed))
    unchecked = shape.sample_latent(draws, torch.Generator().manual_seed(seed), checked=False)
    away, felt = level_set_errors(shape, latents[: min(TRACED, draws // 4)])
    traced = np.isfinite(felt)
    summary = {key: vars(Spread.of(np.concatenate(value))) for key, value in pooled.items()}
    return {
        "training_errors_mm": summary,
        "training_errors_by_outline_mean_p95_max": per_outline,
        "level_set_to_outline_mm": vars(Spread.of(away)) if len(away) else None,
        "level_set_support_mm": vars(Spread.of(felt[traced])) if traced.any() else None,
        "level_set_is": f"traced on a grid of {MM * SPACING} mm at {len(felt)} draws, "
        f"one closed curve at {traced.sum()} of them",
        "unchecked_valid_share": float(shape.valid(unchecked).double().mean()),
        "valid_share": plausible_share(shape, latents),
        "valid_draws": draws,
    }
