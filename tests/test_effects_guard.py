"""Particles for which an effect has no answer, and effects that have none at all."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from effect_cases import draws_of, likelihood, make_episode, one_line

from tpcd.belief.history import history_of
from tpcd.data.episode import Episode
from tpcd.effects import CATALOGUE, DeclaredEffect, Effect, EffectParameter
from tpcd.effects.protocol import Added
from tpcd.errors import EffectError


@pytest.fixture(scope="module")
def episode() -> Episode:
    return make_episode()


def rough(power: float, field: str = "friction") -> Effect:
    """An effect that has no answer for negative values."""

    def change(conditions, values, rows, outcome):
        value = getattr(conditions, field)
        factor = (values[:, 0] ** power).reshape(-1, *[1] * (value.ndim - 1))
        return replace(conditions, **{field: value * factor})

    return DeclaredEffect(
        "rough", "contact tangent", (EffectParameter("size", "1", -1.0, 1.5, 1.0),), change, "{0}"
    )


@pytest.mark.parametrize("field", ["friction", "command", "stiffness", "normal", "bias"])
def test_a_particle_without_an_answer_leaves_the_others_alone(episode: Episode, field: str) -> None:
    values = torch.tensor([-0.5, 1.0, 0.9, -0.1, 1.2, 1.0], dtype=torch.float64)[:, None]
    fine = values[:, 0] > 0
    effect, history, draws = rough(0.5, field), history_of(episode), draws_of(6)
    # A second effect looks at what the first one left behind.
    pair = (effect, CATALOGUE[0])
    values = torch.cat((values, torch.full_like(values, 2e-4)), dim=1)
    found = likelihood(history, draws, Added(pair, values))
    other = values.clone()
    other[~fine, 0] = 1.0
    expected = likelihood(history, draws, Added(pair, other))
    assert torch.equal(found[fine], expected[fine])
    assert bool((found[~fine] == -torch.inf).all())


def test_a_stiffness_that_is_not_positive_counts_as_no_answer(episode: Episode) -> None:
    values = torch.tensor([[1.0], [-1.0], [1.0]], dtype=torch.float64)
    found = likelihood(history_of(episode), draws_of(3), Added((rough(1.0, "stiffness"),), values))
    expected = likelihood(history_of(episode), draws_of(3), None)
    assert torch.equal(found[[0, 2]], expected[[0, 2]])
    assert float(found[1]) == -torch.inf


def test_an_effect_that_never_has_an_answer_is_named(episode: Episode) -> None:
    effect = replace(
        rough(1.0), change=lambda c, v, r, o: replace(c, friction=c.friction * torch.nan)
    )
    values = torch.ones(3, 1, dtype=torch.float64)
    with pytest.raises(EffectError, match="'rough' gives no usable friction for any value"):
        likelihood(history_of(episode), draws_of(3), Added((effect,), values))
    only_bad = rough(0.5)
    found = likelihood(history_of(episode), draws_of(3), Added((only_bad,), -values))
    assert bool((found == -torch.inf).all())


def test_an_effect_that_fails_on_the_way_is_named(episode: Episode) -> None:
    def change(conditions, values, rows, outcome):
        raise IndexError("a cause\nof two lines")

    effect = replace(rough(1.0), change=change, source="own.py")
    with pytest.raises(EffectError) as caught:
        likelihood(history_of(episode), draws_of(2), Added((effect,), torch.ones(2, 1).double()))
    line = one_line(caught.value)
    assert line == "effect 'rough' of own.py fails with IndexError: a cause of two lines"
