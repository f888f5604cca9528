"""Laws and closed forms of the quasi-static step, for both engines."""

from __future__ import annotations

import math

import pytest
import torch
from contact_scenes import (
    BOX,
    SLAB,
    STIFFNESS,
    make_scene,
    outline_points,
    random_transitions,
    regular_polygon,
    rotated,
    scene_floor,
    scene_wall,
    vector,
)

from tpcd.contact import ContactScene
from tpcd.planar import compose, rotate, transform_points
from tpcd.simulator import ContactMode, StepSettings, StepStatus, rollout, simulate_step
from tpcd.terrain import HalfPlane, floor, wall

ENGINES = pytest.mark.parametrize("engine", ["torch", "native"])
FRICTIONS = pytest.mark.parametrize("friction_law", ["coulomb", "anitescu"])
SIDES = pytest.mark.parametrize("side", [-1.0, 1.0])
CLOSE = 1e-9
"""Closed forms hold to this [m, rad]; forces to a hundred times as much."""


def step(scene, start, command, engine="native", stiffness=STIFFNESS, **settings):
    settings = StepSettings(**{"substeps": 1, "follow_path": True, **settings})
    transition = simulate_step(scene, start, command, stiffness, settings, engine=engine)
    assert (transition.status == StepStatus.CONVERGED).all()
    return transition


def assert_near(found, *wanted, atol=CLOSE):
    torch.testing.assert_close(found, vector(*wanted), atol=atol, rtol=0)


# One contact


@ENGINES
@FRICTIONS
def test_a_box_pressed_on_the_floor_feels_stiffness_times_depth(engine, friction_law):
    scene = make_scene(height=0.01)
    result = step(scene, vector(0, 0.1, 0), vector(0, 0.02, 0), engine, friction=friction_law)
    assert_near(result.pose, 0, 0.06, 0)
    assert_near(result.wrench, 0, 4.0, 0, atol=1e-7)
    assert result.mode.tolist() == [ContactMode.STICK, ContactMode.FREE]


@ENGINES
@FRICTIONS
def test_a_box_pressed_on_the_wall_feels_stiffness_times_depth(engine, friction_law):
    scene = make_scene(position=0.1)
    result = step(scene, vector(0, 0.1, 0), vector(0.09, 0.1, 0), engine, friction=friction_law)
    assert_near(result.pose, 0.07, 0.1, 0)
    assert_near(result.wrench, -2.0, 0, 0, atol=1e-7)
    assert result.mode.tolist() == [ContactMode.FREE, ContactMode.STICK]


@ENGINES
@SIDES
@pytest.mark.parametrize("mu", [0.1, 0.4, 0.9])
def test_a_sliding_slab_feels_friction_times_the_normal_force_against_its_motion(engine, mu, side):
    scene = make_scene(SLAB, friction=mu)
    result = step(scene, vector(0, 0.02, 0), vector(0.06 * side, -0.03, 0), engine)
    assert_near(result.wrench, -side * mu * 5.0, 5.0, 0, atol=1e-7)
    assert_near(result.pose, side * (0.06 - mu * 5.0 / 100), 0.02, 0)
    slip = ContactMode.SLIP_POSITIVE if side > 0 else ContactMode.SLIP_NEGATIVE
    assert result.mode.tolist() == [slip, ContactMode.FREE]


@ENGINES
@SIDES
def test_along_the_wall_friction_opposes_the_slip_too(engine, side):
    scene = make_scene(SLAB.flip(-1).flip(0), friction=0.3, position=0.02)
    result = step(scene, vector(0, 0.5, 0), vector(0.04, 0.5 + 0.05 * side, 0), engine)
    assert_near(result.wrench, -4.0, -side * 0.3 * 4.0, 0, atol=1e-7)
    slip = ContactMode.SLIP_POSITIVE if side > 0 else ContactMode.SLIP_NEGATIVE
    assert result.mode.tolist() == [ContactMode.FREE, slip]


