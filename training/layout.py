"""Where the codes of the training outlines start, and what lies between them.

Two dimensions: the codes start on well-spread sites of the square, and similar outlines
get neighbouring sites. The square is triangulated; every latent is a convex combination of
the three nodes of its triangle, and its outline the same combination of their outlines.
Border nodes (fixed) repeat the outline of the nearest point of the codes' hull, so that the
whole square is taken care of. More dimensions: codes start at the scaled principal
components; the outline of any latent is the linear model's plus the residuals of the codes
around it, weighted by a kernel; latents in between come from convex combinations of near
codes and from the Gaussian mixture fitted to those, which becomes the prior density.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment
from scipy.spatial import Delaunay

from training.config import LayoutConfig
from training.mixture import Mixture, fit_mixture

LEAST_DIFFERENCE = 1e-6
"""Outlines that differ by less, as a root mean square over all points, do not [m]."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Initial codes and random latents between them, with the outlines these should have."""

    codes: Float64[np.ndarray, "n z"]
    """Initial codes of the n outlines."""
    weights: Float64[np.ndarray, "m n"]
    """Latent k in between is weights[k] @ codes + offsets[k], so it follows the codes."""
    offsets: Float64[np.ndarray, "m z"]
    outline_weights: Float64[np.ndarray, "m n"]
    """Outlines of the latents in between as combinations of the n outlines."""
    mixture: Mixture | None = None
    """Density of the latents, before truncation; None where it is uniform (z = 2)."""


def make_layout(
    outlines: Float64[np.ndarray, "n p 2"],
    latent_dim: int,
    config: LayoutConfig,
    rng: np.random.Generator,
) -> Layout:
    """Place the codes and draw `config.between` latents between them.

    Raises ValueError where the outlines do not differ in as many ways as there are latents.
    """
    _check_variety(outlines, latent_dim)
    if latent_dim == 2:
        return _square_layout(outlines, config, rng)
    return _component_layout(outlines, latent_dim, config, rng)


def _check_variety(outlines: Float64[np.ndarray, "n p 2"], latent_dim: int) -> None:
    """Refuse outlines that are all the same, or span fewer dimensions than the latent has.

    Two latents lie on a square whose sites need no more than that outlines differ at all.
    """
    n, p, _ = outlines.shape
    flat = outlines.reshape(n, -1)
    values = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)
    ways = int((values > LEAST_DIFFERENCE * math.sqrt(n * p)).sum())
    if ways == 0:
        raise ValueError(f"all {n} outlines to train on are the same, expected different ones")
    if ways < latent_dim > 2:
        raise ValueError(
            f"network.latent_dim is {latent_dim}, but {n} outlines differ in {ways} independent "
            f"ways; expected at most {max(ways, 2)} latents, or more outlines"
        )


def _square_layout(
    outlines: Float64[np.ndarray, "n p 2"], config: LayoutConfig, rng: np.random.Generator
) -> Layout:
    codes = _neighbourly_sites(outlines, config, rng)
    ticks = np.linspace(-1, 1, 5)
    border = np.array([(u, v) for u in ticks for v in ticks if max(abs(u), abs(v)) == 1])
    hull = Delaunay(codes).convex_hull
    border_weights = np.stack([_hull_projection(node, codes, hull) for node in border])
    nodes = np.vstack((codes, border))
    triangles = Delaunay(nodes)
    latents = rng.uniform(-1, 1, (config.between, 2))
    simplex = triangles.find_simplex(latents)
    transform = triangles.transform[simplex]
    first = np.einsum("mij,mj->mi", transform[:, :2], latents - transform[:, 2])
    weights = np.column_stack((first, 1 - first.sum(axis=1)))
    between = np.zeros((config.between, len(nodes)))
    np.put_along_axis(between, triangles.simplices[simplex], weights, axis=1)
    own, fixed = between[:, : len(codes)], between[:, len(codes) :]
    # A smoother (Clough-Tocher) interpolation was tried: it overshoots, and a quarter of the
    # outlines in between then cross themselves, against 4 % of these.
    return Layout(codes, own, fixed @ border, own + fixed @ border_weights)


def _neighbourly_sites(
    outlines: Float64[np.ndarray, "n p 2"], config: LayoutConfig, rng: np.random.Generator
) -> Float64[np.ndarray, "n 2"]:
    """Spread sites over the square; give neighbouring sites to similar outlines."""
    flat = outlines.reshape(len(outlines), -1)
    dissimilarity = np.square(flat[:, None] - flat[None]).sum(-1)
    components = _principal_components(flat, 2)
    ranks = components.argsort(axis=0).argsort(axis=0) / max(len(flat) - 1, 1) * 2 - 1
    best_cost, best = np.inf, ranks
    for _ in range(config.attempts):
        sites = _spread_sites(len(flat), config.extent, rng)
        _, order = linear_sum_assignment(np.square(ranks[:, None] - sites[None]).sum(-1))
        order, cost = _swap_to_neighbours(order, _adjacency(sites), dissimilarity)
        if cost < best_cost:
            best_cost, best = cost, sites[order]
    return best


def _spread_sites(
    count: int, extent: float, rng: np.random.Generator
) -> Float64[np.ndarray, "n 2"]:
    """Nearly evenly spread sites of [-extent, extent]^2 (Lloyd's relaxation)."""
    sites = rng.uniform(-1, 1, (count, 2))
    for _ in range(150):
        draws = rng.uniform(-1, 1, (3000, 2))
        nearest = np.square(draws[:, None] - sites[None]).sum(-1).argmin(axis=1)
        for index in np.unique(nearest):
            sites[index] += 0.5 * (draws[nearest == index].mean(axis=0) - sites[index])
    return sites / np.abs(sites).max() * extent


