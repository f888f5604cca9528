"""Where the codes of the training outlines start, and what lies between them.

Two dimensions: the codes start on well-spread sites of the square, and similar outlines
get neighbouring sites. The square is triangulated; every latent is a convex combination of
the three nodes of its triangle, and its outline the same combination of their outlines.
Border nodes (fixed) repeat the outline of the nearest point of the codes' hull, so that the
whole square is taken care of. More dimensions: codes start at the scaled principal
components, and the latents in between are random convex combinations of near codes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment
from scipy.spatial import Delaunay

from training.config import LayoutConfig


@dataclass(frozen=True, eq=False)
class Layout:
    """Nodes of the latent space and random latents between them, as weights on the nodes."""

    codes: Float64[np.ndarray, "n z"]
    """Initial codes of the n outlines."""
    border: Float64[np.ndarray, "b z"]
    """Fixed further nodes; none when z > 2."""
    border_weights: Float64[np.ndarray, "b n"]
    """Outline of each border node as a convex combination of the n outlines."""
    between: Float64[np.ndarray, "m k"]
    """Latents in between as convex combinations of the k = n + b nodes."""

    @property
    def outline_weights(self) -> Float64[np.ndarray, "m n"]:
        """Outlines of the latents in between as combinations of the n outlines."""
        n = len(self.codes)
        return self.between[:, :n] + self.between[:, n:] @ self.border_weights


def make_layout(
    outlines: Float64[np.ndarray, "n p 2"],
    latent_dim: int,
    config: LayoutConfig,
    rng: np.random.Generator,
) -> Layout:
    """Place the codes and draw `config.between` latents between them."""
    if latent_dim == 2:
        return _square_layout(outlines, config, rng)
    return _component_layout(outlines, latent_dim, config, rng)


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
    return Layout(codes, border, border_weights, between)


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
) -> Float64[np.ndarray, "n"]:
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
    flat = outlines.reshape(len(outlines), -1)
    components = _principal_components(flat, latent_dim)
    # One common scale keeps distances between codes proportional to those of outlines.
    codes = components / np.abs(components).max() * config.extent
    distance = np.linalg.norm(codes[:, None] - codes[None], axis=-1)
    near = distance.argsort(axis=1)[:, : config.neighbours + 1]
    between = np.zeros((config.between, len(codes)))
    for row in between:
        chosen = rng.choice(near[rng.integers(len(codes))], size=3, replace=False)
        row[chosen] = rng.dirichlet(np.ones(3))
    return Layout(codes, np.zeros((0, latent_dim)), np.zeros((0, len(codes))), between)


def _principal_components(
    flat: Float64[np.ndarray, "n d"], count: int
) -> Float64[np.ndarray, "n c"]:
    centred = flat - flat.mean(axis=0)
    left, values, _ = np.linalg.svd(centred, full_matrices=False)
    return left[:, :count] * values[:count]