@ENGINES
@FRICTIONS
@SIDES
def test_a_command_within_the_friction_cone_moves_nothing(engine, friction_law, side):
    command = vector(0.015 * side, 0, 0)
    result = step(make_scene(), vector(0, 0.05, 0), command, engine, friction=friction_law)
    # The tangential force at the foot turns the box only where its torque tips it.
    assert_near(result.pose, 0, 0.05, 0)
    assert_near(result.wrench, -1.5 * side, 5.0, 0, atol=1e-7)
    assert int(result.mode[0]) == ContactMode.STICK


@ENGINES
def test_without_friction_the_tangential_force_vanishes(engine):
    scene = make_scene(SLAB, friction=0.0)
    result = step(scene, vector(0, 0.02, 0), vector(0.05, -0.01, 0), engine)
    assert_near(result.pose, 0.05, 0.02, 0)
    assert_near(result.wrench, 0, 3.0, 0, atol=1e-7)


@ENGINES
@FRICTIONS
def test_a_point_contact_gives_the_torque_of_its_lever(engine, friction_law):
    wedge = vector([0.04, -0.05], [0.05, 0.05], [-0.05, 0.05])
    scene = make_scene(wedge, friction=0.5)
    result = step(scene, vector(0, 0.06, 0), vector(0, 0.01, 0), engine, friction=friction_law)
    arm = rotate(result.pose[2], wedge[0])
    force = result.wrench[:2]
    assert abs(float(result.pose[1] + arm[1])) < CLOSE
    torque = arm[0] * force[1] - arm[1] * force[0]
    assert abs(float(result.wrench[2] - torque)) < 1e-7
    assert float(result.wrench[2]) > 0.05


@ENGINES
@SIDES
def test_a_torque_beyond_half_the_width_times_the_load_tips_the_box(engine, side):
    load, width = 4.0, 0.03
    flat = step(
        make_scene(friction=0.0),
        vector(0, 0.05, 0),
        vector(0, 0.05 - load / 100, side * 0.99 * load * width / 50),
        engine,
    )
    assert_near(flat.pose, 0, 0.05, 0)
    tipped = step(
        make_scene(friction=0.0),
        vector(0, 0.05, 0),
        vector(0, 0.05 - load / 100, side * 2.0 * load * width / 50),
        engine,
    )
    assert side * float(tipped.pose[2]) > 1e-3
    corner = transform_points(tipped.pose, BOX)
    assert abs(float(corner[:, 1].min())) < CLOSE


# Floor and wall


@ENGINES
def test_in_the_corner_each_terrain_bears_its_own_axis(engine):
    scene = make_scene(friction=0.0, position=0.05)
    result = step(scene, vector(0, 0.06, 0), vector(0.05, 0.02, 0), engine)
    assert_near(result.pose, 0.02, 0.05, 0)
    assert_near(result.wrench, -3.0, 3.0, 0, atol=1e-7)
    assert ContactMode.FREE not in result.mode.tolist()


@ENGINES
@pytest.mark.parametrize("mu", [1.2, 1.5])
def test_a_box_jammed_between_floor_and_wall_is_answered_without_friction(engine, mu):
    scene = make_scene(friction=mu, position=0.025)
    arguments = (vector(0, 0.045, 0), vector(0.01, 0.02, 0), STIFFNESS, StepSettings())
    result = simulate_step(scene, *arguments, engine)
    free = simulate_step(make_scene(friction=0.0, position=0.025), *arguments, engine)
    assert int(result.status) == StepStatus.RELAXED
    torch.testing.assert_close(result.pose, free.pose, atol=1e-8, rtol=0)
    assert_near(result.pose, -0.005, 0.05, 0, atol=1e-8)


