"""The belief that an estimator's state holds, as it is and from many more draws.

After each transition the sampler spends little, which is enough to choose the next move by. What
is left of an episode is the belief after its last transition, and that one may cost more: with ten
data the draws of `budget` are worth about ten, and whole pieces of the posterior are without one.

Draws in flat coordinates from all over the prior, and the modes that are climbed to, say where the
posterior has its pieces (`flat_start`), and mixtures there (`flat_rounds`) meet them. Where the
draws are worth little all the same, further mixtures begin at them.
"""

from __future__ import annotations

import time

import torch

from tpcd.belief.belief import Belief, EstimationStep, belief_of, target_of
from tpcd.belief.cloud import cloud_from_tensors
from tpcd.belief.history import history_of
from tpcd.belief.importance import adapt
from tpcd.belief.settings import EstimatorSettings
from tpcd.belief.state import EstimatorState
from tpcd.data.episode import Episode
from tpcd.shape.protocol import Shape
from tpcd.threads import torch_in_one_thread


@torch_in_one_thread
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
    budget = settings.closing_budget
    adapted = adapt(cloud, target, state.index, budget, generator)
    pool = adapted.pool(target, budget.draws, generator)
    passes, most = 1, settings.closing_passes if budget.flat_rounds else 1
    while pool.effective_sample_size < settings.closing_worth and passes < most:
        adapted = adapted.again(target, pool, budget, generator)
        pool = adapted.pool(target, budget.draws, generator)
        passes += 1
    cloud = pool.cloud(budget.particles, generator)
    rounds = budget.rounds + passes * budget.flat_rounds
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
