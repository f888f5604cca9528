"""The posterior that the sampler moves in: scores of theta and, last, of the misfit's size."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.filter import HistoryLikelihood
from tpcd.belief.flattening import Flattening, flattening
from tpcd.belief.history import History
from tpcd.belief.likelihood import AT_ONCE, history_likelihood, in_groups
from tpcd.belief.linearised import linearised_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import ParameterPrior
from tpcd.belief.setting import merge
from tpcd.effects.conditions import Outcome
from tpcd.simulator import ContactMode, StepSettings

_LARGE_MISFIT = 2.0
"""Added to the score of the misfit's size."""
_LEAST_WEIGHT = 1e-3
"""Of the largest: less does not count for what contact is."""
_DIFFERENCE = 0.01
"""Step of differences, in standard deviations of the prior."""


@dataclass(frozen=True, eq=False)
class ContactTarget:
    """Log posterior over d + 1 unconstrained coordinates, given a history of contact."""

    prior: ParameterPrior
    misfit: MisfitField
    step: StepSettings
    history: History | None = None
    power: float = 1.0
    """Power to which the likelihood is raised: below 1 the posterior is wider than Bayes' own, for
    a likelihood that is not quite that of the data (coarsened posteriors: Miller and Dunson 2019).
    """

    def given(self, history: History) -> ContactTarget:
        """The same with a history."""
        return replace(self, history=history)

    def rough(self) -> ContactTarget:
        """With paths of commands that are not followed to where contact changes, which takes 0.6 of
        the time."""
        return replace(self, step=replace(self.step, finest=1.0))

    def sample(self, count: int, generator: torch.Generator) -> Float[Tensor, "m s"]:
        """Draws from the prior, whose shapes are not checked: what a belief holds in the end is."""
        score = self.prior.sample(count, generator, checked=False)
        misfit = torch.randn(count, 1, generator=generator, dtype=torch.float64)
        return torch.cat((score, misfit), dim=-1)

    def scatter(self, count: int, generator: torch.Generator) -> Float[Tensor, "m s"]:
        """Draws from the prior, every other one with a large misfit: the larger it is, the
        smoother the posterior is to climb, as at a higher temperature."""
        score = self.sample(count, generator)
        score[::2, -1] += _LARGE_MISFIT
        return score

    def log_prior(self, score: Float[Tensor, "m s"]) -> Float[Tensor, " m"]:
        """Log density of the prior."""
        normal = -0.5 * score[:, -1] ** 2 - 0.5 * math.log(2 * math.pi)
        return self.prior.log_density(score[:, :-1]) + normal

    def log_likelihood(
        self, score: Float[Tensor, "m s"], least: Float[Tensor, " m"] | None
    ) -> Float[Tensor, " m"]:
        """Log likelihood of the history, times the power; -inf where it may stay below `least`."""
        least = None if least is None else least / self.power
        return self.power * self.evaluate(score, least).total

    def curvature(
        self, score: Float[Tensor, "m s"]
    ) -> tuple[Float[Tensor, "m s"], Float[Tensor, "m s s"]]:
        """Gradient of the log posterior and its Fisher information, from the derivatives of
        the innovations. What a free start says is left out.

        Entries that cannot be evaluated count as flat.
        """
        if in_groups(self.prior.effects, len(score)):
            some = [self.curvature(part) for part in score.split(AT_ONCE)]
            rise, information = (torch.cat(part) for part in zip(*some, strict=True))
            return rise, information
        found = self._linearised(score)
        here = torch.nan_to_num(found.whitened).flatten(1)
        slopes = torch.nan_to_num(found.slopes, 0.0, 0.0, 0.0).flatten(2)
        stretch = torch.nan_to_num(found.stretch, 0.0, 0.0, 0.0).flatten(2)
        gradient = self.power * (-(slopes @ here[..., None])[..., 0] - stretch.sum(-1))
        information = self.power * (slopes @ slopes.mT + 2 * stretch @ stretch.mT)
        rise, precision = self.prior.curvature(score[:, :-1])
        information[:, :-1, :-1] += precision
        information[:, -1, -1] += 1.0
        return gradient + torch.cat((rise, -score[:, -1:]), dim=-1), information

    def _linearised(self, score: Tensor) -> _Linearised:
        """Innovations and their derivatives: exact for theta, by a difference for the size of the
        misfit."""
        assert self.history is not None
        vectors, slope = self.prior.to_vector_with_slope(score[:, :-1])
        scene, added = self.prior.scene_dimension, self.prior.added_of(vectors)
        here, moved_misfit, outcome = linearised_likelihood(
            self.prior.shape,
            vectors[:, :scene],
            slope[:, :scene],
            self.misfit.sd_of(score[:, -1]),
            self.history,
            self.misfit,
            self.step,
            added,
            self.misfit.sd_of(score[:, -1] + _DIFFERENCE),
        )
        assert moved_misfit is not None
        parity, parity_scale = self.parity(score)
        whitened = torch.cat((_known(here.whitened), parity), dim=1)
        log_scale = torch.cat((_known(here.log_scale), parity_scale), dim=1)
        slopes, stretch = [_known(here.slopes)], []
        # Effects and the size of the misfit by differences. That contact forces, to which effects
        # answer, change too is left out: with surfaces that yielded so it was 3 % of a standard
        # deviation.
        for entry in range(scene, score.shape[-1]):
            moved = score.clone()
            moved[:, entry] += _DIFFERENCE
            there = moved_misfit
            if entry < score.shape[-1] - 1:  # The last is the size of the misfit.
                there = self.evaluate(moved, innovations=True, outcome=outcome)
            parity, parity_scale = self.parity(moved)
            found = torch.cat((_known(there.whitened), parity), dim=1)
            scale = torch.cat((_known(there.log_scale), parity_scale), dim=1)
            slopes.append(((found - whitened) / _DIFFERENCE)[:, None])
            stretch.append(((scale - log_scale) / _DIFFERENCE)[:, None])
        # The scene does not move what pose and wrench say about each other.
        missing = whitened.shape[1] - slopes[0].shape[2]
        slopes[0] = torch.nn.functional.pad(slopes[0], (0, 0, 0, missing))
        still = torch.zeros_like(slopes[0])
        return _Linearised(whitened, torch.cat(slopes, 1), torch.cat((still, *stretch), 1))

    def log_likelihood_and_contact(
        self, score: Float[Tensor, "m s"]
    ) -> tuple[Float[Tensor, " m"], Int[Tensor, "m n t"]]:
        """Log likelihood of the history, times the power, and the contact of each transition with
        each terrain (`ContactMode`)."""
        found = self.evaluate(score, steps=True)
        assert found.steps is not None
        return self.power * found.total, found.steps.mode

    def coordinates(
        self,
        positions: Float[Tensor, "m s"],
        weights: Float[Tensor, " m"],
        contact: Int[Tensor, "m n t"],
    ) -> Flattening:
        """Those in which the sheet lies flat, if contact is what most of the weight says it is."""
        assert self.history is not None
        # Draws of no weight say nothing, and there can be many.
        some = weights > _LEAST_WEIGHT * weights.max()
        share = weights[some] / weights[some].sum()
        modes = (int(ContactMode.FREE), int(ContactMode.STICK))
        free, stuck = (
            torch.einsum("m,mnt->nt", share, (contact[some] == mode).double()) for mode in modes
        )
        found = flattening(self.prior, self.misfit, self.history, free < 0.5, stuck > 0.5)
        return found.consistent(positions[some], share)

    def parity(self, score: Tensor) -> tuple[Tensor, Tensor]:
        """What pose and wrench of each row say about each other, in standard units, and the
        logarithms of the units; no rows where no effect can change it."""
        if not self.prior.effects:
            return score.new_zeros(len(score), 0, 3), score.new_zeros(len(score), 0, 3)
        assert self.history is not None
        history = self.history
        added = self.prior.added_of(self.prior.to_vector(score[:, :-1]))
        conditions = added.apply(history.bare, history.rows, None)
        merged = merge(history.readings, history.sensor_variance, conditions)
        found = merged.standard_parity(history.read)
        return found[0].expand(len(score), -1, -1), found[1].expand(len(score), -1, -1)

    def evaluate(
        self,
        score: Float[Tensor, "m s"],
        least: Float[Tensor, " m"] | None = None,
        innovations: bool = False,
        outcome: Outcome | None = None,
        steps: bool = False,
    ) -> HistoryLikelihood:
        """What the particles say about the history; effects answer to the `outcome` if given."""
        assert self.history is not None
        vectors = self.prior.to_vector(score[:, :-1])
        return history_likelihood(
            self.prior.shape,
            self.prior.parameters_of(vectors),
            self.misfit.sd_of(score[:, -1]),
            self.history,
            self.misfit,
            self.step,
            least,
            innovations,
            self.prior.added_of(vectors),
            outcome,
            steps,
        )


@dataclass(frozen=True)
class _Linearised:
    """Innovations (m, n, 3), and derivatives (m, s, n, 3) of them and of their log units."""

    whitened: Tensor
    slopes: Tensor
    stretch: Tensor


def _known(value: Tensor | None) -> Tensor:
    assert value is not None
    return value