@ENGINES
def test_a_corridor_too_low_for_the_object_is_answered_near_it_and_flagged(engine):
    """Regression: floor and ceiling closer than the box once recursed without end."""
    one = torch.ones((), dtype=torch.float64)
    scene = ContactScene(
        BOX, (floor(0 * one), HalfPlane(vector(0, -1), -0.09 * one)), vector(0.4, 0.4)
    )
    result = simulate_step(
        scene, vector(0, 0.045, 0), vector(0, 0.02, 0), STIFFNESS, StepSettings(), engine
    )
    assert int(result.status) == StepStatus.RELAXED
    assert torch.isfinite(result.wrench).all()
    # Turning does not help, so it yields to both sides and stays within the overlap.
    world = transform_points(result.pose, BOX)[:, 1]
    assert float(world.min()) > -0.011 and float(world.max()) < 0.101


@ENGINES
@FRICTIONS
def test_jammed_answers_are_finite_near_and_without_friction(engine, friction_law):
    points = outline_points("mug")
    scene, start, command = random_transitions(points, 60, seed=3)
    inside = torch.stack((scene_wall(scene), scene_floor(scene), 0 * start[:, 2]), dim=-1)
    lowest = transform_points(start * vector(0, 0, 1), scene.points_ee)
    start = torch.cat(
        (
            (inside[:, 0] - lowest[..., 0].amax(-1) + 0.002)[:, None],
            (inside[:, 1] - lowest[..., 1].amin(-1) - 0.002)[:, None],
            start[:, 2:],
        ),
        dim=-1,
    )
    scene = ContactScene(scene.points_ee, scene.terrains, torch.full_like(scene.friction, 2.0))
    result = simulate_step(
        scene, start, command, STIFFNESS, StepSettings(friction=friction_law, substeps=1), engine
    )
    relaxed = result.status == StepStatus.RELAXED
    assert int(relaxed.sum()) > 10
    free = simulate_step(
        ContactScene(scene.points_ee, scene.terrains, 0 * scene.friction),
        start,
        command,
        STIFFNESS,
        StepSettings(friction=friction_law, substeps=1),
        engine,
    )
    torch.testing.assert_close(result.pose[relaxed], free.pose[relaxed], atol=1e-7, rtol=0)
    assert float((result.pose - start)[relaxed, :2].abs().max()) < 0.1


# Free flight and angles


@ENGINES
@pytest.mark.parametrize("substeps", [1, 4])
def test_free_flight_reaches_the_command_without_force(engine, substeps):
    command = vector(0.05, 0.3, 0.7)
    result = step(make_scene(), vector(-0.1, 0.2, -0.4), command, engine, substeps=substeps)
    torch.testing.assert_close(result.pose, command, atol=1e-15, rtol=0)
    assert result.wrench.tolist() == [0.0, 0.0, 0.0]
    assert result.mode.tolist() == [ContactMode.FREE, ContactMode.FREE]


@ENGINES
@SIDES
def test_commands_across_half_a_turn_go_the_short_way_round(engine, side):
    """At an angle near pi, upside down on the floor, the step is that of the turned box."""
    turn = side * (math.pi - 0.01)
    start, command = vector(0, 0.05, turn), vector(0.01, 0.02, turn + side * 0.03)
    command[2] = command[2] - 2 * math.pi * side
    scene = make_scene(rotated(BOX, -turn), friction=0.3)
    result = step(scene, start, command, engine)
    upright = step(
        make_scene(friction=0.3), vector(0, 0.05, 0), vector(0.01, 0.02, side * 0.03), engine
    )
    torch.testing.assert_close(result.wrench, upright.wrench, atol=1e-7, rtol=0)
    assert -math.pi < float(result.pose[2]) <= math.pi
    expected = compose(upright.pose * vector(0, 0, 1), vector(0, 0, turn))[2]
    assert abs(float(result.pose[2] - expected)) < 1e-9


# Symmetry


