"""Outlines laid over an uneven floor: compiled loops against torch."""

from __future__ import annotations

import math

import pytest
import torch

from tpcd.effects import uneven
from tpcd.effects.uneven import RELIEFS

pytest.importorskip("numba")

D = torch.float64
VALUES = {"step": (0.004, 0.05), "wave": (0.003, -0.002, 0.05), "bump": (0.004, 0.06, 0.012)}
RELIEF_OF = {"step": uneven._step, "wave": uneven._wave, "bump": uneven._bump}


def given(count: int = 5, rows: int = 20, points: int = 60, seed: int = 0) -> list[torch.Tensor]:
    """Outlines, poses, planes and which rows stay: the first."""
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=D)

    around = torch.linspace(0, 2 * math.pi, points + 1, dtype=D)[:-1]
    ellipse = torch.stack((0.04 * around.cos(), 0.06 * around.sin()), dim=-1)
    outline = ellipse * (1 + 0.2 * drawn(count, 1, 1))
    view = torch.stack(
        (0.15 * drawn(count, rows), 0.05 + 0.03 * drawn(count, rows), drawn(count, rows) - 0.5), -1
    )
    tilt = 0.1 * (drawn(count, rows) - 0.5)
    normal = torch.stack((tilt.sin(), tilt.cos()), dim=-1)
    stays = torch.arange(rows) == 0
    return [outline, view, normal, 0.01 * drawn(count, rows), stays]


def both(name: str, *arguments: torch.Tensor) -> zip:
    """What torch and compiled loops say of the warp, the normals and the offsets."""
    values = torch.tensor(VALUES[name], dtype=D).expand(len(arguments[0]), -1)
    compiled = uneven._laid_compiled(*arguments, values, RELIEF_OF[name])
    assert compiled is not None
    return zip(uneven._laid(*arguments, values, RELIEF_OF[name]), compiled, strict=True)


@pytest.mark.parametrize("name", VALUES)
def test_compiled_loops_lay_outlines_as_torch_does(name: str) -> None:
    """Tangents at a steep place are 1e-5 off, and with them points that are far away."""
    arguments = given()
    (warp, own_warp), (normal, own_normal), (offset, own_offset) = both(name, *arguments)
    assert warp.abs().max() > 1e-3
    assert torch.allclose(own_normal, normal, rtol=0, atol=2e-5)
    assert torch.allclose(own_offset, offset, rtol=0, atol=1e-6)
    assert torch.allclose(own_warp, warp, rtol=0, atol=3e-6)

    def height(warp: torch.Tensor, normal: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        """Of every point over the tangent, where that is near."""
        placed = uneven.rotate(arguments[1][..., 2:], arguments[0][:, None] + warp)
        placed = placed + arguments[1][..., None, :2]
        above = ((placed * normal[..., None, :]).sum(-1) - offset[..., None]) / normal[..., 1:]
        return above.clamp_max(uneven.NEAR)

    own, true = height(own_warp, own_normal, own_offset), height(warp, normal, offset)
    assert torch.allclose(own, true, rtol=0, atol=2e-8)


def test_rows_that_stay_and_reliefs_of_no_height_change_nothing() -> None:
    outline, view, normal, offset, _ = arguments = given()
    for values, stays in ((VALUES["bump"], True), ((0.0, 0.06, 0.012), False)):
        still = torch.full((view.shape[1],), stays)
        given_values = torch.tensor(values, dtype=D).expand(len(outline), -1)
        laid = uneven._laid_compiled(*arguments[:4], still, given_values, uneven._bump)
        assert laid is not None and not laid[0].any()
        assert torch.equal(laid[1], normal) and torch.equal(laid[2], offset)


def test_a_pose_that_is_no_number_spoils_its_own_row_alone() -> None:
    arguments = given()
    whole = [compiled for _, compiled in both("step", *arguments)]
    arguments[1][2, 5, 0] = torch.nan
    (_, warp), (_, normal), (_, offset) = both("step", *arguments)
    assert offset[2, 5].isnan() and int(offset.isnan().sum()) == 1
    for found, before in zip((warp, normal, offset), whole, strict=True):
        others = torch.ones(found.shape[:2], dtype=torch.bool)
        others[2, 5] = False
        # Places at which the relief is looked up may be others.
        assert torch.allclose(found[others], before[others], rtol=0, atol=1e-5)


def test_gradients_and_long_ways_are_left_to_torch() -> None:
    arguments = given()
    values = torch.tensor(VALUES["bump"], dtype=D).expand(5, -1)
    slope = values.clone().requires_grad_()
    assert uneven._laid_compiled(*arguments, slope, uneven._bump) is None
    arguments[1][0, 3, 0] = 30.0
    assert uneven._laid_compiled(*arguments, values, uneven._bump) is None


def test_every_relief_is_tested_here() -> None:
    assert {effect.name for effect in RELIEFS} == {f"floor_height ~ {name}" for name in VALUES}
