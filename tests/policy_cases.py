"""A can, a few steps beside it and beliefs about it, for tests of policies."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import torch

from tpcd.belief import EstimatorSettings, SamplerSettings
from tpcd.belief.belief import Belief, prior_belief
from tpcd.data.episode import Episode
from tpcd.parameters import DEFAULT_BOUNDS, SCENE_NAMES
from tpcd.policies import ActiveSettings
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.checkpoint import load_prior
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import Scene, draw_scene

SMALL = ActiveSettings(first=32, rounds=2, later=16, elite=4, particles=40, finalists=4)


@cache
def can_scene() -> Scene:
    """Where the can is, and what it is held against."""
    generator = torch.Generator().manual_seed(21)
    return draw_scene("soup_can", builtin_outlines()["soup_can"].vertices, generator)


@cache
def can_episode() -> Episode:
    """Five steps that press and slide."""
    scene = can_scene()
    generator = torch.Generator().manual_seed(22)
    motion = make_motion("press_and_slide", scene, 5, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 5, generator).measured


@cache
def can_belief() -> Belief:
    """What is believed before any of them."""
    settings = EstimatorSettings(sampler=SamplerSettings(particles=200))
    generator = torch.Generator().manual_seed(0)
    return prior_belief(can_episode(), load_prior("ycb21-z2"), generator, settings)


def known_but(belief: Belief, name: str) -> Belief:
    """The belief with everything but one parameter known."""
    middle = belief.vectors[:1].clone()
    for i, entry in enumerate(SCENE_NAMES, start=belief.prior.shape.latent_dim):
        low, high = DEFAULT_BOUNDS[entry]
        middle[:, i] = 0.5 * (low + high)
    vectors = middle.repeat(len(belief.vectors), 1)
    column = belief.prior.names.index(name)
    vectors[:, column] = belief.vectors[:, column]
    return replace(
        belief, vectors=vectors, misfit_sd=torch.full_like(belief.misfit_sd, 1e-4),
        misfit_covariance=1e-4 * belief.misfit_covariance,
    )  # fmt: skip


def row_at(episode: Episode, pose: tuple[float, float, float]) -> Episode:
    """An episode of one row, at rest in a pose."""
    here = torch.tensor([pose], dtype=torch.float64)
    return replace(episode, commands=here, poses=here, wrenches=torch.zeros_like(here))
