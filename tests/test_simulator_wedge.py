"""Between two rough terrains: which objects may rest in several ways, and are searched for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from contact_scenes import STIFFNESS, many_random_transitions, vector

from tpcd.contact import ContactScene
from tpcd.simulator import StepStatus, Transition, simulate_step, wedge


def on_from_rest(compliance: float = 0.0) -> Callable[[], Transition]:
    """Steps on from where random transitions ended, which slide into corners."""
    scene, start, first = many_random_transitions(12, seed=81)
    scene = replace(scene, compliance=torch.full_like(scene.friction, compliance))
    rest = simulate_step(scene, start, first, STIFFNESS)
    second = first + vector(0.004, -0.003, 0.01)
    return lambda: simulate_step(
        scene, rest.pose, second, STIFFNESS, engine="torch", previous=first
    )


@pytest.mark.parametrize("compliance", [0.0, 3e-4])
def test_what_rests_in_one_way_is_found_nowhere_else(
    compliance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search for an answer with less load, where it is spared, would have changed nothing."""
    steps = on_from_rest(compliance)
    spared: list[float] = []
    test = wedge.rests_one_way

    def noted(*given):
        found = test(*given)
        spared.append(float(found.double().mean()))
        return found

    monkeypatch.setattr(wedge, "rests_one_way", noted)
    found = steps()
    monkeypatch.setattr(
        wedge, "rests_one_way", lambda *given: torch.zeros_like(test(*given), dtype=torch.bool)
    )
    searched = steps()
    between = (searched.mode > 0).all(-1)
    assert int(between.sum()) > 30 and sum(spared) / len(spared) > 0.3
    assert (found.status == searched.status).all()
    torch.testing.assert_close(found.pose, searched.pose, rtol=0, atol=1e-6)


def test_some_may_rest_in_several_ways_and_end_elsewhere_without_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    steps = on_from_rest()
    found = steps()

    def always(scene: ContactScene, *_: object) -> torch.Tensor:
        return torch.ones(len(scene.friction), dtype=torch.bool)

    monkeypatch.setattr(wedge, "rests_one_way", always)
    plain = steps()
    settled = (found.status == StepStatus.CONVERGED) & (plain.status == StepStatus.CONVERGED)
    moved = (found.pose - plain.pose).abs().amax(-1) > 1e-5
    assert int((moved & settled).sum()) >= 5
    less = found.contacts[..., 0].sum(-1) < plain.contacts[..., 0].sum(-1)
    assert less[moved & settled].all()
