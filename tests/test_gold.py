"""Answers of revision 1747f21, recorded by tests/gold/record_steps.py, are what they were.

Where an answer was wrong, the commit that changes it says so and names it here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tpcd.contact import ContactScene, place_points
from tpcd.effects.catalogue import KNOWN, find_effect
from tpcd.effects.conditions import sequence
from tpcd.effects.protocol import Added
from tpcd.effects.simulate import simulate_rows
from tpcd.simulator import StepSettings, StepStatus, simulate_step
from tpcd.terrain import HalfPlane, floor, wall

GOLD = Path(__file__).parent / "gold"
SETTINGS = (
    StepSettings(),
    StepSettings(substeps=1),
    StepSettings(friction="anitescu", substeps=1),
    StepSettings(substeps=4, follow_path=True),
)
STATUS = torch.tensor(
    [StepStatus.CONVERGED, StepStatus.NOT_CONVERGED, StepStatus.RELAXED, StepStatus.INVALID_INPUT]
)
"""Statuses of today by the numbers of that revision."""
NEAR = {
    "pose": 1e-7,
    "wrench": 1e-5,
    "contacts": 1e-5,
    "pose_from_start": 2e-5,
    "pose_from_gap": 2e-5,
    "pose_from_lever": 2e-5,
}
"""Absolute bounds [m, rad, N, N·m]: a force is up to a thousand times a length, and derivatives
answer to where the fixed point ended within the solver's tolerance of 1e-7 m."""
CHANGED = {0: (106, 409), 1: (201,)}
"""Problems of each setting with friction from 1.1 to 3 on both terrains, where the object is wedged
and the recorded answer had not yet come to rest by up to 0.1 mm."""
FLUSH = {1: (71,), 3: (245,)}
"""Problems that end flush on a face or in a corner, where the points that bear the load, and with
them the gradients by points, are a choice."""
INPUTS = ("start", "command", "stiffness", "offset", "friction", "previous")
"""Those by normals are left out: the recorded ones took a slip's start not to turn with its
terrain. So are those by compliance, which between rigid terrains have no value."""


def gold(file: str, prefix: str = "") -> dict[str, Tensor]:
    """The recorded arrays whose names begin with the prefix."""
    with np.load(GOLD / file, allow_pickle=False) as stored:
        names = [name for name in stored.files if name.startswith(prefix)]
        return {name.removeprefix(prefix): torch.from_numpy(stored[name]) for name in names}


def problems(k: int) -> tuple[Tensor, dict[str, Tensor], list[Tensor]]:
    """Outline points and the problems of a setting, and which begin with or without a load."""
    found = gold("steps.npz", f"{k}/")
    outlines = gold("steps.npz", "outlines")[""]
    points = place_points(outlines[found["outline"]], found["scale"], found["mount"])
    loaded = ~found["previous"].isnan().any(-1)
    return points, found, [torch.nonzero(loaded).flatten(), torch.nonzero(~loaded).flatten()]


def step(points: Tensor, part: dict[str, Tensor], settings: StepSettings):
    """The answer to recorded problems."""
    planes = zip(part["normal"].unbind(-2), part["offset"].unbind(-1), strict=True)
    terrains = tuple(HalfPlane(normal, offset) for normal, offset in planes)
    scene = ContactScene(points, terrains, part["friction"], part["compliance"])
    previous = part["previous"]
    return simulate_step(
        scene, part["start"], part["command"], part["stiffness"], settings,
        previous=None if bool(previous.isnan().any()) else previous, unusual=True,
    )  # fmt: skip


@pytest.mark.parametrize("k", range(len(SETTINGS)))
def test_steps_end_as_recorded(k: int) -> None:
    points, found, groups = problems(k)
    for index in groups:
        index = index[~torch.isin(index, torch.tensor(CHANGED.get(k, ())))]
        part = {name: value[index] for name, value in found.items()}
        answer = step(points[index], part, SETTINGS[k])
        for name, near in NEAR.items():
            torch.testing.assert_close(getattr(answer, name), part[name], atol=near, rtol=1e-7)
        assert torch.equal(answer.mode, part["mode"].long())
        inside = answer.status == StepStatus.START_INSIDE
        now = torch.where(inside, StepStatus.CONVERGED, answer.status)
        assert torch.equal(now, STATUS[part["status"].long()])


@pytest.mark.parametrize("k", range(len(SETTINGS)))
def test_gradients_are_as_recorded(k: int) -> None:
    points, found, groups = problems(k)
    for index in groups:
        part = {name: value[index].clone() for name, value in found.items()}
        loaded = not bool(part["previous"].isnan().any())
        given = {name: part[name].requires_grad_() for name in INPUTS[: 5 + loaded]}
        given["points"] = points[index].clone().requires_grad_()
        answer = step(given["points"], part | given, SETTINGS[k])
        number = (torch.cat((answer.pose, 1e-2 * answer.wrench), -1) * part["pulls"]).sum()
        slopes = torch.autograd.grad(number, list(given.values()))
        # Forward, the recorded engine that had gradients ended elsewhere in a few.
        same = (answer.pose.detach() - part["torch_pose"]).abs().amax(-1) < 1e-8
        assert float(same.double().mean()) > 0.9
        same &= ~torch.isin(index, torch.tensor(FLUSH.get(k, ())))
        for name, slope in zip(given, slopes, strict=True):
            expected = part[f"d_{name}"]
            if name == "points":
                every = torch.zeros_like(slope)
                every.scatter_add_(1, part["touched"].long()[..., None].expand(-1, -1, 2), expected)
                # Outlines are padded with their first point, and either may be touched.
                alike = (points[index][:, :, None] == points[index][:, None]).all(-1).double()
                slope, expected = alike @ slope, alike @ every
            size = 1 + expected.abs().flatten(1).amax(-1)
            off = (slope - expected).abs().flatten(1).amax(-1) / size
            assert float(off[same].max()) < 2e-4, name


@pytest.mark.parametrize("name", [effect.name for effect in KNOWN])
def test_effects_act_as_recorded(name: str) -> None:
    found = gold("effects.npz")
    terrains = (floor(found["height"]), wall(found["position"]))
    scene = ContactScene(found["points"], terrains, found["friction"])
    added = Added((find_effect(name),), found[f"{name}/values"])
    rows = simulate_rows(
        scene, sequence(found["poses"]), found["commands"], found["stiffness"], added,
        StepSettings(),
    )  # fmt: skip
    torch.testing.assert_close(rows.transition.pose, found[f"{name}/pose"], atol=1e-7, rtol=1e-7)
    torch.testing.assert_close(rows.wrench, found[f"{name}/wrench"], atol=1e-5, rtol=1e-7)
    assert torch.equal(rows.transition.mode, found[f"{name}/mode"].long())
