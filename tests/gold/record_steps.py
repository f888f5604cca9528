"""Record contact steps: `python tests/gold/record_steps.py CHECKOUT` writes two .npz files.

CHECKOUT is a clone of the revision whose answers are the gold ones, 1747f21. What is stored are
inputs and outputs as plain arrays, so that tests of later revisions need nothing of that one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

HERE = Path(__file__).resolve().parent
CHECKOUT = Path(sys.argv[1]).resolve()
sys.path[:0] = [str(CHECKOUT), str(CHECKOUT / "tests")]

from contact_scenes import BOX, OUTLINES, SLAB, outline_points  # noqa: E402

from tpcd.contact import ContactScene, place_points  # noqa: E402
from tpcd.effects.catalogue import KNOWN  # noqa: E402
from tpcd.effects.conditions import sequence  # noqa: E402
from tpcd.effects.protocol import Added  # noqa: E402
from tpcd.effects.simulate import simulate_rows  # noqa: E402
from tpcd.planar import transform_points  # noqa: E402
from tpcd.simulator import StepSettings, simulate_step  # noqa: E402
from tpcd.terrain import HalfPlane, floor, wall  # noqa: E402

SETTINGS = (
    {},
    {"substeps": 1},
    {"friction": "anitescu", "substeps": 1},
    {"substeps": 4, "follow_path": True},
)
EACH = 500
"""Problems of each of the four settings."""
MOST_TOUCHED = 8
"""Outline points whose gradient is kept for each problem; all others have none."""
PARTICLES, ROWS = 6, 12
INPUTS = ("points", "start", "previous", "command", "stiffness")


def main() -> None:
    """Record steps, gradients and effects."""
    torch.set_num_threads(1)
    every = [*(outline_points(name) for name in OUTLINES), BOX, SLAB]
    most = max(len(points) for points in every)
    outlines = torch.stack([_padded(points, most) for points in every])
    stored: dict[str, np.ndarray] = {"outlines": outlines.numpy()}
    for k, choices in enumerate(SETTINGS):
        problem = _problems(outlines, torch.Generator().manual_seed(100 + k), EACH)
        answer = _answers(outlines, problem, StepSettings(**choices))
        for name, value in {**problem, **answer}.items():
            stored[f"{k}/{name}"] = value.numpy()
    np.savez_compressed(HERE / "steps.npz", **stored)
    np.savez_compressed(HERE / "effects.npz", **_effects(outlines))


def _padded(points: Tensor, most: int) -> Tensor:
    """Repeated points change nothing: they touch where the first one does."""
    return torch.cat((points, points[:1].expand(most - len(points), 2)))


def _problems(outlines: Tensor, generator: torch.Generator, count: int) -> dict[str, Tensor]:
    """Contact problems of every kind: free, pressed, sliding, turning, wedged in a corner, on
    tilted, soft and rough terrains, from rest under a load or from a measured pose."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        draw = torch.rand(count, *shape, generator=generator, dtype=torch.float64)
        return low + (high - low) * draw

    def chance(share: float, *shape: int) -> Tensor:
        return uniform(0, 1, *shape) < share

    which = torch.randint(len(outlines), (count,), generator=generator)
    mount = torch.cat((uniform(-0.02, 0.02, 2), uniform(-0.2, 0.2, 1)), dim=-1)
    mount = torch.where(chance(0.1)[:, None], 0.0, mount)
    scale = uniform(0.8, 1.2)
    points = place_points(outlines[which], scale, mount)
    tilt = torch.where(chance(0.3, 2), uniform(-0.2, 0.2, 2), 0.0)
    angles = tilt + torch.tensor((torch.pi / 2, torch.pi), dtype=torch.float64)
    normal = torch.stack((angles.cos(), angles.sin()), dim=-1)
    normal = torch.where(normal.abs() < 1e-15, 0.0, normal)
    offset = torch.stack((uniform(-0.02, 0.02), -uniform(0.09, 0.18)), dim=-1)
    friction = torch.where(chance(0.1)[:, None], uniform(0.9, 3.0, 2), uniform(0.1, 0.9, 1))
    friction = torch.where(chance(0.05)[:, None], 0.0, friction)
    compliance = torch.where(chance(0.2)[:, None] & chance(0.7, 2), uniform(1e-5, 2e-3, 2), 0.0)
    base = torch.tensor((100.0, 100.0, 50.0), dtype=torch.float64)
    stiffness = torch.where(chance(0.3)[:, None], base * 10 ** uniform(-0.7, 1.0, 3), base)
    poses = []
    depth = torch.where(chance(0.3, 2), uniform(-3e-4, 3e-4, 2), -uniform(0, 0.02, 2))
    depth = torch.where(chance(0.4, 2), 0.0, depth)
    press = torch.where(chance(0.7, 2), uniform(0, 0.05, 2), -uniform(0, 0.03, 2))
    before = torch.where(chance(0.5, 2), uniform(0, 0.02, 2), -uniform(0, 0.01, 2))
    for inside in (depth, press, before):
        angle = torch.where(chance(0.2), 0.0, uniform(-0.15, 0.15))
        turned = transform_points(torch.stack((0 * angle, 0 * angle, angle), dim=-1), points)
        x = -offset[:, 1] - turned[..., 0].amax(-1) + inside[:, 0]
        z = offset[:, 0] - turned[..., 1].amin(-1) - inside[:, 1]
        poses.append(torch.stack((x, z, angle), dim=-1))
    start, command, previous = poses
    return {
        "outline": which,
        "mount": mount,
        "scale": scale,
        "normal": normal,
        "offset": offset,
        "friction": friction,
        "compliance": compliance,
        "stiffness": stiffness,
        "start": start,
        "command": command,
        # NaN: the arm rested in the start pose without a load.
        "previous": torch.where(chance(0.4)[:, None], torch.nan, previous),
    }