@ENGINES
@FRICTIONS
@pytest.mark.parametrize("substeps", [1, 3])
def test_mirroring_everything_mirrors_the_answer(engine, friction_law, substeps):
    scene, start, command = random_transitions(outline_points("mug"), 80, seed=11)
    mirror = vector(-1, 1, -1)
    left_wall = HalfPlane(vector(1, 0).expand(80, 2), -scene_wall(scene))
    flipped = ContactScene(
        scene.points_ee * vector(-1, 1), (scene.terrains[0], left_wall), scene.friction
    )
    settings = StepSettings(friction=friction_law, substeps=substeps, follow_path=True)
    result = simulate_step(scene, start, command, STIFFNESS, settings, engine=engine)
    other = simulate_step(
        flipped, start * mirror, command * mirror, STIFFNESS, settings, engine=engine
    )
    same = (result.pose - other.pose * mirror).abs().amax(-1) < 1e-7
    torch.testing.assert_close(result.wrench[same], other.wrench[same] * mirror, atol=1e-5, rtol=0)
    # Where Coulomb friction has several answers, the mirrored search may end in another.
    assert int((~same).sum()) <= (3 if friction_law == "coulomb" else 0)


@ENGINES
def test_moving_the_world_along_moves_the_answer_along(engine):
    scene, start, command = random_transitions(outline_points("banana"), 80, seed=12)
    shift = vector(0.7, -0.4, 0)
    moved = make_scene(
        scene.points_ee,
        scene.friction[:, 0],
        scene_floor(scene) + shift[1],
        scene_wall(scene) + shift[0],
    )
    result = step(scene, start, command, engine, rounds=60)
    other = step(moved, start + shift, command + shift, engine, rounds=60)
    torch.testing.assert_close(other.pose, result.pose + shift, atol=1e-7, rtol=0)
    torch.testing.assert_close(other.wrench, result.wrench, atol=1e-5, rtol=0)


@ENGINES
def test_rotating_everything_rotates_the_wrench(engine):
    """With equal stiffness in x and z the laws know no direction."""
    angle = 0.6
    scene, start, command = random_transitions(outline_points("hex_nut"), 80, seed=13)
    turn = vector(0, 0, angle)
    terrains = tuple(
        HalfPlane(rotate(turn[2], body.direction), body.offset) for body in scene.terrains
    )
    turned = ContactScene(scene.points_ee, terrains, scene.friction)
    settings = StepSettings(substeps=1, rounds=60)
    result = simulate_step(scene, start, command, STIFFNESS, settings, engine=engine)
    other = simulate_step(
        turned, compose(turn, start), compose(turn, command), STIFFNESS, settings, engine=engine
    )
    settled = (result.status == StepStatus.CONVERGED) & (other.status == StepStatus.CONVERGED)
    assert int((~settled).sum()) <= 2
    expected = compose(turn, result.pose)
    torch.testing.assert_close(other.pose[settled], expected[settled], atol=1e-7, rtol=0)
    forces = torch.cat((rotate(turn[2], result.wrench[:, :2]), result.wrench[:, 2:]), dim=-1)
    torch.testing.assert_close(other.wrench[settled], forces[settled], atol=1e-5, rtol=0)


# Geometry


@ENGINES
@FRICTIONS
@SIDES
def test_a_tilted_box_pressed_down_settles_on_its_flat_face(engine, friction_law, side):
    """The first linearisation knows one corner only; the answer must know the face."""
    start = vector(0, 0.06, 0.12 * side)
    command = vector(0, -0.02, 0.0)
    result = step(make_scene(), start, command, engine, friction=friction_law, rounds=60)
    if friction_law == "coulomb":
        assert abs(float(result.pose[2])) < 1e-6
        assert abs(float(result.pose[1]) - 0.05) < 1e-6
    gaps = transform_points(result.pose, BOX)[:, 1]
    assert float(gaps.min()) > -1e-8


@ENGINES
@FRICTIONS
@pytest.mark.parametrize("name", ["mug", "hammer", "c_clamp", "star"])
def test_an_outline_touches_half_planes_as_its_hull_does(engine, friction_law, name):
    from scipy.spatial import ConvexHull

    if name == "star":
        spikes = regular_polygon(10, 0.05)
        points = torch.where(torch.arange(10)[:, None] % 2 == 0, spikes, 0.4 * spikes)
    else:
        points = outline_points(name)
    hull = points[torch.from_numpy(ConvexHull(points.numpy()).vertices.astype("int64"))]
    assert len(hull) < len(points)
    scene, start, command = random_transitions(points, 60, seed=21)
    hull_scene, _, _ = random_transitions(hull, 60, seed=21)
    settings = StepSettings(friction=friction_law, substeps=1)
    result = simulate_step(scene, start, command, STIFFNESS, settings, engine=engine)
    other = simulate_step(hull_scene, start, command, STIFFNESS, settings, engine=engine)
    torch.testing.assert_close(result.pose, other.pose, atol=1e-8, rtol=0)


