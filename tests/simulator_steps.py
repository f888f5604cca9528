"""Steps of the simulator that must converge, and the marks the tests of the step share."""

from __future__ import annotations

import pytest
import torch
from contact_scenes import STIFFNESS, vector

from tpcd.simulator import StepSettings, StepStatus, simulate_step

FRICTIONS = pytest.mark.parametrize("friction_law", ["coulomb", "anitescu"])
SIDES = pytest.mark.parametrize("side", [-1.0, 1.0])
CLOSE = 1e-9
"""Closed forms hold to this [m, rad]; forces to a hundred times as much."""


def step(scene, start, command, stiffness=STIFFNESS, **settings):
    settings = StepSettings(**{"substeps": 1, "follow_path": True, **settings})
    transition = simulate_step(scene, start, command, stiffness, settings)
    assert (transition.status == StepStatus.CONVERGED).all()
    return transition


def assert_near(found, *wanted, atol=CLOSE):
    torch.testing.assert_close(found, vector(*wanted), atol=atol, rtol=0)