def _adjacency(sites: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n n"]:
    adjacent = np.zeros((len(sites), len(sites)))
    if len(sites) < 4:
        return 1 - np.eye(len(sites))
    for a, b, c in Delaunay(sites).simplices:
        for i, j in ((a, b), (b, c), (c, a)):
            adjacent[i, j] = adjacent[j, i] = 1
    return adjacent


def _swap_to_neighbours(
    order: np.ndarray, adjacent: np.ndarray, dissimilarity: np.ndarray
) -> tuple[np.ndarray, float]:
    """Swap pairs while that lowers the summed dissimilarity of neighbours."""

    def cost_of(candidate: np.ndarray) -> float:
        return float((adjacent[np.ix_(candidate, candidate)] * dissimilarity).sum())

    cost, improved = cost_of(order), True
    while improved:
        improved = False
        for i in range(len(order)):
            for j in range(i):
                candidate = order.copy()
                candidate[[i, j]] = candidate[[j, i]]
                candidate_cost = cost_of(candidate)
                if candidate_cost < cost * (1 - 1e-12):
                    order, cost, improved = candidate, candidate_cost, True
    return order, cost


def _hull_projection(
    node: np.ndarray, codes: np.ndarray, hull: np.ndarray
) -> Float64[np.ndarray, " n"]:
    """Weights on the codes of the point of their hull's boundary that is nearest to `node`."""
    starts, ends = codes[hull[:, 0]], codes[hull[:, 1]]
    edges = ends - starts
    along = ((node - starts) * edges).sum(-1) / np.square(edges).sum(-1)
    along = along.clip(0, 1)
    nearest = np.linalg.norm(starts + along[:, None] * edges - node, axis=1).argmin()
    weights = np.zeros(len(codes))
    weights[hull[nearest, 0]] += 1 - along[nearest]
    weights[hull[nearest, 1]] += along[nearest]
    return weights


def _component_layout(
    outlines: Float64[np.ndarray, "n p 2"],
    latent_dim: int,
    config: LayoutConfig,
    rng: np.random.Generator,
) -> Layout:
    n = len(outlines)
    flat = outlines.reshape(n, -1)
    left, values, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    components = left[:, :latent_dim] * values[:latent_dim]
    scale = np.abs(components).max(axis=0) / config.extent
    codes = components / scale
    distance = np.linalg.norm(components[:, None] - components[None], axis=-1)
    order = distance.argsort(axis=1)
    bandwidth = float(np.median(np.take_along_axis(distance, order[:, 3:4], axis=1)))
    # The linear model mean + c V is itself a combination of the outlines: 1/n + U S^-1 c.
    to_linear = (left[:, :latent_dim] / values[:latent_dim]).T
    linear_at_codes = 1 / n + components @ to_linear

    def weights_at(latents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Kernel weights of the codes, and weights of the outlines, at latents."""
        c = latents * scale
        square = np.square(c[:, None] - components[None]).sum(-1)
        kernel = np.exp(-0.5 * square / bandwidth**2)
        kernel /= kernel.sum(axis=1, keepdims=True) + np.exp(-2)
        return kernel, 1 / n + c @ to_linear + kernel @ (np.eye(n) - linear_at_codes)

    seeds = _near_combinations(codes, order[:, : config.neighbours + 1], config, rng)
    outline_weights = weights_at(seeds)[1]
    simple = shapely.is_valid(shapely.polygons((outline_weights @ flat).reshape(len(seeds), -1, 2)))
    if simple.sum() < config.components:
        raise ValueError(
            f"{simple.sum()} of {len(seeds)} outlines between near ones do not cross themselves, "
            f"expected at least {config.components} (layout.components); raise layout.between"
        )
    mixture = fit_mixture(seeds[simple], config.components, rng)
    drawn = mixture.draw(config.between - len(seeds), rng)
    latents = np.vstack((seeds, drawn)).clip(-1, 1)
    weights, outline_weights = weights_at(latents)
    return Layout(codes, weights, latents - weights @ codes, outline_weights, mixture)


def _near_combinations(
    codes: Float64[np.ndarray, "n z"],
    near: np.ndarray,
    config: LayoutConfig,
    rng: np.random.Generator,
) -> Float64[np.ndarray, "m z"]:
    """Random convex combinations of three near codes each, with a little noise."""
    count = config.between // 2
    chosen = np.stack([rng.permutation(near[rng.integers(len(codes))])[:3] for _ in range(count)])
    # Shares concentrate on one code (Dirichlet 1/2), so that lone codes are not forgotten.
    shares = rng.dirichlet(np.full(3, 0.5), count)
    noise = config.jitter * codes.std(axis=0) * rng.standard_normal((count, codes.shape[1]))
    return (np.einsum("mk,mkz->mz", shares, codes[chosen]) + noise).clip(-1, 1)


def _principal_components(
    flat: Float64[np.ndarray, "n d"], count: int
) -> Float64[np.ndarray, "n c"]:
    centred = flat - flat.mean(axis=0)
    left, values, _ = np.linalg.svd(centred, full_matrices=False)
    return left[:, :count] * values[:count]