@ENGINES
@FRICTIONS
def test_more_points_on_the_same_outline_change_nothing(engine, friction_law):
    start, command = vector(-0.02, 0.07, 0.05), vector(0.04, 0.02, -0.08)
    edges = BOX.roll(-1, 0) - BOX
    fractions = torch.arange(16, dtype=torch.float64)[:, None, None] / 16
    dense = (BOX + fractions * edges).transpose(0, 1).reshape(-1, 2)
    few = step(make_scene(), start, command, engine, friction=friction_law)
    many = step(make_scene(dense), start, command, engine, friction=friction_law)
    shuffled = dense[torch.randperm(len(dense), generator=torch.Generator().manual_seed(0))]
    mixed = step(make_scene(shuffled), start, command, engine, friction=friction_law)
    for other in (many, mixed):
        torch.testing.assert_close(other.pose, few.pose, atol=1e-8, rtol=0)
        torch.testing.assert_close(other.wrench, few.wrench, atol=1e-6, rtol=0)


@ENGINES
@FRICTIONS
def test_no_point_of_the_outline_is_left_in_a_terrain(engine, friction_law):
    for k, name in enumerate(("mug", "beer_bottle", "hex_nut", "egg")):
        scene, start, command = random_transitions(outline_points(name), 100, seed=30 + k)
        settings = StepSettings(friction=friction_law, substeps=1)
        result = simulate_step(scene, start, command, STIFFNESS, settings, engine=engine)
        world = transform_points(result.pose, scene.points_ee)
        gaps = torch.stack(
            (
                world[..., 1].amin(-1) - scene_floor(scene),
                scene_wall(scene) - world[..., 0].amax(-1),
            )
        )
        assert float(gaps[:, result.status == StepStatus.CONVERGED].min()) > -1e-6


# Friction laws, substeps, compliance


@ENGINES
@SIDES
def test_convex_friction_lifts_a_sliding_body_by_friction_times_slip(engine, side):
    mu, press, pull = 0.4, 0.03, 0.06
    scene = make_scene(SLAB, friction=mu)
    start, command = vector(0, 0.02, 0), vector(pull * side, 0.02 - press, 0)
    result = step(scene, start, command, engine, friction="anitescu")
    # Minimise (slip - pull)^2 + (lift + press)^2 on lift = mu slip.
    slip = (pull - mu * press) / (1 + mu**2)
    assert_near(result.pose, slip * side, 0.02 + mu * slip, 0)
    real = step(scene, start, command, engine, friction="coulomb")
    assert abs(float(real.pose[1]) - 0.02) < CLOSE


@ENGINES
def test_with_more_substeps_the_lift_of_convex_friction_goes_to_zero(engine):
    scene = make_scene(SLAB, friction=0.4)
    start, command = vector(0, 0.02, 0), vector(0.06, -0.01, 0)
    exact = step(scene, start, command, engine)
    errors = [
        float((step(scene, start, command, engine, friction="anitescu", substeps=n).pose
               - exact.pose).abs().max())
        for n in (1, 4, 16)
    ]  # fmt: skip
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < errors[0] / 8


@ENGINES
def test_more_substeps_converge_to_the_path_of_friction(engine):
    scene, start, command = random_transitions(outline_points("egg"), 30, seed=41)
    poses = {
        n: simulate_step(
            scene, start, command, STIFFNESS, StepSettings(substeps=n, follow_path=True), engine
        ).pose
        for n in (1, 8, 32)
    }
    coarse, fine = ((poses[n] - poses[32]).abs().mean() for n in (1, 8))
    assert float(fine) < 0.35 * float(coarse)


