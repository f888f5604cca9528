"""The parts of a filter step, each as a row of timings; what `eval.bench.step` prints.

Particles are draws from the prior of simulated episodes and transitions are short pushes on
floor and wall, so that most particles are in contact, as in a filter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from tpcd.belief.paper import PAPER_STEP
from tpcd.contact import ContactScene, column_scene, place_points, scene_from_parameters
from tpcd.parameters import DEFAULT_BOUNDS, SCENE_NAMES, Parameters
from tpcd.planar import wrap_angle
from tpcd.qp import ContactQP, solve
from tpcd.shape.protocol import Shape
from tpcd.simulator import StepSettings, StepStatus, Transition, simulate_step
from tpcd.terrain import floor, wall

STIFFNESS = (100.0, 100.0, 50.0)
"""Of the impedance [N/m, N/m, N·m/rad]."""
COVARIANCE = (30.0, 30.0, 0.3, 1e-4, 1e-4, 0.002)
"""Diagonal of the paper's R for wrench and pose."""
QP_ROWS = 16
"""Rows of the contact problems whose solution is timed alone."""
Timer = Callable[[Callable[[], Any]], dict[str, float]]


@dataclass(frozen=True)
class Work:
    """A filter step to do: m particles, and n transitions each of them must explain."""

    parameters: Parameters
    start: Tensor
    command: Tensor
    stiffness: Tensor

    @property
    def transitions(self) -> int:
        """Transitions to simulate, m n."""
        return len(self.parameters.scale) * len(self.start)


def make_work(shape: Shape, particles: int, memory: int, seed: int, device: torch.device) -> Work:
    """Draw particles from the prior, and pushes that touch for the median particle."""
    generator = torch.Generator().manual_seed(seed)
    latent = shape.sample_latent(particles, generator).double()
    low, high = torch.tensor([DEFAULT_BOUNDS[name] for name in SCENE_NAMES]).double().T
    uniform = torch.rand(particles, len(low), generator=generator, dtype=torch.float64)
    parameters = Parameters.from_vector(
        torch.cat((latent, low + uniform * (high - low)), dim=-1).to(device)
    )
    outline = place_points(
        shape.boundary_points(parameters.latent.float()).double(),
        parameters.scale,
        parameters.mount,
    )
    z = float(-outline[..., 1].amin(-1).median())
    x = float((parameters.wall_position - outline[..., 0].amax(-1)).median())
    random = torch.rand(memory, 6, generator=generator, dtype=torch.float64) - 0.5
    x = torch.where(torch.arange(memory) % 2 == 0, x, 0.0)
    start = torch.stack((x + 0.02 * random[:, 0], z + 0.01 * random[:, 1], 0.2 * random[:, 2]), -1)
    command = torch.stack(
        (x + 0.02 + 0.04 * random[:, 3], z - 0.03 + 0.02 * random[:, 4], 0.2 * random[:, 5]), -1
    )
    stiffness = torch.tensor(STIFFNESS, dtype=torch.float64, device=device)
    return Work(parameters, start.to(device), command.to(device), stiffness)


def filter_step_parts(
    shape: Shape, particles: int, memory: int, seed: int, device: torch.device, timed: Timer
) -> list[dict[str, Any]]:
    """Rows for shape, model and weights of the paper's step, and for all of it at once."""
    shape = _on(shape, device)
    work = make_work(shape, particles, memory, seed, device)
    scene = column_scene(decoded_scene(shape, work.parameters))
    transition = _simulate(scene, work, PAPER_STEP)

    def whole() -> Tensor:
        fresh = column_scene(decoded_scene(shape, work.parameters))
        return weights(work, _simulate(fresh, work, PAPER_STEP))

    parts = {
        "shape": lambda: decoded_scene(shape, work.parameters),
        "contact, with the QP": lambda: _simulate(scene, work, PAPER_STEP),
        "weights": lambda: weights(work, transition),
        "filter step": whole,
    }
    return [_row(name, work, timed(part), None) for name, part in parts.items()]


def model_rows(
    shape: Shape, particles: int, memory: int, seed: int, device: torch.device, timed: Timer
) -> list[dict[str, Any]]:
    """Rows for f_theta by friction and substeps, with gradients too, and for the QP alone."""
    shape = _on(shape, device)
    work = make_work(shape, particles, memory, seed, device)
    scene = column_scene(decoded_scene(shape, work.parameters))
    rows = []
    for friction in ("anitescu", "coulomb"):
        for substeps in (1, 10):
            settings = StepSettings(
                friction=friction, substeps=substeps, finest=1.0, follow_path=True
            )
            found = _simulate(scene, work, settings)
            times = timed(lambda s=settings: _simulate(scene, work, s))
            rows.append(_row(f"f_theta {friction} {substeps} substeps", work, times, found))
            times = timed(lambda s=settings: _gradient(scene, work, s))
            name = f"f_theta and gradient, {friction} {substeps} substeps"
            rows.append(_row(name, work, times, found))
    problem = contact_problem(work, device)
    times = timed(lambda: solve(problem))
    rows.append(_row(f"QP, {QP_ROWS} rows, one solve", work, times, None))
    return rows


