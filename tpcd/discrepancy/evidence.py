"""How well a model explains a history: its evidence and posterior, from the prior, on some seeds.

Every model is fitted in the same way: importance sampling of the whole history at once, with modes
found by climbing from all over the prior, made again until it tells the same twice. Parameters of
effects are entries of theta like all others, so effects and shape, mount, floor, wall and friction
compete for the same data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.cloud import Cloud, Target, start_cloud
from tpcd.belief.importance import draw_pool
from tpcd.belief.pool import Pool
from tpcd.belief.settings import SamplerSettings
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.carrying import carried
from tpcd.discrepancy.fit import MISSED, Fit, Question, fit_stream, model_name
from tpcd.effects.protocol import Effect
from tpcd.simulator import StepSettings

FIRST = {"flat_rounds": 0, "rough": True, "draws": 500}
"""Of the first draws, which only tell what touched: flat coordinates hang on that."""
PASSES = 5
"""Times at most that draws are made again."""
CLIMBS = 1.0
"""Change of log evidence with which they are,"""
ENOUGH = 10
"""and effective number below which, of the last draws or of all that count: a single heavy draw
of an earlier pass makes few of all of them."""


def fit_model(
    question: Question,
    effects: Sequence[Effect],
    seeds: Sequence[int],
    start: Sequence[Fit] = (),
    step: StepSettings | None = None,
    places: Float[Tensor, "k s"] | None = None,
    power: float = 1.0,
    passes: int = PASSES,
) -> Fit:
    """Fit the base model with these effects; seeds are told apart by their numbers.

    Besides the prior, a fit also starts from where those in `start` arrived, and from `places`.
    With a `power` of the likelihood below 1 the posterior is wider, and what stands for its
    evidence is none. `passes` is how often draws are made again at most.
    """
    effects = tuple(effects)
    prior = question.scene.with_effects(effects)
    step = question.step if step is None else step
    target = ContactTarget(prior, question.misfit, step, question.history, power)
    names = tuple(effect.name for effect in effects)
    model = (question.fingerprint, names, prior.low, prior.high, step, power, passes)
    begun = tuple(fit.fingerprint for fit in start)
    clouds = []
    for seed in seeds:
        generator = fit_stream(question, effects, seed)

        def work(generator: torch.Generator = generator) -> Cloud:
            return _fitted(target, question.sampler, start, places, generator, passes)

        what = f"fit of {model_name(effects)}"
        key = (*model, begun, places, seed)
        clouds.append(question.memory.recall(what, key, Cloud, work))
    return Fit(effects, step, prior, tuple(c.log_evidence for c in clouds), tuple(clouds))


def _fitted(
    target: ContactTarget,
    sampler: SamplerSettings,
    start: Sequence[Fit],
    places: Float[Tensor, "k s"] | None,
    generator: torch.Generator,
    passes: int,
) -> Cloud:
    """The particles of one seed."""
    begin = start_cloud(target.sample(sampler.particles, generator))
    remembered = [carried(fit, target.prior, generator) for fit in start]
    if places is not None:
        remembered.append(places)
    if remembered:
        begin = replace(begin, modes=torch.cat(remembered))
    pool = draw_again(begin, target, sampler, generator, passes)
    return pool.cloud(sampler.particles, generator)


def draw_again(
    begin: Cloud,
    target: Target,
    sampler: SamplerSettings,
    generator: torch.Generator,
    passes: int = PASSES,
) -> Pool:
    """Draws that are made again and again, each time from where the draws before lie, and count
    together where they find the same, while the evidence changes or rests on few of them; once
    where the sampler has no flat rounds.

    Draws 3 nats below those before have missed what these found, and do not count; draws 3 nats
    above replace them.
    """
    if not sampler.flat_rounds:
        return draw_pool(begin, target, 1, sampler, generator)
    rough = draw_pool(begin, target, 1, replace(sampler, **FIRST), generator)
    pool, before = rough, rough.log_evidence
    for count in range(passes):
        cloud = pool.cloud(sampler.particles, generator)
        found = draw_pool(cloud, target, 1, sampler, generator)
        change = found.log_evidence - before
        if count == 0 or found.log_evidence > pool.log_evidence + MISSED:
            pool = found  # those before were rough, or missed what these found
        elif found.log_evidence > pool.log_evidence - MISSED:
            pool = pool.beside(found)
        before = found.log_evidence
        if count == 0:
            change = max(change, 0.0)  # rough draws may say too much
        worth = max(pool.effective_sample_size, found.effective_sample_size)
        if abs(change) <= CLIMBS and worth >= ENOUGH:
            break
    return pool
