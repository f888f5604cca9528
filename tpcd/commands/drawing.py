"""Figures of an estimation: theta step by step, the outline, and the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.commands.summary import prior_summary
from tpcd.contact import place_points
from tpcd.data.episode import Episode
from tpcd.figures.outline import outline_belief
from tpcd.figures.progress import estimation_progress
from tpcd.figures.scene import scene as scene_figure
from tpcd.figures.sinks import save_figure

OUTLINES_DRAWN = 200
DIRECTIONS = 72
"""In which outlines are compared."""


@dataclass(frozen=True)
class KnownTruth:
    """What a simulation knows and an estimator does not; drawn beside the belief."""

    vertices_ee: Tensor
    scene: dict[str, float]


def draw_estimation(
    belief: Belief,
    history: list[dict[str, Any]],
    episode: Episode,
    folder: Path,
    writer: Any,
    truth: KnownTruth | None,
    prefix: str = "",
    heading: str = "figures",
    closed: bool = False,
) -> None:
    """Figures of what was learnt: parameters step by step, the outline, and the scene.

    `prefix` leads their names, `heading` is where TensorBoard shows them; `closed` says that the
    last row of the history is of the closing draws.
    """
    z = belief.prior.shape.latent_dim
    names = belief.prior.names[z:]
    columns = {
        key: torch.cat((before[None], torch.tensor([row[key] for row in history])))[:, z:].numpy()
        for key, before in zip(("mean", "low", "high"), prior_summary(belief), strict=True)
    }
    known = None
    if truth is not None:
        # A simulated scene says nothing of effects.
        known = torch.tensor([truth.scene.get(name, math.nan) for name in names]).numpy()
    last = len(history)
    labels, units, factors = _shown(belief)
    figure = estimation_progress(
        torch.arange(last + 1).numpy(),
        **{key: column * factors for key, column in columns.items()},
        names=labels,
        units=units,
        truth=known,
        closed=closed,
    )
    save_figure(figure, folder, f"{prefix}estimation", writer, last, heading)
    chosen = torch.linspace(0, len(belief.weights) - 1, OUTLINES_DRAWN).long().unique()
    parameters = belief.parameters
    with torch.no_grad():
        outline = belief.prior.shape.boundary_points(parameters.latent[chosen])
    points = place_points(outline, parameters.scale[chosen], parameters.mount[chosen])
    vertices = None if truth is None else truth.vertices_ee.numpy()
    figure = outline_belief(points.double().numpy(), belief.weights[chosen].numpy(), vertices)
    save_figure(figure, folder, f"{prefix}outline", writer, last, heading)
    surfaces = {}
    for name in ("floor_height", "wall_position"):
        i = names.index(name)
        surfaces[name] = tuple(float(columns[key][-1, i]) for key in ("mean", "low", "high"))
    figure = scene_figure(
        episode.poses.numpy(),
        central_outline(points, belief.weights[chosen]).numpy() if vertices is None else vertices,
        surfaces["floor_height"],
        surfaces["wall_position"],
        true_floor=None if truth is None else truth.scene["floor_height"],
        true_wall=None if truth is None else truth.scene["wall_position"],
        commands=episode.commands.numpy(),
        wrenches=episode.wrenches.numpy(),
        outline="a central draw" if vertices is None else "",
    )
    save_figure(figure, folder, f"{prefix}scene", writer, last, heading)


def central_outline(
    points: Float[Tensor, "m p 2"], weights: Float[Tensor, " m"]
) -> Float[Tensor, "p 2"]:
    """The outline nearest to all others by weight (their medoid), by how far each reaches in all
    directions; of those with a weight."""
    angles = torch.linspace(0, 2 * math.pi, DIRECTIONS + 1, dtype=torch.float64)[:-1]
    directions = torch.stack((angles.cos(), angles.sin()))
    reach = (points.double() @ directions).amax(1)
    distance = torch.cdist(reach, reach, p=1.0) @ weights
    return points[int(torch.where(weights > 0, distance, torch.inf).argmin())].double()


def _shown(belief: Belief) -> tuple[list[str], list[str], Any]:
    """Labels and units of the entries of theta without the latent, as figures show them, and
    factors from SI units; effects choose their own units."""
    prior = belief.prior
    z, scene = prior.shape.latent_dim, prior.scene_dimension
    labels, units = list(prior.names[z:scene]), list(prior.units[z:scene])
    factors = [1.0] * len(labels)
    for effect in prior.effects:
        for parameter in effect.parameters:
            labels.append(f"{effect.name}:\n{parameter.name}")
            units.append(parameter.shown_unit or parameter.unit)
            factors.append(parameter.shown_factor)
    return labels, units, torch.tensor(factors).double().numpy()
