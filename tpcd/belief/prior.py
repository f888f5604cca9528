"""The prior over theta and the unconstrained coordinates in which samplers move.

Every entry of theta lives in a box [low, high]. The coordinate y of an entry is the normal
score of its place in the box, theta = low + (high - low) Phi(y), so that moves never meet a
wall and a uniform prior becomes a standard normal one. The shape latent has the box
[-1, 1] and, on top, the density fitted with the shape model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contract import check_prior
from tpcd.effects.protocol import Added, Effect, effect_parameters, parameter_bounds
from tpcd.parameters import (
    DEFAULT_BOUNDS,
    SCENE_NAMES,
    SCENE_UNITS,
    Parameters,
    parameter_names,
    parameter_units,
)
from tpcd.shape.protocol import Shape

_EDGE = 1e-9
"""Closest a place in the box comes to its ends, relative to its width."""


@dataclass(frozen=True, eq=False)
class ParameterPrior:
    """Independent uniform priors on the scene entries and the shape model's latent density."""

    shape: Shape
    low: Float[Tensor, " d"]
    high: Float[Tensor, " d"]
    effects: tuple[Effect, ...] = ()
    """Effects that the model has besides; their parameters follow the entries of the scene."""

    @property
    def dimension(self) -> int:
        """Number of entries d of theta, those of the effects included."""
        return len(self.low)

    @property
    def scene_dimension(self) -> int:
        """Number of entries of theta without those of the effects."""
        return self.shape.latent_dim + len(SCENE_NAMES)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta."""
        own = (f"{effect.name}.{p.name}" for effect in self.effects for p in effect.parameters)
        return (*parameter_names(self.shape.latent_dim), *own)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the entries of theta."""
        own = (parameter.unit for parameter in effect_parameters(self.effects))
        return (*parameter_units(self.shape.latent_dim), *own)

    def with_effects(self, effects: Sequence[Effect]) -> ParameterPrior:
        """The prior of the same scene with these effects and no others."""
        scene = self.scene_dimension
        low, high = parameter_bounds(effects)
        return replace(
            self,
            low=torch.cat((self.low[:scene], low)),
            high=torch.cat((self.high[:scene], high)),
            effects=tuple(effects),
        )

    def parameters_of(self, vector: Float[Tensor, "*batch d"]) -> Parameters:
        """The scene's entries of theta as named tensors."""
        return Parameters.from_vector(vector[..., : self.scene_dimension])

    def added_of(self, vector: Float[Tensor, "m d"]) -> Added:
        """The effects with their values."""
        return Added(self.effects, vector[..., self.scene_dimension :])

    def to_vector(self, score: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Theta in SI units from unconstrained coordinates."""
        place = torch.special.ndtr(score).clamp(_EDGE, 1 - _EDGE)
        return self.low + (self.high - self.low) * place

    def to_vector_with_slope(
        self, score: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch d"], Float[Tensor, "*batch d"]]:
        """Theta, and the derivative of each entry by its own coordinate."""
        density = torch.exp(-0.5 * score**2) / math.sqrt(2 * math.pi)
        return self.to_vector(score), (self.high - self.low) * density

    def to_parameters(self, score: Float[Tensor, "*batch d"]) -> Parameters:
        """Theta as named tensors from unconstrained coordinates."""
        return self.parameters_of(self.to_vector(score))

    def to_score(self, vector: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Unconstrained coordinates of theta; entries outside their box land on its edge."""
        place = ((vector - self.low) / (self.high - self.low)).clamp(_EDGE, 1 - _EDGE)
        return torch.special.ndtri(place)

    def log_density(self, score: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch"]:
        """Log prior density in the unconstrained coordinates; -inf far from valid shapes."""
        normal = -0.5 * (score**2).sum(-1) - 0.5 * self.dimension * math.log(2 * math.pi)
        z = self.shape.latent_dim
        if z == 0:
            return normal
        # The box of the latent has the uniform density 2^-z, which the normal score includes.
        latent = self.to_vector(score)[..., :z]
        return normal + self.shape.log_density(latent) + z * math.log(2.0)

    def curvature(
        self, score: Float[Tensor, "*batch d"]
    ) -> tuple[Float[Tensor, "*batch d"], Float[Tensor, "*batch d d"]]:
        """Gradient of the log prior density in the unconstrained coordinates, within the valid
        shapes, and a precision, positive definite, that bounds its curvature."""
        precision = torch.eye(self.dimension, dtype=score.dtype, device=score.device)
        precision = precision.repeat(*score.shape[:-1], 1, 1)
        gradient = -score
        z = self.shape.latent_dim
        if z:
            vector, slope = self.to_vector_with_slope(score)
            slope = slope[..., :z]
            rise, own = self.shape.latent_curvature(vector[..., :z])
            gradient = torch.cat((gradient[..., :z] + slope * rise, gradient[..., z:]), dim=-1)
            precision[..., :z, :z] += slope[..., :, None] * own * slope[..., None, :]
        return gradient, precision

    def sample(
        self, count: int, generator: torch.Generator, checked: bool = True
    ) -> Float[Tensor, "count d"]:
        """Draw unconstrained coordinates from the prior, with valid shapes only unless not
        `checked`."""
        score = torch.randn(count, self.dimension, generator=generator, dtype=torch.float64)
        z = self.shape.latent_dim
        if z == 0:
            return score
        latent = self.shape.sample_latent(count, generator, checked).double()
        place = ((latent + 1) / 2).clamp(_EDGE, 1 - _EDGE)
        return torch.cat((torch.special.ndtri(place), score[:, z:]), dim=-1)


def make_prior(
    shape: Shape,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    effects: Sequence[Effect] = (),
) -> ParameterPrior:
    """The prior with the default bounds, replaced where `bounds` names an entry [SI units].

    Raises ValueError for a name that is not a scene entry or bounds that it cannot have.
    """
    given = dict(bounds or {})
    unknown = sorted(set(given) - set(SCENE_NAMES))
    if unknown:
        raise ValueError(f"no parameter {unknown[0]!r}; expected one of {', '.join(SCENE_NAMES)}")
    low, high = [-1.0] * shape.latent_dim, [1.0] * shape.latent_dim
    for name, unit in zip(SCENE_NAMES, SCENE_UNITS, strict=True):
        both = given.get(name, DEFAULT_BOUNDS[name])
        check_prior(name, both, unit, unusual=True)
        lower, upper = both
        low.append(lower)
        high.append(upper)
    prior = ParameterPrior(
        shape=shape,
        low=torch.tensor(low, dtype=torch.float64),
        high=torch.tensor(high, dtype=torch.float64),
    )
    return prior.with_effects(effects) if effects else prior
