"""Between two rough terrains, where Coulomb's law leaves open how an object rests."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from contact_scenes import STIFFNESS, many_random_transitions, vector

from tpcd.simulator import StepStatus, simulate_step


@pytest.mark.parametrize(("compliance", "near"), [(1e-7, 1e-5), (1e-6, 5e-5)])
def test_an_object_in_a_corner_rests_as_on_terrain_that_hardly_yields(
    compliance: float, near: float
) -> None:
    """There what can slip is not held by a wedge, and the load is that of the arm alone."""
    scene, start, first = many_random_transitions(12, seed=81)
    rest = simulate_step(scene, start, first, STIFFNESS)
    soft = replace(scene, compliance=torch.full_like(scene.friction, compliance))
    # Steps on from where random transitions ended slide into corners.
    found, expected = (
        simulate_step(
            each, rest.pose, first + vector(0.004, -0.003, 0.01), STIFFNESS, previous=first
        )
        for each in (scene, soft)
    )
    between = (found.mode > 0).all(-1)
    between &= (found.status <= StepStatus.START_INSIDE) & (
        expected.status <= StepStatus.START_INSIDE
    )
    assert int(between.sum()) > 40
    off = (found.pose - expected.pose).abs().amax(-1)[between]
    assert float((off < near).double().mean()) > 0.95
    load, least = (each.contacts[between, :, 0].sum(-1) for each in (found, expected))
    assert float((load < 1.01 * least).double().mean()) > 0.95
