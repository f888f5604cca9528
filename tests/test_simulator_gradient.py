"""Derivatives of the step: autograd against differences, and the closed forms beside it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from contact_scenes import (
    BOX,
    SLAB,
    STIFFNESS,
    make_scene,
    many_random_transitions,
    vector,
)

from tpcd.contact import ContactScene, place_points, scene_from_parameters
from tpcd.parameters import Parameters
from tpcd.planar import rotate
from tpcd.shape.builtin import make_entry
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.household import ENTRIES
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import ContactMode, StepSettings, StepStatus, simulate_step
from tpcd.terrain import HalfPlane

FREE, STICK, RIGHT, LEFT = ContactMode
CASES = {
    "free": (BOX, 0.4, (0.0, 0.2, 0.1), (0.01, 0.15, 0.0), (FREE, FREE)),
    "flown and pressed": (BOX, 0.4, (0.0, 0.09, 0.1), (0.002, 0.02, 0.12), (STICK, FREE)),
    "stick": (BOX, 0.6, (0.0, 0.0532, 0.06), (0.004, 0.01, 0.065), (STICK, FREE)),
    "slip right": (SLAB, 0.3, (0.0, 0.02, 0.0), (0.05, -0.02, 0.0), (RIGHT, FREE)),
    "slip left": (SLAB, 0.3, (0.0, 0.02, 0.0), (-0.05, -0.02, 0.001), (LEFT, FREE)),
    "wall": (BOX, 0.3, (0.22, 0.2, 0.05), (0.32, 0.24, 0.03), (FREE, RIGHT)),
    "floor and wall": (BOX, 0.2, (0.26, 0.06, 0.02), (0.30, 0.02, 0.05), (None, None)),
}
"""Outline, friction, start, command and the modes at which the step must end."""
SOFT = pytest.mark.parametrize("compliance", [0.0, 1e-3])
"""Of the floor, and half of it of the wall [m/N]."""


def inputs_of(case: str) -> tuple[torch.Tensor, ...]:
    points, friction, start, command, _ = CASES[case]
    values = (
        points,
        vector(friction),
        vector(0.0),
        vector(0.3),
        vector(1.0, 0.5),
        vector(0.0, 0.0),
        vector(*start),
        vector(*command),
        STIFFNESS,
    )
    return tuple(value.clone().requires_grad_() for value in values)


def answer(settings, compliance, points, *given):
    """Of one or a batch of inputs; the stiffness is shared by the batch."""
    friction, height, position, softer, tilt, start, command, stiffness = given
    normals = rotate(tilt, vector([0.0, 1.0], [-1.0, 0.0]))
    offsets = torch.cat((height, -position), dim=-1)
    planes = zip(normals.unbind(-2), offsets.unbind(-1), strict=True)
    scene = ContactScene(
        points,
        tuple(HalfPlane(*plane) for plane in planes),
        torch.cat((friction, friction), dim=-1),
        compliance * softer,
    )
    return simulate_step(scene, start, command, stiffness, settings)


def answers(settings, compliance, *inputs):
    """Pose and wrench (.., 6)."""
    transition = answer(settings, compliance, *inputs)
    return torch.cat((transition.pose, transition.wrench), dim=-1)


def differences(settings, compliance, inputs, eps=1e-7):
    """Central differences (6, inputs) of the answers, all but the stiffness in one batch."""
    *batched, stiffness = (value.detach() for value in inputs)
    sizes = [value.numel() for value in batched]
    flat = torch.cat([value.flatten() for value in batched])
    moves = eps * torch.eye(len(flat), dtype=torch.float64)
    moved = torch.cat((flat + moves, flat - moves))
    parts = [
        part.reshape(-1, *value.shape)
        for part, value in zip(moved.split(sizes, dim=1), batched, strict=True)
    ]
    ends = answers(settings, compliance, *parts, stiffness)
    columns = [((ends[: len(flat)] - ends[len(flat) :]) / (2 * eps)).T]
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64).index_fill(0, torch.tensor(axis), 1e-4)
        up, down = (
            answers(settings, compliance, *batched, stiffness + sign * step) for sign in (1, -1)
        )
        columns.append(((up - down) / 2e-4)[:, None])
    return torch.cat(columns, dim=1)


@pytest.mark.parametrize("case", list(CASES))
@SOFT
@pytest.mark.parametrize(
    "choices",
    [
        {"substeps": 1},
        {"substeps": 3, "follow_path": True},
        {"substeps": 1, "friction": "anitescu"},
    ],
    ids=lambda choices: "-".join(str(value) for value in choices.values()),
)
def test_autograd_is_the_derivative_in_every_contact_mode(case, choices, compliance):
    settings = StepSettings(tolerance=1e-11, **choices)
    inputs = inputs_of(case)
    transition = answer(settings, compliance, *inputs)
    assert int(transition.status) == StepStatus.CONVERGED
    if choices == {"substeps": 1} and not compliance:
        for mode, wanted in zip(transition.mode.tolist(), CASES[case][4], strict=True):
            assert wanted is None or mode == wanted
    found = answers(settings, compliance, *inputs)
    rows = [torch.autograd.grad(value, inputs, retain_graph=True) for value in found]
    jacobian = torch.stack([torch.cat([part.flatten() for part in row]) for row in rows])
    # Forces are a hundred times poses in number, and so are their errors.
    scale = vector(1, 1, 1, 100, 100, 50)[:, None]
    torch.testing.assert_close(
        jacobian / scale, differences(settings, compliance, inputs) / scale, atol=2e-5, rtol=1e-4
    )


@pytest.mark.parametrize("law", ["coulomb", "anitescu"])
@pytest.mark.parametrize("case", list(CASES))
@SOFT
def test_the_response_to_the_start_is_its_derivative(case, law, compliance):
    points, friction, start, command, _ = CASES[case]
    scene = make_scene(points, friction, compliance=compliance * vector(1.0, 0.5))
    settings = StepSettings(friction=law, substeps=1, tolerance=1e-11)
    command, start = vector(*command), vector(*start)
    response = simulate_step(scene, start, command, STIFFNESS, settings)
    eps = 1e-7
    moves = torch.cat((torch.eye(3), -torch.eye(3))).double() * eps
    moved = simulate_step(scene, start + moves, command, STIFFNESS, settings).pose
    difference = (moved[:3] - moved[3:]).T / (2 * eps)
    torch.testing.assert_close(response.pose_from_start, difference, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("case", list(CASES))
@SOFT
def test_the_response_to_a_gap_is_that_to_terrain_moving_away(case, compliance):
    points, friction, start, command, _ = CASES[case]
    settings = StepSettings(substeps=1, tolerance=1e-11)
    command, start = vector(*command), vector(*start)
    eps = 1e-7
    signs = vector(1.0, -1.0)
    for terrain in range(2):
        # A wider gap is a lower floor, or a wall further off.
        scene = make_scene(
            points,
            friction,
            -eps * signs if terrain == 0 else 0 * signs,
            0.3 + (eps * signs if terrain == 1 else 0 * signs),
            compliance * vector(1.0, 0.5),
        )
        moved = simulate_step(scene, start, command, STIFFNESS, settings)
        difference = (moved.pose[0] - moved.pose[1]) / (2 * eps)
        torch.testing.assert_close(
            moved.pose_from_gap.mean(0)[terrain], difference, atol=1e-5, rtol=1e-4
        )


@pytest.mark.parametrize("case", ["stick", "slip right"])
def test_the_response_to_a_lever_is_that_to_shifted_contact_points(case):
    """Under convex parts of the law a shift along the floor is a change of lever alone."""
    points, friction, start, command, _ = CASES[case]
    settings = StepSettings(substeps=1, tolerance=1e-11)
    start, command = vector(*start), vector(*command)
    # Touching at the start, since in flight a shift along the floor turns into one of the gap.
    start[1] = -rotate(start[2], points)[:, 1].min()
    eps = 1e-7
    base = simulate_step(make_scene(points, friction), start, command, STIFFNESS, settings)
    # Moving the outline along the floor shifts levers, and gaps nowhere at this angle.
    direction = torch.stack((start[2].cos(), -start[2].sin()))
    moved = [
        simulate_step(
            make_scene(points + sign * eps * direction, friction),
            start,
            command,
            STIFFNESS,
            settings,
        ).pose
        for sign in (1.0, -1.0)
    ]
    difference = (moved[0] - moved[1]) / (2 * eps)
    turned = float((base.pose - start)[2])
    # The outline's direction turns with the object: to first order a change of gap as well.
    expected = base.pose_from_lever[0] + turned * base.pose_from_gap[0]
    # Sticking, a turning point also slips by 1 - cos(turn) of its shift; not part of a lever.
    torch.testing.assert_close(expected, difference, atol=2e-5 + turned**2, rtol=1e-3)


def theta(latent: torch.Tensor) -> torch.Tensor:
    return torch.cat((latent, vector(1.0, 0.004, -0.003, 0.1, 0.4, 0.002, 0.15)))


def step_from_theta(shape, theta_vector, start, command):
    scene = scene_from_parameters(shape, Parameters.from_vector(theta_vector))
    settings = StepSettings(substeps=1, tolerance=1e-11)
    return simulate_step(scene, start, command, STIFFNESS, settings)


def test_derivatives_reach_theta_through_a_polygon():
    shape = PolygonShape(make_entry("mug", ENTRIES["mug"]))
    inputs = theta(torch.zeros(0, dtype=torch.float64)).requires_grad_()
    start, command = vector(-0.02, 0.09, 0.05), vector(0.01, 0.01, 0.1)
    assert torch.autograd.gradcheck(
        lambda value: step_from_theta(shape, value, start, command).pose,
        (inputs,),
        eps=1e-7,
        atol=1e-4,
        rtol=1e-3,
    )


def test_derivatives_reach_theta_through_the_shape_network():
    """The network decodes in float32, so that differences need wide steps."""
    shape = load_prior("ycb21-z2")
    latent = shape.sample_latent(1, torch.Generator().manual_seed(4))[0].double()
    value = theta(latent).requires_grad_()
    start, command = vector(-0.02, 0.14, 0.0), vector(0.01, -0.02, 0.06)
    result = step_from_theta(shape, value, start, command)
    assert int(result.status) == StepStatus.CONVERGED and int(result.mode[0]) != FREE
    (gradient,) = torch.autograd.grad(result.pose[1], value)
    assert torch.isfinite(gradient).all() and gradient[:2].abs().max() > 0
    for i, eps in enumerate([2e-3, 2e-3] + [1e-5] * 7):
        shift = torch.zeros_like(value).index_fill(0, torch.tensor(i), eps)
        ends = [
            float(step_from_theta(shape, value.detach() + s * shift, start, command).pose[1])
            for s in (1, -1)
        ]
        difference = (ends[0] - ends[1]) / (2 * eps)
        assert abs(difference - float(gradient[i])) < 2e-3 + 0.1 * abs(difference)


def test_a_shared_scene_collects_the_gradients_of_its_transitions():
    friction = vector(0.3).requires_grad_()
    starts = vector([0.0, 0.02, 0.0], [0.0, 0.02, 0.0], [0.01, 0.02, 0.0])
    commands = vector([0.05, -0.02, 0.0], [-0.05, -0.02, 0.0], [0.06, -0.01, 0.0])
    together = simulate_step(make_scene(SLAB, friction[0]), starts, commands, STIFFNESS)
    (total,) = torch.autograd.grad(together.pose[:, 0].sum(), friction)
    # Each slides to pull - friction x press.
    assert float(total) == pytest.approx(-0.04 + 0.04 - 0.03, abs=1e-8)


def test_scenes_from_parameters_place_the_outline():
    shape = PolygonShape(make_entry("egg", ENTRIES["egg"]))
    parameters = Parameters.from_vector(theta(torch.zeros(0, dtype=torch.float64)))
    scene = scene_from_parameters(shape, parameters)
    points = shape.boundary_points(parameters.latent)
    assert isinstance(scene, ContactScene)
    torch.testing.assert_close(
        scene.points_ee, place_points(points, parameters.scale, parameters.mount)
    )
    assert torch.equal(scene.friction, parameters.friction.expand(2))
    lifted = replace(parameters, floor_height=parameters.floor_height + 0.1)
    higher = scene_from_parameters(shape, lifted).terrains[0].signed_distance(points)
    torch.testing.assert_close(higher, scene.terrains[0].signed_distance(points) - 0.1)


def test_asking_for_a_gradient_changes_no_bit_and_a_second_one_is_refused():
    scene, start, command = many_random_transitions(10, seed=68)
    silent = simulate_step(scene, start, command, STIFFNESS)
    command = command.requires_grad_()
    traced = simulate_step(scene, start, command, STIFFNESS)
    for name, value in vars(silent).items():
        assert torch.equal(value, getattr(traced, name).detach()), name
    with pytest.raises(RuntimeError, match="differentiable once; leave out create_graph"):
        torch.autograd.grad(traced.pose.sum(), command, create_graph=True)


def test_gradients_that_are_not_asked_for_cost_nothing_and_are_none():
    scene, start, command = many_random_transitions(5, seed=69)
    friction = scene.friction.clone().requires_grad_()
    found = simulate_step(replace(scene, friction=friction), start, command, STIFFNESS)
    assert found.pose.requires_grad and not found.mode.requires_grad
    assert not found.pose_from_start.requires_grad and not found.contacts.requires_grad
    with torch.no_grad():
        assert not simulate_step(
            scene, start, command.requires_grad_(), STIFFNESS
        ).pose.requires_grad


@pytest.mark.parametrize("law", ["coulomb", "anitescu"])
def test_derivatives_along_paths_in_parts_are_differences_too(law):
    """By the command, of boxes that are pressed and pushed about a corner, where both one-sided
    differences of two sizes agree."""
    generator = torch.Generator().manual_seed(0)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    count, settings = 400, StepSettings(friction=law)
    scene = make_scene(BOX.expand(count, *BOX.shape), uniform(0.2, 0.9, count), position=0.10)
    start = torch.stack(
        (uniform(0, 0.05, count), uniform(0.07, 0.08, count), 0.0 * uniform(0, 1, count)), -1
    )
    before = start + vector(-0.03, -0.06, -0.1) + vector(0.09, 0.04, 0.2) * uniform(0, 1, count, 3)
    command = (
        before + vector(-0.06, -0.04, -0.1) + vector(0.12, 0.07, 0.2) * uniform(0, 1, count, 3)
    )
    rest = simulate_step(scene, start, before, STIFFNESS, settings).pose
    way = vector(0.01, 0.01, 0.1) * uniform(-1, 1, count, 3)

    def height(command):
        return simulate_step(scene, rest, command, STIFFNESS, settings, previous=before)

    asked = command.clone().requires_grad_()
    found = height(asked)
    slope = (torch.autograd.grad(found.pose.sum(), asked)[0] * way).sum(-1)
    ends = []
    for size in (1e-4, -1e-4, 1e-5, -1e-5):
        ends.append((height(command + size * way).pose - found.pose.detach()).sum(-1) / size)
    ends = torch.stack(ends)
    smooth = (ends.amax(0) - ends.amin(0)) < 0.01 * ends[2:].mean(0).abs() + 1e-5
    smooth &= found.status == StepStatus.CONVERGED
    off = (slope - ends[2:].mean(0)).abs() > 0.05 * ends[2:].mean(0).abs() + 1e-5
    assert int(smooth.sum()) > 380 and float(off[smooth].double().mean()) < 0.01


@SOFT
@pytest.mark.parametrize("friction", [0.0, 0.1, 0.4, 0.8])
def test_a_face_that_is_pressed_straight_down_turns_as_differences_say(compliance, friction):
    """Two rows bear all load there; what those forbid that bear none is in the derivative too."""
    box = vector([-0.04, -0.06], [0.04, -0.06], [0.04, 0.06], [-0.04, 0.06])
    start, given = vector(0.0, 0.08, 0.0), vector(0.0, 0.04, 0.0)
    soft = compliance * vector(1.0, 0.5)
    scene = make_scene(box, friction, position=0.2, compliance=soft)
    command = given.clone().requires_grad_()
    turned = simulate_step(scene, start, command, STIFFNESS).pose[2]
    slope = torch.autograd.grad(turned, command)[0]
    steps = 1e-5 * torch.eye(3, dtype=torch.float64)
    ahead, behind = (
        simulate_step(scene, start.expand(3, 3), given + sign * steps, STIFFNESS).pose[:, 2]
        for sign in (1, -1)
    )
    torch.testing.assert_close(slope, (ahead - behind) / 2e-5, rtol=1e-3, atol=1e-6)
