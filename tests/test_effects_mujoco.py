"""Surfaces that yield: the model's steps against MuJoCo's sprung bodies, which know none of it."""

from __future__ import annotations

import pytest
import torch

from tpcd.contact import ContactScene
from tpcd.effects.conditions import sequence
from tpcd.effects.simulate import simulate_rows
from tpcd.effects.truth import TRUE_PASSES, added_effects
from tpcd.random import stream
from tpcd.shape.builtin import builtin_outlines
from tpcd.simulator.truth import TRUTH_SETTINGS
from tpcd.terrain import floor, wall
from tpcd.truth.injected import InjectedMujocoTruth
from tpcd.truth.recording import Policy, make_motion, record
from tpcd.truth.scene import draw_scene

YIELDS = {"compliance": 2.5e-4}
FLOOR, WALL, SIDEWAYS = "floor_compliance", "wall_compliance", "tangential_compliance"


def errors(
    names: tuple[str, ...], policy: Policy, outline: str = "mug", rows: int = 20
) -> tuple[torch.Tensor, int]:
    """How far x and z end from MuJoCo [m], row by row and one step at a time from where MuJoCo
    stood, and in how many rows floor and wall hold the object."""
    hidden = dict.fromkeys(names, YIELDS)
    scene = draw_scene(outline, builtin_outlines()[outline].vertices, stream(901, 1))
    truth = InjectedMujocoTruth(scene, hidden, rows)
    motion = make_motion(policy, scene, rows, stream(901, 2))
    recorded = record(truth, scene, motion, rows, stream(901, 3)).true
    one = torch.ones(1, dtype=torch.float64)
    contact = ContactScene(
        scene.vertices_ee.double()[None],
        (floor(scene.floor_height * one), wall(scene.wall_position * one)),
        torch.full((1, 2), scene.friction, dtype=torch.float64),
    )
    found = simulate_rows(
        contact,
        sequence(recorded.poses),
        recorded.commands,
        scene.stiffness,
        added_effects(hidden),
        TRUTH_SETTINGS,
        TRUE_PASSES,
    )
    off = (found.transition.pose[0] - recorded.poses[found.index]).abs()
    assert len(off) == rows
    return off[:, :2], int((found.transition.mode[0] > 0).all(-1).sum())


@pytest.mark.parametrize(
    "names",
    [(FLOOR,), (WALL,), (SIDEWAYS,), (FLOOR, WALL, SIDEWAYS)],
    ids=lambda names: "+".join(names),
)
def test_every_row_of_a_diagnosis_ends_where_mujoco_ends(names: tuple[str, ...]) -> None:
    """0.25 mm are 25 mN at 100 N/m."""
    off, _ = errors(names, "diagnosis")
    assert float(off.quantile(0.9)) < 2e-5
    # Where contact changes on both surfaces at once; a grip that is lost costs three times as much.
    assert float(off.max()) < 2.5e-4


@pytest.mark.parametrize("outline", ["mug", "milk_carton"])
@pytest.mark.parametrize(
    "names", [(FLOOR,), (WALL,), (FLOOR, WALL)], ids=lambda names: "+".join(names)
)
def test_so_does_every_row_of_press_and_slide(names: tuple[str, ...], outline: str) -> None:
    """Where floor and wall hold the object together, and their springs share its load."""
    off, between = errors(names, "press_and_slide", outline)
    assert between >= 5
    assert float(off.max()) < 1e-4