@ENGINES
@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("compliance", [1e-5, 1e-3, 5e-2])
def test_a_soft_floor_is_a_spring_in_series_with_the_arm(engine, friction, compliance):
    """Also for the two loaded corners of a face: the terrain yields to their sum."""
    scene = make_scene(friction=friction)
    result = step(
        scene,
        vector(0, 0.05, 0),
        vector(0, 0.01, 0),
        engine,
        compliance=compliance,
        rounds=100,
    )
    force = 0.04 / (1 / 100 + compliance)
    assert_near(result.wrench, 0, force, 0, atol=1e-5)
    assert_near(result.pose, 0, 0.05 - compliance * force, 0, atol=1e-7)


@ENGINES
def test_three_loaded_rows_on_soft_terrain_balance_springs_in_series(engine):
    """Face on the floor and edge at the wall: each terrain yields to its own load."""
    compliance = 2e-3
    scene = make_scene(friction=0.0, position=0.05)
    result = step(
        scene,
        vector(0.02, 0.05, 0),
        vector(0.05, 0.02, 0),
        engine,
        compliance=compliance,
        rounds=100,
    )
    force = 0.03 / (1 / 100 + compliance)
    assert_near(result.wrench, -force, force, 0, atol=1e-5)
    assert_near(result.pose, 0.02 + compliance * force, 0.05 - compliance * force, 0, atol=1e-7)


@ENGINES
def test_a_rollout_is_steps_in_a_row(engine):
    scene, start, command = random_transitions(outline_points("mug"), 6, seed=51)
    commands = torch.stack((command, start, command))
    transitions = rollout(scene, start, commands, STIFFNESS, StepSettings(), engine=engine)
    pose, previous = start, None
    for command_now, transition in zip(commands, transitions, strict=True):
        alone = simulate_step(
            scene, pose, command_now, STIFFNESS, StepSettings(), engine=engine, previous=previous
        )
        assert torch.equal(alone.pose, transition.pose)
        pose, previous = transition.pose, command_now


# The door


@pytest.mark.parametrize("stiffness", [(0.0, 1, 1), (1.0, -1, 1), (1.0, 1, math.nan)])
def test_stiffness_that_is_not_positive_is_refused(stiffness):
    with pytest.raises(ValueError, match="stiffness is .*, expected three positive"):
        simulate_step(make_scene(), vector(0, 1, 0), vector(0, 1, 0), vector(*stiffness))


def test_settings_that_mean_nothing_are_refused():
    for wrong in (
        {"friction": "viscous"},
        {"substeps": 0},
        {"rounds": 0},
        {"compliance": -1.0},
        {"tolerance": 0.0},
    ):
        with pytest.raises((ValueError, TypeError)):
            StepSettings(**wrong)


def test_the_native_engine_says_what_it_cannot_do():
    start = vector(0, 0.06, 0).requires_grad_()
    with pytest.raises(ValueError, match="native.*no gradient"):
        simulate_step(make_scene(), start, vector(0, 0, 0), STIFFNESS, engine="native")


def test_every_status_is_a_sentence():
    assert all(len(status.sentence) > 5 for status in StepStatus)


def test_a_wall_on_a_slope_holds_the_box_at_its_normal():
    """Terrains are any half-planes: here a floor that leans by 0.2 rad."""
    normal = vector(-math.sin(0.2), math.cos(0.2))
    scene = ContactScene(
        rotated(SLAB, 0.2),
        (HalfPlane(normal, vector(0.0)[0]), wall(vector(9.0)[0])),
        vector(0.0, 0.0),
    )
    start = torch.cat((0.02 * normal, vector(0)))
    command = torch.cat((-0.02 * normal, vector(0)))
    for engine in ("torch", "native"):
        result = step(scene, start, command, engine)
        torch.testing.assert_close(result.wrench[:2], 4.0 * normal, atol=1e-7, rtol=0)
