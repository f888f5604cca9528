"""Other base models: what a model takes for granted besides the effects that it lacks.

A shape that no outline of the prior comes near, or a simulator with other artefacts than ours,
looks like physics where it is not asked for. Where the base model leaves something, these are
fitted beside the candidates, and the best of all goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from tpcd.belief.target import ContactTarget
from tpcd.discrepancy.fit import Fit, Question

SCALES = (0.5, 2.0)
"""Widens the range of the scale at its lower and its upper end: objects of hand size to tools."""
WIDER_MISFIT = 4.0
"""Widens the error of the outline that is expected."""
FINER = 4
"""Times as many substeps."""
STRAINED = 3.0
"""Standard deviations from what the shape prior expects, in logarithms, from which the error of
the outline is said to stand for something else."""


@dataclass(frozen=True)
class Variant:
    """A base model with something else taken for granted."""

    name: str
    note: str
    """In words what it takes to be so."""
    change: Callable[[Question], Question]


def wide_shape(question: Question) -> Question:
    """The same for an object unlike those of the shape prior: of other size, and less alike."""
    scene, misfit = question.scene, question.misfit
    place = scene.names.index("scale")
    low, high = scene.low.clone(), scene.high.clone()
    low[place] *= SCALES[0]
    high[place] *= SCALES[1]
    return replace(
        question,
        scene=replace(scene, low=low, high=high),
        misfit=replace(misfit, sd=WIDER_MISFIT * misfit.sd),
    )


def relaxed_friction(question: Question) -> Question:
    """The same for data of a simulator with convex friction in single steps."""
    return replace(question, step=replace(question.step, friction="anitescu", substeps=1))


def finer_steps(question: Question) -> Question:
    """The same with every path cut into more parts."""
    step = question.step
    finer = replace(
        step,
        substeps=FINER * step.substeps,
        largest_turn=step.largest_turn / FINER,
        finest=step.finest / FINER,
        follow_path=True,
    )
    return replace(question, step=finer)


WIDE_SHAPE = Variant("wide_shape", "the object is unlike those of the shape prior", wide_shape)
RELAXED_FRICTION = Variant(
    "relaxed_friction",
    "the data are those of a simulator with convex friction, which lifts what slides",
    relaxed_friction,
)
FINER_STEPS = Variant("finer_steps", "friction depends on the path within a step", finer_steps)
VARIANTS = (WIDE_SHAPE, RELAXED_FRICTION, FINER_STEPS)
NUMERICS = (RELAXED_FRICTION.name, FINER_STEPS.name)
"""Variants that are artefacts of simulators."""


def strained(fit: Fit) -> bool:
    """Whether a model explains the data with an error of the outline that its prior hardly allows:
    such an error bends to much that is none."""
    cloud = fit.cloud
    return float(cloud.weights @ cloud.positions[:, -1]) > STRAINED


def step_halving(question: Question, fit: Fit) -> float:
    """How much the predictions of a fit depend on the substeps, which needs no data: the change
    that 95 % of the transitions stay under with finer steps, in sd of the prediction."""
    best = fit.cloud.positions[fit.cloud.weights.argmax()][None]
    found = [
        ContactTarget(fit.prior, question.misfit, step, question.history)
        .evaluate(best, innovations=True)
        .whitened
        for step in (fit.step, finer_steps(replace(question, step=fit.step)).step)
    ]
    assert found[0] is not None and found[1] is not None
    change = (found[0] - found[1])[0][question.history.used].abs().amax(-1)
    return float(torch.quantile(change.nan_to_num(0.0), 0.95))
