"""The belief that an estimator's state holds, as it is and from many more draws.

After each transition the sampler spends little, which is enough to choose the next move by. What
is left of an episode is the belief after its last transition, and that one may cost more: with ten
data the draws of `budget` are worth about six, and their intervals are too narrow.

One mixture is not enough: the sheet on which theta is likely is long and bent, and where components
are missing no draw gets. So the mixture is adapted in several passes, each of which begins where
the draws of the one before lie, and all components are kept. Places are chosen further apart than
the posterior is wide, or its ends get too few (`SamplerSettings.spread`).
"""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from tpcd.belief.belief import Belief, EstimationStep, belief_of, target_of
from tpcd.belief.cloud import cloud_from_tensors
from tpcd.belief.history import history_of
from tpcd.belief.importance import adapt
from tpcd.belief.settings import EstimatorSettings
from tpcd.belief.state import EstimatorState
from tpcd.data.episode import Episode
from tpcd.shape.protocol import Shape

_SHARE_BETWEEN = 6
"""Between two passes one of so many draws shows where the next one begins."""


def refine(
    episode: Episode,
    shape: Shape,
    state: EstimatorState,
    settings: EstimatorSettings | None = None,
) -> EstimationStep:
    """The belief that `state` holds, found once more with `settings.closing_budget`.

    The particles and modes of the state are where its draws begin. The state stays as it is, and
    the same state gives the same belief. What is told of the draws is of the last ones, their
    cost of all. Raises ValueError where no particle can explain the episode.
    """
    settings = settings or EstimatorSettings()
    started = time.perf_counter()
    generator = torch.Generator()
    cloud = cloud_from_tensors(state.restore(generator))
    target = target_of(episode, shape, settings).given(history_of(episode).first(state.index))
    budget, adapted = settings.closing_budget, None
    for left in reversed(range(settings.closing_passes)):
        adapted = adapt(cloud, target, state.index, budget, generator, adapted)
        if left == 0:
            break
        few = adapted.pool(target, max(1, budget.draws // _SHARE_BETWEEN), generator)
        adapted = replace(adapted, evaluations=few.evaluations)
        if few.effective_sample_size >= settings.closing_worth / _SHARE_BETWEEN:
            break
        cloud = few.cloud(budget.particles, generator, budget.spread)
    assert adapted is not None
    pool = adapted.pool(target, budget.draws, generator)
    cloud = pool.cloud(budget.particles, generator)
    rounds = (settings.closing_passes - left) * budget.rounds
    belief, info = belief_of(cloud, target), pool.info(rounds, len(cloud.weights))
    return EstimationStep(state.index, belief, info, time.perf_counter() - started, state)


def held_belief(
    episode: Episode,
    shape: Shape,
    state: EstimatorState,
    settings: EstimatorSettings | None = None,
) -> Belief:
    """The belief of the step that left `state`."""
    target = target_of(episode, shape, settings or EstimatorSettings())
    target = target.given(history_of(episode).first(state.index))
    return belief_of(cloud_from_tensors(dict(state.tensors)), target)
