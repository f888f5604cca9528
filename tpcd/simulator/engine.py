"""The quasi-static step as tensors in, tensors out: a flat batch through the compiled loops."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.simulator.record import DEGREES, StepSettings
from tpcd.terrain import Relief
from tpcd.threads import in_parts

if TYPE_CHECKING:
    from tpcd.geometry.surfaces import HalfPlanes, SurfaceTable
    from tpcd.simulator.workspace import Law, Tape


class Asked(NamedTuple):
    """A flat batch of b transitions in float64 on the CPU, as `simulate_step` makes it."""

    points: Float[Tensor, "o p 2"]
    normals: Float[Tensor, "s t 2"]
    offsets: Float[Tensor, "s t"]
    friction: Float[Tensor, "s t"]
    compliance: Float[Tensor, "s t"]
    start: Float[Tensor, "b 3"]
    previous: Float[Tensor, "b 3"] | None
    command: Float[Tensor, "b 3"]
    stiffness: Float[Tensor, "#b 3"]
    reliefs: tuple[Relief | None, ...]
    """Of each terrain."""
    outline: Int[Tensor, " b"]
    """Whose points each transition has."""
    scene: Int[Tensor, " b"]
    """Whose planes, friction and compliance; all of these scenes are rigid, or all have terrain
    that yields."""


class Answered(NamedTuple):
    """What the compiled loops answer; `pose` goes the short way round from the start."""

    pose: Float[Tensor, "b 3"]
    mode: Int[Tensor, "b t"]
    status: Int[Tensor, " b"]
    residual: Float[Tensor, " b"]
    from_start: Float[Tensor, "b 3 3"]
    from_gap: Float[Tensor, "b t 3"]
    from_lever: Float[Tensor, "b t 3"]
    contacts: Float[Tensor, "b t 4"]
    from_inputs: Float[Tensor, "b i 3"]
    from_points: Float[Tensor, "b p 2 3"]


def step(
    asked: Asked,
    settings: StepSettings,
    gradient: bool = False,
    device: torch.device | None = None,
) -> Answered:
    """Step b transitions. With `gradient` also derivatives of the pose by everything else that is
    given: rows by friction (t), compliance (t), angle of the normal (t), stiffness (3), command
    before (3) and command (3), and by the outline points. A backend other than `native` works on
    the `device` (None: the CPU)."""
    from tpcd.geometry.candidates import World
    from tpcd.simulator.backends import solved_by
    from tpcd.simulator.batch import step_range
    from tpcd.simulator.request import Answer, Request

    count, terrains = len(asked.start), asked.offsets.shape[-1]
    inputs, points = (3 * terrains + 9, asked.points.shape[1]) if gradient else (0, 0)
    answered = Answered(
        pose=torch.empty(count, 3, dtype=torch.float64),
        mode=torch.empty(count, terrains, dtype=torch.int64),
        status=torch.empty(count, dtype=torch.int64),
        residual=torch.empty(count, dtype=torch.float64),
        from_start=torch.empty(count, 3, 3, dtype=torch.float64),
        from_gap=torch.empty(count, terrains, 3, dtype=torch.float64),
        from_lever=torch.empty(count, terrains, 3, dtype=torch.float64),
        contacts=torch.empty(count, terrains, 4, dtype=torch.float64),
        from_inputs=torch.empty(count, inputs, 3, dtype=torch.float64),
        from_points=torch.empty(count, points, 2, 3, dtype=torch.float64),
    )
    world = World(
        asked.points.detach().mT.contiguous().numpy(),
        _table(asked),
        np.zeros(1, np.int64),
        np.zeros((1, terrains)),
        _array(asked.friction),
        _array(asked.compliance),
    )
    yields = bool((asked.compliance[asked.scene] != 0).any())
    law = law_of(settings, terrains if yields else 0)
    request = Request(
        asked.outline.contiguous().numpy(),
        asked.scene.contiguous().numpy(),
        _array(asked.stiffness),
        _array(asked.start),
        _array(asked.start if asked.previous is None else asked.previous),
        _array(asked.command),
        asked.previous is None,
        settings.substeps,
        settings.finest,
        settings.largest_turn,
        settings.follow_path,
    )
    answer = Answer(*(value.numpy() for value in answered))

    def run(tape: Tape) -> None:
        work = partial(step_range, world, law, request, answer, tape)
        in_parts(work, count)

    wanted = np.ones(count, np.bool_)
    solved_by(settings.solver, run, wanted, len(law.room), terrains, device or torch.device("cpu"))
    return answered


def _table(asked: Asked) -> HalfPlanes | SurfaceTable:
    """The surfaces as the compiled loops read them: half-planes alone are the fast case."""
    from tpcd.geometry.surfaces import HEIGHT_FIELD, PLANE, HalfPlanes, SurfaceTable

    normal, offset = _array(asked.normals), _array(asked.offsets)
    reliefs = asked.reliefs
    if not any(reliefs):
        return HalfPlanes(normal, offset)
    flat = Relief(torch.zeros(2).double(), torch.zeros(2).double(), 0, 1.0)
    every = [relief or flat for relief in reliefs]
    size = max(len(relief.rise) for relief in every)
    heights = np.zeros((2, len(every), size))
    for t, relief in enumerate(every):
        heights[0, t, : len(relief.rise)] = relief.rise.numpy()
        heights[1, t, : len(relief.rise)] = relief.slope.numpy()
    return SurfaceTable(
        np.array([HEIGHT_FIELD if relief else PLANE for relief in reliefs]),
        normal,
        offset,
        heights[0].copy(),
        heights[1].copy(),
        np.array([len(relief.rise) - 1 for relief in every]),
        np.array([relief.first for relief in every]),
        np.array([relief.pitch for relief in every]),
        np.array([float(relief.rise.max() - relief.rise.min()) for relief in every]),
    )


def law_of(settings: StepSettings, yielding: int = 0) -> Law:
    """Settings as the compiled loops read them, for so many terrains that may be `yielding`; the
    stiffness is set for each transition."""
    from tpcd.simulator.workspace import Law

    return Law(
        np.ones(3),
        np.ones(3),
        settings.friction == "coulomb",
        settings.rounds,
        settings.tolerance,
        (0.0,) * (DEGREES + yielding),
    )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