def outline_rows(
    particles: int, memory: int, points: tuple[int, ...], seed: int, device: torch.device,
    timed: Timer,
) -> list[dict[str, Any]]:  # fmt: skip
    """Rows for f_theta against the number of outline points: ellipses, one for each particle."""
    rows = []
    generator = torch.Generator().manual_seed(seed)
    radii = 0.03 + 0.05 * torch.rand(particles, 1, 2, generator=generator, dtype=torch.float64)
    zeros = torch.zeros(particles, dtype=torch.float64)
    for count in points:
        angles = torch.arange(count, dtype=torch.float64) * (2 * torch.pi / count)
        outline = radii * torch.stack((angles.cos(), angles.sin()), dim=-1)
        scene = ContactScene(
            outline.to(device),
            (floor(zeros.to(device)), wall((zeros + 0.1).to(device))),
            torch.full((particles, 2), 0.4, dtype=torch.float64, device=device),
        )
        pushes = torch.rand(memory, 3, generator=generator, dtype=torch.float64).to(device)
        start = pushes * pushes.new_tensor((0.02, 0.02, 0.1)) + pushes.new_tensor((0, 0.06, 0))
        command = start + pushes.flip(0) * pushes.new_tensor((0.06, -0.06, 0.2))
        stiffness = torch.tensor(STIFFNESS, dtype=torch.float64, device=device)
        column = column_scene(scene)

        def step(scene=column, start=start, command=command, stiffness=stiffness) -> Transition:
            return simulate_step(scene, start, command, stiffness, PAPER_STEP)

        row = {"part": "f_theta anitescu, ellipses", "particles": particles, "points": count}
        times = timed(step)
        each = times["cpu_s"] / (particles * memory) * 1e6
        rows.append({**row, **times, "us_each": each, "solved": _solved(step())})
    return rows


def decoded_scene(shape: Shape, parameters: Parameters) -> ContactScene:
    """The scenes of all particles: the network decodes in float32."""
    return scene_from_parameters(shape, replace(parameters, latent=parameters.latent.float()))


def weights(work: Work, transition: Transition) -> Tensor:
    """The paper's normalised weights of m particles, against a made-up measurement."""
    pose = work.start - transition.pose
    pose = torch.cat((pose[..., :2], wrap_angle(pose[..., 2:])), dim=-1)
    error = torch.cat((1.0 - transition.wrench, pose), dim=-1)
    each = -0.5 * (error**2 / torch.tensor(COVARIANCE, dtype=error.dtype).to(error)).sum(-1)
    usable = (transition.status <= int(StepStatus.RELAXED)) & torch.isfinite(each)
    return torch.where(usable, each, -torch.inf).sum(-1).softmax(0)


def contact_problem(work: Work, device: torch.device) -> ContactQP:
    """As many contact problems as transitions, as the simulator makes them."""
    from eval.bench.contact_problems import random_contact_problems

    problem = random_contact_problems(work.transitions, QP_ROWS, seed=0)
    moved = {
        name: value.to(device) for name, value in vars(problem).items() if isinstance(value, Tensor)
    }
    return replace(problem, **moved)


def _simulate(scene: ContactScene, work: Work, settings: StepSettings) -> Transition:
    return simulate_step(scene, work.start, work.command, work.stiffness, settings)


def _gradient(scene: ContactScene, work: Work, settings: StepSettings) -> Tensor:
    """Of the sum of all poses, by the outlines."""
    points = scene.points_ee.detach().requires_grad_()
    found = _simulate(replace(scene, points_ee=points), work, settings)
    return torch.autograd.grad(found.pose.nan_to_num(0.0).sum(), points)[0]


def _on(shape: Shape, device: torch.device) -> Shape:
    """The shape with its weights on the device."""
    return shape.to(device) if isinstance(shape, torch.nn.Module) else shape


def _row(
    part: str, work: Work, times: dict[str, float], found: Transition | None
) -> dict[str, Any]:
    row = {
        "part": part,
        "particles": len(work.parameters.scale),
        "transitions": work.transitions,
        **times,
        "us_each": times["cpu_s"] / work.transitions * 1e6,
    }
    return row if found is None else {**row, "solved": _solved(found)}


def _solved(transition: Transition) -> float:
    # Particles whose floor is above the measured start are pushed out of it, and then converge.
    return float((transition.status <= int(StepStatus.START_INSIDE)).double().mean())
