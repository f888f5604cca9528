"""The quick look: how long its points climb."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_nested import in_free_space, question_of

from tpcd.belief.modes import Climbers
from tpcd.belief.target import ContactTarget
from tpcd.discrepancy import screening
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.screening import FURTHER, GOING_ON, RISING, ROUNDS, glance
from tpcd.effects import find_effect


@pytest.mark.parametrize(("rises", "often"), [(0, 1), (1, 2), (9, FURTHER)])
def test_points_go_on_while_any_of_them_rises(
    rises: int, often: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last of those that go on rises so many times, too little for it to be the best."""
    question = question_of(in_free_space(0.3))
    base = fit_model(question, (), (0,))
    seen: list[tuple[int, int]] = []

    def climb(target: ContactTarget, points: Climbers, rounds: int) -> Climbers:
        seen.append((len(points.height), rounds))
        height = torch.linspace(-1.0, -100.0, len(points.height), dtype=torch.float64)
        if len(seen) > 1:
            height = points.height.clone()
            height[-1] += 2 * RISING if len(seen) - 1 <= rises else 0.5 * RISING
        return replace(points, height=height)

    monkeypatch.setattr(screening, "climb", climb)
    found = glance(question, base, find_effect("force_gain"), 0)
    assert seen[0] == (screening.PLACES, ROUNDS)
    assert seen[1:] == [(GOING_ON, ROUNDS)] * often
    assert torch.isfinite(found.place).all()


def test_what_says_where_it_is_is_sought_all_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bump begins small, everywhere along the floor and of any width; the best places are offered
    to a full fit, which an effect that is everywhere does not need."""
    question = question_of(in_free_space(0.3))
    base = fit_model(question, (), (0,))
    begun: list[Climbers] = []

    def climb(target: ContactTarget, points: Climbers, rounds: int) -> Climbers:
        begun.append(points)
        return points

    monkeypatch.setattr(screening, "climb", climb)
    bump = find_effect("floor_height ~ bump")
    found = glance(question, base, bump, 0)
    prior = question.scene.with_effects((bump,))
    height, place, width = prior.to_vector(begun[0].points[:, :-1])[:, -3:].T
    for value, parameter in ((place, bump.parameters[1]), (width, bump.parameters[2])):
        share = (value.sort().values - parameter.low) / (parameter.high - parameter.low)
        expected = (torch.arange(len(value)) + 0.5) / len(value)
        torch.testing.assert_close(share, expected.double(), rtol=0, atol=0.5 / len(value))
    assert height.abs().max() < 0.2 * bump.parameters[0].high
    assert torch.corrcoef(torch.stack((place, width)))[0, 1].abs() < 0.2
    assert [len(points.points) for points in begun[:5]] == [288, 144, 72, 36, 18]
    assert found.places.shape == (1 + screening.OFFERED, question.scene.dimension + 4)
    assert len(glance(question, base, find_effect("force_gain"), 0).places) == 1
    begun.clear()
    glance(question, base, bump, 0, explained=True)
    assert [len(points.points) for points in begun[:3]] == [72, 36, 18]
