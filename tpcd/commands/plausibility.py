"""Whether an episode can be explained under the priors at all, before any work is done."""

from __future__ import annotations

from dataclasses import replace

import torch

from tpcd.belief.belief import Belief
from tpcd.belief.prior import make_prior
from tpcd.contact import scene_from_parameters, terrain_gaps
from tpcd.data.episode import Episode
from tpcd.data.table import row_name
from tpcd.errors import EpisodeError
from tpcd.parameters import Parameters
from tpcd.shape.protocol import Shape

DRAWS = 1000
"""Draws from the prior; what one draw in 100 explains is missed 4 times in 100,000."""
OUTLINE_ERROR = 5e-3
"""The start may be this deep inside [m]: real outlines differ from those of the prior."""
TERRAINS = ("floor", "wall")


def check_start_pose(episode: Episode, shape: Shape) -> None:
    """Refuse an episode whose start pose is inside floor or wall whatever the priors allow.

    Row 0 is the free start pose. Where no drawn outline, mount, floor and wall leaves it
    free, the poses are in another frame or the priors belong to another scene. Raises
    `EpisodeError` that says how deep the shallowest draw is.
    """
    prior = make_prior(shape, episode.priors)
    draws = prior.sample(DRAWS, torch.Generator().manual_seed(0))
    remedy = "check the frame of the poses, or give floor_height and wall_position under priors"
    _refuse_inside(episode, shape, prior.to_parameters(draws), "draws from the priors", remedy)


def check_start_of(episode: Episode, belief: Belief) -> None:
    """Refuse an episode whose start pose is inside floor or wall for every particle of a belief,
    as `check_start_pose` does before there is one."""
    remedy = "predict episodes of the scene that the belief was learnt in, in the same frame"
    _refuse_inside(
        episode, belief.prior.shape, belief.parameters, "particles of the belief", remedy
    )


def check_start_after(episode: Episode, belief: Belief) -> None:
    """The same for the episode that the belief was learnt from: then its rows contradict the first
    one."""
    remedy = "the estimate is not to be trusted: measure the start pose again, free of contact"
    _refuse_inside(
        episode, belief.prior.shape, belief.parameters, "particles of the belief", remedy
    )


def _refuse_inside(
    episode: Episode, shape: Shape, parameters: Parameters, what: str, remedy: str
) -> None:
    with torch.no_grad():
        scene = scene_from_parameters(
            shape, replace(parameters, latent=parameters.latent.float())
        ).double()
        count = len(parameters.scale)
        pose = episode.poses[0].expand(count, 3)
        gaps, _ = terrain_gaps(scene.points_ee, scene.terrains, pose)
    shallowest, terrain = gaps.amin(-1).min(-1)
    best = int(shallowest.argmax())
    if float(shallowest[best]) > -OUTLINE_ERROR:
        return
    path = episode.path or "episode"
    x, z, angle = episode.poses[0].tolist()
    row = row_name(0, episode.path) if episode.path else "row 0"
    depth, where = -1e3 * float(shallowest[best]), TERRAINS[int(terrain[best])]
    raise EpisodeError(
        path,
        f"{row}: the start pose ({x:.4g}, {z:.4g}, {angle:.4g}) is at least"
        f" {depth:.0f} mm inside the {where} for all of {count} {what}, expected a"
        " pose free of contact",
        remedy,
    )
