"""The quasi-static step in compiled loops: tensors in, tensors out.

Used by itself on the CPU where numba is installed and no gradient is asked. The few elements
that are jammed even without friction come back unanswered, for the torch path to finish.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.contact import ContactScene, place_points
from tpcd.loops import available
from tpcd.parameters import Parameters
from tpcd.planar import wrap_angle
from tpcd.simulator.record import DEGREES, StepSettings, StepStatus, Transition
from tpcd.terrain import HalfPlane

if TYPE_CHECKING:
    from tpcd.shape.protocol import Shape
    from tpcd.simulator.kernel_geometry import World
    from tpcd.simulator.kernel_request import Request
    from tpcd.simulator.kernel_space import Law

JAMMED = int(StepStatus.INVALID_INPUT) + 1
"""Status of an element that the compiled loops leave to the torch path."""
CHUNK = 64
"""Fewest transitions handed to a thread at once."""
_ROWS = 512
"""Rows for which `over_threads` takes one more thread: small torch operations in two threads wait
for the interpreter, and for each other. By the time that 100 to 3000 latents take to decode."""


def thread_count() -> int:
    """Threads for compiled loops: OMP_NUM_THREADS where it is set, else the usable cores."""
    limit = os.environ.get("OMP_NUM_THREADS", "")
    usable = getattr(os, "sched_getaffinity", None)
    cores = len(usable(0)) if usable else os.cpu_count() or 1
    return int(limit) if limit.isdecimal() and int(limit) > 0 else cores


def in_parts(work: Callable[[int, int], None], count: int, transitions: int = 1) -> None:
    """Call `work(first, last)` on parts of `count` elements, in as many threads as allowed.

    Each element is so many transitions of work.

    The compiled loops release the interpreter lock. Threads of our own keep them apart from
    the OpenMP of torch, whose number of threads numba's parallel loops would reset, and whose
    threads make the small operations around these loops slow on a busy machine.
    """
    chunks = min(count, math.ceil(count * transitions / CHUNK))
    threads = min(thread_count(), chunks)
    if threads <= 1:
        work(0, count)
        return
    parts = min(4 * threads, chunks)
    bounds = [part * count // parts for part in range(parts + 1)]
    list(_pool(threads).map(work, bounds[:-1], bounds[1:]))


def outlines(shape: Shape, parameters: Parameters) -> Float[Tensor, "m p 2"]:
    """Outline points of m particles in the end-effector frame [m], decoded in the same threads.

    Records no gradient.
    """
    points = decode(shape, parameters.latent)
    with torch.no_grad():
        return place_points(points, parameters.scale, parameters.mount)


def decode(shape: Shape, latent: Float[Tensor, "m z"]) -> Float[Tensor, "m p 2"]:
    """Outline points of m latents in the object frame [m], in the same threads, no gradient."""
    return torch.cat(over_threads(shape.boundary_points, latent))


Answer = TypeVar("Answer")
Work = TypeVar("Work", bound=Callable[..., Any])


def over_threads(
    work: Callable[[Tensor], Answer], rows: Tensor, most: int | None = None
) -> list[Answer]:
    """What `work` answers to parts of some rows on the CPU, of so many rows at `most`, in order,
    in a thread for every `_ROWS` rows, as many as allowed. Records no gradient."""

    def alone(own: Tensor) -> Answer:
        # Whether gradients are recorded is a setting of each thread.
        with torch.no_grad():
            return work(own)

    threads = min(thread_count(), math.ceil(len(rows) / _ROWS))
    parts = threads if most is None else max(threads, math.ceil(len(rows) / most))
    if parts <= 1:
        return [alone(rows)]
    each = rows.tensor_split(parts)
    return list(map(alone, each) if threads <= 1 else _pool(threads).map(alone, each))


def torch_in_one_thread(work: Work) -> Work:
    """The same with torch in one thread where there are compiled loops, whose threads it would
    only get in the way of: between them its operations are small. Its answers then do not depend
    on how many threads torch may take."""

    @wraps(work)
    def alone(*given: Any, **named: Any) -> Any:
        allowed = torch.get_num_threads()
        if not available() or allowed == 1:
            return work(*given, **named)
        torch.set_num_threads(1)
        try:
            return work(*given, **named)
        finally:
            torch.set_num_threads(allowed)

    return cast(Work, alone)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="tpcd")


def step(
    scene: ContactScene,
    owner: Int[Tensor, " b"],
    start: Float[Tensor, "b 3"],
    previous: Float[Tensor, "b 3"] | None,
    command: Float[Tensor, "b 3"],
    stiffness: Float[Tensor, "#b 3"],
    settings: StepSettings,
) -> Transition:
    """Step b transitions; `owner` gives the position of each one's scene in the flat batch. All
    of these scenes are rigid, or all have terrain that yields.

    Outlines may broadcast against the planes of the scene and are then not repeated.
    """
    from tpcd.simulator.kernel import step_range
    from tpcd.simulator.kernel_request import Answer

    count, terrains = len(owner), len(scene.terrains)
    pose = torch.empty(count, 3, dtype=torch.float64)
    mode = torch.empty(count, terrains, dtype=torch.int64)
    status = torch.empty(count, dtype=torch.int64)
    residual = torch.empty(count, dtype=torch.float64)
    from_start = torch.empty(count, 3, 3, dtype=torch.float64)
    from_gap = torch.empty(count, terrains, 3, dtype=torch.float64)
    from_lever = torch.empty(count, terrains, 3, dtype=torch.float64)
    contacts = torch.empty(count, terrains, 4, dtype=torch.float64)
    yielding = terrains if bool(scene.yields.reshape(-1)[owner].any()) else 0
    world, law = world_of(scene), law_of(settings, yielding)
    request = request_of(scene, owner, start, previous, command, stiffness, settings)
    answer = Answer(
        pose.numpy(),
        mode.numpy(),
        status.numpy(),
        residual.numpy(),
        from_start.numpy(),
        from_gap.numpy(),
        from_lever.numpy(),
        contacts.numpy(),
    )
    in_parts(lambda first, last: step_range(world, law, request, answer, first, last), count)
    turn = start[:, 2].double() + wrap_angle(command[:, 2].double() - start[:, 2].double())
    target = torch.cat((command[:, :2].double(), turn[:, None]), dim=-1)
    wrench = stiffness.double() * (pose - target)
    pose[:, 2] = wrap_angle(pose[:, 2])
    return Transition(
        pose, wrench, mode, status, residual, from_start, from_gap, from_lever, contacts
    )


def world_of(scene: ContactScene) -> World:
    """The scenes of a flat batch against half-planes, as the compiled loops read them."""
    from tpcd.simulator.kernel_geometry import World

    terrains = len(scene.terrains)
    planes = [body for body in scene.terrains if isinstance(body, HalfPlane)]
    points = scene.points_ee.detach().double()
    points = points.reshape(-1, *points.shape[-2:]).mT.contiguous()
    normals = torch.stack([p.direction.detach() for p in planes], -2)
    offsets = torch.stack([p.offset.detach() for p in planes], -1)
    return World(
        points.numpy(),
        _flat(normals, terrains, 2),
        _flat(offsets, terrains),
        _flat(scene.friction.detach(), terrains),
        _flat(scene.compliance.detach(), terrains),
    )


def law_of(settings: StepSettings, yielding: int = 0) -> Law:
    """Settings as the compiled loops read them, for so many terrains that may be `yielding`; the
    stiffness is set for each transition."""
    from tpcd.simulator.kernel_space import Law

    return Law(
        np.ones(3),
        np.ones(3),
        settings.friction == "coulomb",
        settings.rounds,
        settings.tolerance,
        (0.0,) * (DEGREES + yielding),
    )


def request_of(
    scene: ContactScene,
    owner: Int[Tensor, " b"],
    start: Float[Tensor, "b 3"],
    previous: Float[Tensor, "b 3"] | None,
    command: Float[Tensor, "b 3"],
    stiffness: Float[Tensor, "#b 3"],
    settings: StepSettings,
) -> Request:
    """Transitions, as the compiled loops read them."""
    from tpcd.simulator.kernel_request import Request

    outlines = scene.points_ee.shape[:-2]
    mine = torch.arange(outlines.numel()).reshape(outlines).expand(scene.batch_shape).reshape(-1)
    return Request(
        mine[owner].numpy(),
        owner.contiguous().numpy(),
        _flat(stiffness.detach(), 3),
        _flat(start.detach(), 3),
        _flat((start if previous is None else previous).detach(), 3),
        _flat(command.detach(), 3),
        previous is None,
        settings.substeps,
        settings.finest,
        settings.largest_turn,
        settings.follow_path,
    )


def _flat(tensor: Tensor, *shape: int):
    return tensor.double().reshape(-1, *shape).contiguous().numpy()
