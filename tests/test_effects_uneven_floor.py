"""Outlines laid over an uneven floor, against the formulas."""

from __future__ import annotations

import math

import pytest
import torch

from tpcd.effects import uneven
from tpcd.effects.uneven import RELIEFS, _Seen
from tpcd.planar import rotate

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


def by_formula(
    seen: _Seen, values: torch.Tensor, relief: uneven.Relief
) -> tuple[torch.Tensor, ...]:
    """What points are moved by, normals and offsets of tangents, with the relief at every point."""
    outline, view, normal, offset, stays = seen
    angle = view[..., 2:]
    x, z = (rotate(angle, outline[:, None]) + view[..., None, :2]).unbind(-1)
    rise, slope = relief(values, x)
    flat = stays[:, None] | ((rise == 0) & (slope == 0)).all(-1, keepdim=True)
    across, along = normal[..., :1], normal[..., 1:]
    floor = (offset[..., None] - across * x) / along + rise
    slope = slope - across / along
    gap = z - floor
    nearest = (gap * (1 + slope**2).rsqrt()).argmin(-1, keepdim=True)
    at_x, at_z, steep = (value.gather(-1, nearest) for value in (x, floor, slope))
    above = z - (at_z + steep * (x - at_x))
    up = torch.where(gap < uneven.NEAR, gap, above.clamp_min(uneven.NEAR)) - above
    up = torch.where(flat, 0.0, up)
    length = (1 + steep**2).sqrt()
    tangent = torch.cat((-steep, torch.ones_like(steep)), dim=-1) / length
    through = torch.where(flat[..., 0], offset, ((at_z - steep * at_x) / length)[..., 0])
    warp = up[..., None] * torch.stack((angle.sin(), angle.cos()), dim=-1)
    return warp, torch.where(flat, normal, tangent), through


def both(name: str, seen: _Seen) -> zip:
    """The warp, the normals and the offsets by formula, and as they are."""
    values = torch.tensor([VALUES[name]], dtype=D)
    found = uneven._laid(seen, values, RELIEF_OF[name])
    return zip(by_formula(seen, values, RELIEF_OF[name]), found, strict=True)


@pytest.mark.parametrize("name", VALUES)
def test_outlines_are_laid_as_the_formula_says(name: str) -> None:
    """Tangents at a steep place are 1e-5 off, and with them points that are far away."""
    seen = given()
    (warp, own_warp), (normal, own_normal), (offset, own_offset) = both(name, seen)
    assert warp.abs().max() > 1e-3
    assert torch.allclose(own_normal, normal, rtol=0, atol=2e-5)
    assert torch.allclose(own_offset, offset, rtol=0, atol=1e-6)
    assert torch.allclose(own_warp, warp, rtol=0, atol=3e-6)

    def height(warp: torch.Tensor, normal: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        """Of every point over the tangent, where that is near."""
        placed = rotate(seen.view[..., 2:], seen.outline[:, None] + warp)
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
        laid = uneven._laid(seen._replace(stays=still), row, uneven._bump)
        assert not laid[0].any()
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


def test_along_as_much_floor_as_an_arm_reaches_a_relief_is_as_by_the_formula() -> None:
    """It is looked up three times as far apart there: 5 um of a step."""
    seen = given()
    seen.view[0, 3, 0] = 4.9
    for name in VALUES:
        (_, _), (_, _), (offset, own_offset) = both(name, seen)
        assert torch.allclose(own_offset, offset, rtol=0, atol=2e-5)


def test_every_relief_is_tested_here() -> None:
    assert {effect.name for effect in RELIEFS} == {f"floor_height ~ {name}" for name in VALUES}
