"""Effects joined to a belief that was estimated without them, and what a belief says of its own.

What is known of the effects comes from other data, with another object perhaps, so it is
independent of what the particles hold. Where both should be fitted to the same data, the belief
has to be estimated with the effects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.belief import Belief, misfit_field
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import EstimatorSettings
from tpcd.effects.model import Found, Model
from tpcd.effects.protocol import Effect
from tpcd.effects.shape_change import Bounds, ShapeChange
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings


def found_effects(belief: Belief) -> Found:
    """Posterior mean and standard deviation [SI units] of the parameters of the belief's effects,
    one by one: what is known of several together is not told."""
    entries = belief.prior.names[belief.prior.scene_dimension :]
    mean, std = belief.mean().tolist(), belief.std().tolist()
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for i, entry in enumerate(entries, start=belief.prior.scene_dimension):
        effect, name = entry.split(".", 1)
        found.setdefault(effect, {})[name] = (mean[i], std[i])
    return found


def shape_change_of(belief: Belief, shape: Shape, priors: Bounds) -> ShapeChange:
    """What the belief expects of the object otherwise than the shape model does on episodes with
    these priors."""
    usual = make_prior(shape, priors)
    place = usual.names.index("scale")
    own, other = ((p.low[place].item(), p.high[place].item()) for p in (belief.prior, usual))
    times = belief.misfit.sd / misfit_field(shape, EstimatorSettings()).sd
    return ShapeChange(None if own == other else own, times)


def with_model(belief: Belief, model: Model, generator: torch.Generator) -> Belief:
    """The belief with the effects of a model besides its own, drawn anew for each particle.

    Parameters are drawn independently, from the normal distribution that the model file says was
    found, within their prior; from the prior where it says nothing. Settings of the step that are
    not the default replace those of the belief; its shape stays. Raises ValueError for an effect
    that the belief has already.
    """
    own = [effect.name for effect in belief.prior.effects]
    twice = [effect.name for effect in model.effects if effect.name in own]
    if twice:
        raise ValueError(f"the belief was estimated with the effect {twice[0]!r} already")
    drawn = [
        _draw(effect, model.found.get(effect.name, {}), len(belief.weights), generator)
        for effect in model.effects
    ]
    effects = (*belief.prior.effects, *model.effects)
    return replace(
        belief,
        prior=belief.prior.with_effects(effects),
        vectors=torch.cat((belief.vectors, *drawn), dim=-1),
        step=belief.step if model.step == StepSettings() else model.step,
    )


def _draw(
    effect: Effect,
    found: Mapping[str, tuple[float, float]],
    count: int,
    generator: torch.Generator,
) -> Float[Tensor, "count p"]:
    """Draws of an effect's p parameters [SI units], one column for each."""
    columns = []
    for parameter in effect.parameters:
        place = torch.rand(count, generator=generator, dtype=torch.float64)
        low, high = parameter.low, parameter.high
        if parameter.name in found:
            mean, std = found[parameter.name]
            mean = min(max(mean, low), high)
            # A normal distribution cut off at the ends of the prior, by inversion.
            ends = torch.tensor([low - mean, high - mean], dtype=torch.float64)
            ends = torch.special.ndtr(ends / std) if std > 0 else (ends > 0).double()
            score = torch.special.ndtri(ends[0] + (ends[1] - ends[0]) * place)
            value = mean + std * score if std > 0 else torch.full_like(place, mean)
            columns.append(value.clamp(low, high))
        else:
            columns.append(low + (high - low) * place)
    return torch.stack(columns, dim=-1)
