"""How good a prior is: the figures that stand in its card. All distances in mm here.

Each figure is measured on the shape as users load it, by the distance |f| / |grad f| of
points from the zero level set or by level sets traced on a grid (`levelset`), never by a
training loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from tpcd.shape.deepsdf import UNIT, DeepSDFShape, project
from tpcd.shape.levelset import decode, decode_many, decodes_plausibly

MM = 1000.0
DIRECTIONS = 180
"""Directions in which support functions are compared, all around."""
BAND = 0.003
"""Half-width of the band around outlines in which the gradient norm is measured [m]."""


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

    `level_set`: distance of 1000 true points from the traced zero level set; `head`: their
    distance from the polygon of the head's points; `support`: difference of the support
    functions of the head's points and the true outline in 180 directions.
    """
    true = uniform_points(vertices)
    head = shape.boundary_points(latent).detach().numpy().astype(float)
    curves = decode(shape, latent).closed
    level_set = shapely.MultiLineString([np.vstack((c, c[:1])) for c in curves])
    return {
        "level_set": MM * shapely.distance(level_set, shapely.points(true)),
        "head": MM * shapely.distance(shapely.LinearRing(head), shapely.points(true)),
        "support": MM * (support_of(head)[0] - support_of(vertices)[0]),
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


def head_distances(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"]
) -> Float64[np.ndarray, "count p"]:
    """Distance |f| / |grad f| of the head's points from the zero level set [mm]."""
    points = shape.boundary_points(latents).detach().requires_grad_()
    value = shape.signed_distance(points, latents)
    gradient = torch.autograd.grad(value.sum(), points)[0].norm(dim=-1)
    return MM * (value.detach().abs() / gradient.clamp_min(0.2)).double().numpy()


def support_errors(
    shape: DeepSDFShape, latents: Float[Tensor, "count z"]
) -> Float64[np.ndarray, " count"]:
    """Largest difference, over directions, of the head's support from the level set's [mm].

    The level set is traced at 2 mm, its edges are cut in four, so that no tip is missed
    between two vertices, and all points brought onto f = 0 by Newton steps.
    Latents that do not decode to one closed curve get NaN.
    """
    network = shape.network
    worst = np.full(len(latents), np.nan)
    heads = shape.boundary_points(latents).detach().numpy()
    for index, level_set in enumerate(decode_many(shape, latents, spacing=0.002)):
        if len(level_set.closed) != 1:
            continue
        z = latents[index].to(network.codes.dtype)
        vertices = level_set.closed[0]
        edges = np.roll(vertices, -1, axis=0) - vertices
        fine = (vertices[:, None] + np.arange(4)[:, None] / 4 * edges[:, None]).reshape(-1, 2)
        points = torch.tensor(fine).to(z) / UNIT
        for _ in range(2):
            points = project(network, points, z).detach()
        traced = points.double().numpy() * UNIT
        worst[index] = MM * np.abs(support_of(heads[index])[0] - support_of(traced)[0]).max()
    return worst


def plausible_share(shape: DeepSDFShape, latents: Float[Tensor, "count z"]) -> float:
    """Share of latents that decode to exactly one closed outline of plausible size."""
    return float(decodes_plausibly(shape, latents, 0.003).mean())


def measure_prior(
    shape: DeepSDFShape,
    outlines: dict[str, Float64[np.ndarray, "_ 2"]],
    draws: int = 2000,
    seed: int = 1234,
) -> dict[str, object]:
    """Everything a card says about a prior that does not need other priors."""
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
    support = support_errors(shape, latents[: min(300, draws // 4)])
    summary = {key: vars(Spread.of(np.concatenate(value))) for key, value in pooled.items()}
    return {
        "training_errors_mm": summary,
        "training_errors_by_outline_mean_p95_max": per_outline,
        "head_to_level_set_mm": vars(Spread.of(head_distances(shape, latents))),
        "support_error_mm": vars(Spread.of(support[np.isfinite(support)])),
        "support_error_is": "largest over 180 directions, for each latent",
        "valid_share": plausible_share(shape, latents),
        "valid_draws": draws,
    }