def _scene(points: Tensor, problem: dict[str, Tensor]) -> ContactScene:
    planes = zip(problem["normal"].unbind(-2), problem["offset"].unbind(-1), strict=True)
    return ContactScene(
        points,
        tuple(HalfPlane(normal, offset) for normal, offset in planes),
        problem["friction"],
        problem["compliance"],
    )


def _answers(
    outlines: Tensor, problem: dict[str, Tensor], settings: StepSettings
) -> dict[str, Tensor]:
    """Answers of the compiled step, and gradients of a random number made of pose and wrench."""
    points = place_points(outlines[problem["outline"]], problem["scale"], problem["mount"])
    pulls = torch.randn(
        len(points), 6, generator=torch.Generator().manual_seed(7), dtype=torch.float64
    )
    rested = problem["previous"].isnan().any(-1)
    found: dict[str, Tensor] = {"pulls": pulls}
    for group in (rested, ~rested):
        index = torch.nonzero(group).flatten()
        part = {name: value[index].clone() for name, value in problem.items()}
        previous = None if bool(rested[index[0]]) else part["previous"]
        given = {"points": points[index], **{name: part[name] for name in INPUTS[1:]}}
        moved = (*given, "normal", "offset", "friction", "compliance")
        answer = simulate_step(
            _scene(given["points"], part), part["start"], part["command"], part["stiffness"],
            settings, engine="native", previous=previous,
        )  # fmt: skip
        kept = {name: value.detach() for name, value in vars(answer).items()}
        given.update({name: part[name] for name in moved[5:]})
        if previous is None:
            given.pop("previous")
        given = {name: value.requires_grad_() for name, value in given.items()}
        answer = simulate_step(
            _scene(given["points"], given), given["start"], given["command"], given["stiffness"],
            settings, engine="torch", previous=given.get("previous"),
        )  # fmt: skip
        kept["torch_pose"] = answer.pose.detach()
        number = (torch.cat((answer.pose, 1e-2 * answer.wrench), -1) * pulls[index]).sum()
        slopes = torch.autograd.grad(number, list(given.values()))
        for name, slope in zip(given, slopes, strict=True):
            if name != "points":
                kept[f"d_{name}"] = slope
                continue
            touched = slope.abs().sum(-1).topk(MOST_TOUCHED).indices
            kept["touched"] = touched
            kept["d_points"] = slope.gather(1, touched[..., None].expand(-1, -1, 2))
            assert int((slope.abs().sum(-1) > 0).sum(-1).amax()) <= MOST_TOUCHED
        if previous is None:
            kept["d_previous"] = torch.full_like(kept["d_start"], torch.nan)
        for name, value in kept.items():
            whole = found.setdefault(name, value.new_zeros(len(points), *value.shape[1:]))
            whole[index] = value
    return found


def _effects(outlines: Tensor) -> dict[str, np.ndarray]:
    """Rows of an arm that presses a mug into a corner and slides, under every effect by itself."""
    generator = torch.Generator().manual_seed(11)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    mount = torch.cat((uniform(-0.01, 0.01, PARTICLES, 2), uniform(-0.1, 0.1, PARTICLES, 1)), -1)
    points = place_points(
        outlines[2].expand(PARTICLES, -1, -1), uniform(0.9, 1.1, PARTICLES), mount
    )
    height, position = uniform(-0.01, 0.01, PARTICLES), uniform(0.1, 0.15, PARTICLES)
    friction = uniform(0.2, 0.8, PARTICLES, 1).expand(-1, 2).contiguous()
    scene = ContactScene(points, (floor(height), wall(position)), friction)
    low = float(points[..., 1].amin())
    right = float(points[..., 0].amax())
    commands = torch.stack((
        uniform(-0.04, 0.03, ROWS) + 0.12 - right,
        uniform(-0.03, 0.01, ROWS) - low,
        uniform(-0.1, 0.1, ROWS),
    ), -1)  # fmt: skip
    commands[0] = torch.tensor((0.0, 0.1 - low, 0.0))
    stiffness = torch.tensor((100.0, 100.0, 50.0), dtype=torch.float64)
    rest = simulate_step(
        ContactScene(points[:1], (floor(height[:1]), wall(position[:1])), friction[:1]),
        commands[:, None], commands[:, None], stiffness,
    ).pose[:, 0]  # fmt: skip
    rest[0] = commands[0]
    stored = {
        "points": points, "height": height, "position": position, "friction": friction,
        "commands": commands, "poses": rest, "stiffness": stiffness,
    }  # fmt: skip
    for effect in KNOWN:
        values = torch.stack([uniform(p.low, p.high, PARTICLES) for p in effect.parameters], dim=-1)
        rows = simulate_rows(
            scene, sequence(rest), commands, stiffness, Added((effect,), values), StepSettings()
        )
        stored |= {
            f"{effect.name}/values": values,
            f"{effect.name}/pose": rows.transition.pose,
            f"{effect.name}/mode": rows.transition.mode,
            f"{effect.name}/status": rows.transition.status,
            f"{effect.name}/wrench": rows.wrench,
        }
    return {name: value.numpy() for name, value in stored.items()}


if __name__ == "__main__":
    main()
