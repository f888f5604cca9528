"""Outlines laid over an uneven floor: compiled loops against torch."""

from __future__ import annotations

import math

import pytest
import torch

from tpcd.effects import uneven
from tpcd.effects.uneven import RELIEFS, _Seen

pytest.importorskip("numba")

D = torch.float64
VALUES = {"step": (0.004, 0.05), "wave": (0.003, -0.002, 0.05), "bump": (0.004, 0.06, 0.012)}
RELIEF_OF = {"step": uneven._step, "wave": uneven._wave, "bump": uneven._bump}


def given(count: int = 5, rows: int = 20, points: int = 60, seed: int = 0) -> _Seen:
    """Ellipses over planes; the first row stays."""
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
    return _Seen(outline, view, normal, 0.01 * drawn(count, rows), stays)


def both(name: str, seen: _Seen) -> zip:
    """What torch and compiled loops say of the warp, the normals and the offsets."""
    values = torch.tensor([VALUES[name]], dtype=D)
    compiled = uneven._laid_compiled(seen, values, RELIEF_OF[name])
    assert compiled is not None
    return zip(uneven._laid(seen, values, RELIEF_OF[name]), compiled, strict=True)


@pytest.mark.parametrize("name", VALUES)
def test_compiled_loops_lay_outlines_as_torch_does(name: str) -> None:
    """Tangents at a steep place are 1e-5 off, and with them points that are far away."""
    seen = given()
    (warp, own_warp), (normal, own_normal), (offset, own_offset) = both(name, seen)
    assert warp.abs().max() > 1e-3
    assert torch.allclose(own_normal, normal, rtol=0, atol=2e-5)
    assert torch.allclose(own_offset, offset, rtol=0, atol=1e-6)
    assert torch.allclose(own_warp, warp, rtol=0, atol=3e-6)

    def height(warp: torch.Tensor, normal: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        """Of every point over the tangent, where that is near."""
        placed = uneven.rotate(seen.view[..., 2:], seen.outline[:, None] + warp)
        placed = placed + seen.view[..., None, :2]
        above = ((placed * normal[..., None, :]).sum(-1) - offset[..., None]) / normal[..., 1:]
        return above.clamp_max(uneven.NEAR)

    own, true = height(own_warp, own_normal, own_offset), height(warp, normal, offset)
    assert torch.allclose(own, true, rtol=0, atol=2e-8)


def test_rows_that_stay_and_reliefs_of_no_height_change_nothing() -> None:
    seen = given()
    for values, stays in ((VALUES["bump"], True), ((0.0, 0.06, 0.012), False)):
        still = torch.full_like(seen.stays, stays)
        row = torch.tensor([values], dtype=D)
        laid = uneven._laid_compiled(seen._replace(stays=still), row, uneven._bump)
        assert laid is not None and not laid[0].any()
        assert torch.equal(laid[1], seen.normal) and torch.equal(laid[2], seen.offset)


def test_a_pose_that_is_no_number_spoils_its_own_row_alone() -> None:
    seen = given()
    whole = [compiled for _, compiled in both("step", seen)]
    seen.view[2, 5, 0] = torch.nan
    (_, warp), (_, normal), (_, offset) = both("step", seen)
    assert offset[2, 5].isnan() and int(offset.isnan().sum()) == 1
    for found, before in zip((warp, normal, offset), whole, strict=True):
        others = torch.ones(found.shape[:2], dtype=torch.bool)
        others[2, 5] = False
        assert torch.equal(found[others], before[others])


def test_an_outline_that_is_no_number_spoils_its_own_particle_alone() -> None:
    seen = given()
    whole = [compiled for _, compiled in both("bump", seen)]
    seen.outline[3, 7] = torch.nan
    others = torch.arange(5) != 3
    for (_, found), before in zip(both("bump", seen), whole, strict=True):
        assert torch.equal(found[others], before[others]) and found[3, 1:].isnan().any()


def test_gradients_and_long_ways_are_left_to_torch() -> None:
    seen = given()
    values = torch.tensor(VALUES["bump"], dtype=D).expand(5, -1)
    slope = values.clone().requires_grad_()
    assert uneven._laid_compiled(seen, slope, uneven._bump) is None
    seen.view[0, 3, 0] = 30.0
    assert uneven._laid_compiled(seen, values, uneven._bump) is None


def test_every_relief_is_tested_here() -> None:
    assert {effect.name for effect in RELIEFS} == {f"floor_height ~ {name}" for name in VALUES}
