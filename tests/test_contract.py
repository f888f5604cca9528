"""The doors in Python: other forms of the same numbers give the same answer, everything else one
clear error; another unit is refused unless the caller insists."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jaxtyping
import numpy as np
import pytest
import torch
from contact_scenes import BOX, STIFFNESS, make_scene, vector

from eval.blind.suites import MEDIUM, OUTSIDE
from tpcd.belief.belief import Belief, estimate, prior_belief
from tpcd.belief.paper import estimate_paper
from tpcd.belief.prior import make_prior
from tpcd.belief.settings import EstimatorSettings, SamplerSettings
from tpcd.contact import ContactScene
from tpcd.contract import as_numbers, check_effect, check_stiffness
from tpcd.data import Episode, read_episode, write_episode
from tpcd.effects.catalogue import KNOWN, unit_of
from tpcd.errors import EpisodeError
from tpcd.policies.active import ActiveSettings
from tpcd.policies.limits import Limits
from tpcd.predict import ContactPredictor
from tpcd.qp import ContactQP, solve
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepStatus, rollout, simulate_step
from tpcd.terrain import HalfPlane
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

POSE, COMMAND = [0.0, 0.12, 0.0], [0.01, 0.06, 0.0]


@pytest.fixture(autouse=True)
def _as_users_call() -> Iterator[None]:
    """Without the types that the tests check at every call, which users do without."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def episode() -> Episode:
    generator = torch.Generator().manual_seed(3)
    shape = PolygonShape(builtin_outlines()["mug"])
    scene = draw_scene("mug", shape.outline.vertices, generator)
    motion = make_motion("rich", scene, 3, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 3, generator).measured


@pytest.fixture(scope="module")
def belief(episode: Episode) -> Belief:
    settings = EstimatorSettings(sampler=SamplerSettings(particles=100), misfit_sd=3e-4)
    shape = PolygonShape(builtin_outlines()["mug"])
    return list(estimate(episode, shape, torch.Generator().manual_seed(0), settings))[-1].belief


@pytest.fixture(scope="module")
def predictor(belief: Belief) -> ContactPredictor:
    return ContactPredictor(belief)


FORMS = {
    "list": list,
    "row of a list": lambda v: [v],
    "array": np.array,
    "narrow array": lambda v: np.array(v, np.float64)[None],
    "one axis": torch.tensor,
    "double": lambda v: torch.tensor([v], dtype=torch.float64),
}


@pytest.mark.parametrize("form", FORMS)
def test_the_same_numbers_in_another_form_give_the_same_prediction(predictor, form):
    wanted = predictor.predict(vector(*POSE)[None], vector(*COMMAND)[None])
    found = predictor.predict(FORMS[form](POSE), FORMS[form](COMMAND))
    # A float32 has the command to 7 digits.
    torch.testing.assert_close(found.mean, wanted.mean, atol=1e-6, rtol=1e-6)
    many = predictor.predict(FORMS[form](POSE), torch.tensor([COMMAND, COMMAND]))
    torch.testing.assert_close(many.mean, wanted.mean.expand(2, 6), atol=1e-6, rtol=1e-6)


def test_whole_numbers_are_numbers(predictor):
    wanted = predictor.predict(vector(0, 1, 0), vector(0, 0, 0))
    found = predictor.predict(torch.tensor([0, 1, 0]), [0, 0, 0])
    torch.testing.assert_close(found.mean, wanted.mean, atol=0, rtol=0)
    torch.testing.assert_close(as_numbers("x", [1, 2, 3], 3), vector(1, 2, 3))


WRONG = {
    "a number": (0.3, ValueError, "pose has shape (), expected rows of 3 numbers"),
    "two numbers": ([0.0, 0.1], ValueError, "pose has shape (2,), expected rows of 3 numbers"),
    "three axes": (torch.zeros(1, 1, 3), ValueError, "pose has shape (1, 1, 3), expected rows"),
    "nothing": (None, TypeError, "pose is NoneType, expected rows of 3 numbers"),
    "words": ("home", TypeError, "pose is str, expected rows of 3 numbers"),
    "ragged": ([[0.0, 0.1], [0.0]], TypeError, "pose is [[0.0, 0.1], [0.0]], expected rows"),
    "truths": ([True, False, True], TypeError, "pose holds bool, expected rows of 3 numbers"),
    "complex": (torch.zeros(3, dtype=torch.cfloat), TypeError, "pose holds complex64"),
    "rows": (torch.zeros(3, 3), ValueError, "command has 2 rows, expected 1 or 3 as the others"),
    "device": (torch.zeros(3, device="meta"), ValueError, "pose is on meta, expected it on cpu"),
    "millimetres": ([0.0, 120.0, 0.0], ValueError, "it looks like millimetres"),
    "degrees": ([0.0, 0.12, 90.0], ValueError, "it looks like degrees"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_no_pose_is_refused_in_one_line_that_says_what_is_expected(predictor, what):
    given, kind, told = WRONG[what]
    commands = torch.tensor([COMMAND, COMMAND], dtype=torch.float64)
    for call in (
        lambda: predictor.predict(given, commands),
        lambda: predictor.rollout(given, commands, torch.Generator(), samples=2),
    ):
        with pytest.raises(kind) as raised:
            call()
        assert told in str(raised.value) and "\n" not in str(raised.value)


def test_a_row_that_is_not_finite_is_not_answered_and_a_noise_that_is_not_is_refused(predictor):
    found = predictor.predict([POSE, [0.0, np.nan, 0.0]], COMMAND)
    assert found.answered.tolist() == [True, False]
    wrong = [
        ("pose_std", [1e-4, np.inf, 1e-4], "pose_std is inf, expected a finite number"),
        ("sensor_std", [-1.0] * 6, "sensor_std of x is -1, expected >= 0"),
        ("pose_std", [0.1, 0.1, 5e-4], "pose_std of x is 0.1, expected m .*looks like mm"),
    ]
    for name, std, told in wrong:
        with pytest.raises(ValueError, match=told):
            predictor.predict(POSE, COMMAND, **{name: std})
    predictor.predict(POSE, COMMAND, pose_std=[0.1, 0.1, 5e-4], unusual=True)


STEP_WRONG = {key: WRONG[key] for key in ("a number", "two numbers", "nothing", "words", "truths")}


@pytest.mark.parametrize("what", STEP_WRONG)
@pytest.mark.parametrize("name", ["pose", "command", "previous", "stiffness"])
def test_a_step_refuses_what_is_no_row_of_three(what, name):
    given, kind, told = STEP_WRONG[what]
    if name == "previous" and given is None:
        return
    arguments: dict[str, Any] = {"pose": POSE, "command": COMMAND, "stiffness": STIFFNESS}
    with pytest.raises(kind, match="expected 3 numbers"):
        simulate_step(make_scene(), **{**arguments, name: given})
    assert told.startswith("pose")


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("pose", [0.0, 120.0, 0.0], "millimetres"),
        ("command", [0.0, 0.1, 90.0], "degrees"),
        ("previous", [-500.0, 0.1, 0.0], "millimetres"),
        ("stiffness", [0.1, 0.1, 50.0], "N/mm"),
        ("stiffness", [100.0, 100.0, 50e3], "N·mm/rad"),
        ("stiffness", [1e8, 100.0, 50.0], "at most 1e\\+06"),
    ],
)
def test_another_unit_is_refused_by_a_step_unless_the_caller_insists(name, value, told):
    arguments = {"pose": POSE, "command": COMMAND, "stiffness": STIFFNESS, name: value}
    for call in (simulate_step, run_once):
        with pytest.raises(ValueError, match=f"{told}.*unusual=True"):
            call(make_scene(), **arguments)
    assert torch.isfinite(simulate_step(make_scene(), **arguments, unusual=True).pose).all()


def run_once(scene, pose, command, stiffness, previous=None):
    return rollout(scene, pose, [command], stiffness, previous=previous)


def test_a_pose_inside_the_floor_is_told_by_the_prediction(predictor):
    inside, free = [0.0, -0.1, 0.0], [0.0, 0.5, 0.0]
    found = predictor.predict([inside, free], [[0.0, 0.05, 0.0], [0.0, 0.45, 0.0]])
    assert found.start_inside.tolist() == pytest.approx([1.0, 0.0])
    assert (found.component_status[:, 0] == StepStatus.START_INSIDE).all()


def test_an_episode_takes_lists_and_arrays_and_refuses_other_shapes(episode: Episode):
    plain = {
        "commands": episode.commands.tolist(),
        "poses": episode.poses.numpy(),
        "wrenches": episode.wrenches.float(),
        "stiffness": [100, 100, 50],
        "sensor_std": tuple(episode.sensor_std.tolist()),
    }
    found = Episode(**plain)
    assert torch.equal(found.poses, episode.poses) and found.poses.dtype == torch.float64
    assert torch.equal(found.stiffness, STIFFNESS)
    for name, value, told in (
        ("poses", episode.poses[:-1], "poses has shape (3, 3), expected (4, 3)"),
        ("poses", None, "poses is NoneType, expected 3 numbers"),
        ("commands", 1e3 * episode.commands, "commands reaches"),
        ("stiffness", [0.1, 0.1, 50.0], "N/mm; convert it, or insist with unusual=True"),
        ("sensor_std", [1e-3] * 5, "sensor_std has shape (5,), expected 6 numbers"),
        ("sensor_std", [0.2, *[1e-3] * 5], "sensor_std of x is 0.2, expected m (at most 0.05)"),
    ):
        with pytest.raises((TypeError, ValueError)) as raised:
            Episode(**{**plain, name: value})
        assert told in str(raised.value)
    assert len(replace(found, stiffness=vector(0.1, 0.1, 50), unusual=True)) == len(episode)


def test_a_file_with_newtons_per_millimetre_is_refused_unless_it_insists(tmp_path, episode):
    path = write_episode(episode, tmp_path / "e")
    header = path.with_suffix(".yaml")
    text = header.read_text(encoding="utf-8").replace("100.0", "0.1")
    header.write_text(text, encoding="utf-8")
    with pytest.raises(EpisodeError, match="e.yaml: stiffness is 0.1, .*N/mm.*unusual: true"):
        read_episode(path)
    header.write_text(text + "unusual: true\n", encoding="utf-8")
    found = read_episode(path)
    assert found.unusual and float(found.stiffness[0]) == 0.1
    again = write_episode(found, tmp_path / "again")
    assert read_episode(again).unusual


def test_the_range_of_stiffness_holds_the_arms_of_the_field():
    """Soft impedance of 30 N/m, a Franka with 2000 N/m, an industrial arm held by its brakes."""
    for along in (30.0, 2000.0, 1e6):
        check_stiffness(vector(along, along, 5.0))
    check_stiffness(vector(0.5, 0.5, 5.0), unusual=True)


@pytest.mark.parametrize(
    ("change", "kind", "told"),
    [
        ({"target": [0.0, 0.0]}, TypeError, "target is a list, expected a tensor"),
        ({"rows": None}, TypeError, "rows is a NoneType, expected a tensor"),
        ({"target": torch.zeros(())}, ValueError, "target has shape ()"),
        ({"rows": torch.zeros(2)}, ValueError, "rows (2,)"),
    ],
)
def test_a_contact_problem_of_no_tensors_is_refused(change, kind, told):
    good = {
        "hessian": torch.eye(2).double(),
        "target": vector(0, -1),
        "rows": vector([0, 1]),
        "offsets": vector(0.5),
    }
    torch.testing.assert_close(solve(ContactQP(**good)).motion, vector(0, -0.5))
    with pytest.raises(kind) as raised:
        solve(ContactQP(**{**good, **change}))
    assert told in str(raised.value)


DOORS: dict[str, Callable[[], Any]] = {
    "solve": lambda: solve({"target": 0}),  # type: ignore[arg-type]
    "simulate_step": lambda: simulate_step("scene", POSE, COMMAND, STIFFNESS),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("door", DOORS)
def test_what_is_no_scene_or_problem_is_a_type_error(door):
    with pytest.raises(TypeError, match="expected a Contact"):
        DOORS[door]()


def test_effects_of_any_likely_size_are_taken_and_those_in_another_unit_refused() -> None:
    for effect in KNOWN:
        for parameter in effect.parameters:
            for value in (parameter.low, parameter.high):
                check_effect(effect.name, parameter.name, value, parameter.unit)
    for name, sizes in {**MEDIUM, **OUTSIDE}.items():
        for parameter, value in sizes.items():
            check_effect(name, parameter, value, unit_of(name, parameter))
    for name, parameter, value in (
        ("wall_compliance", "compliance", 0.25),
        ("grasp_compliance", "compliance", 5.7),
        ("floor_tilt", "angle", 1.4),
        ("floor_drift", "drift", 3.0),
        ("wrench_reference_point", "x", 20.0),
        ("floor_bump", "height", 3.0),
        ("adhesion", "force", 1000.0),
        ("command_lag", "share", 30.0),
        ("force_gain", "gain", float("nan")),
    ):
        with pytest.raises(ValueError, match=f"{name}.{parameter} is .*, expected"):
            check_effect(name, parameter, value, unit_of(name, parameter))


def test_a_scene_takes_lists_and_arrays_and_what_broadcasts():
    wanted = simulate_step(make_scene(), POSE, COMMAND, STIFFNESS)
    for points, friction in ((BOX.tolist(), [0.4, 0.4]), (BOX.numpy(), np.full((3, 2), 0.4))):
        scene = ContactScene(points, make_scene().terrains, friction)
        found = simulate_step(scene, POSE, COMMAND, STIFFNESS)
        torch.testing.assert_close(found.pose, wanted.pose.expand_as(found.pose))
    several = make_scene(position=[0.3, 0.05, 0.02])
    scene = ContactScene(BOX, several.terrains, [0.4, 0.4])
    found = simulate_step(scene, POSE, COMMAND, STIFFNESS)
    torch.testing.assert_close(found.pose, simulate_step(several, POSE, COMMAND, STIFFNESS).pose)


@pytest.mark.parametrize(
    ("change", "kind", "told"),
    [
        ({"points_ee": torch.zeros(4, 3)}, ValueError, "points_ee has shape (4, 3), expected 2"),
        ({"points_ee": BOX.mT}, ValueError, "points_ee has shape (2, 4), expected 2 numbers"),
        ({"points_ee": BOX[:0]}, ValueError, "points_ee has shape (0, 2) against 2 terrains"),
        ({"points_ee": "mug"}, TypeError, "points_ee is str, expected 2 numbers"),
        ({"friction": vector(0.4)}, ValueError, "friction has shape (1,), expected 2 numbers"),
        ({"compliance": vector(1e-4)}, ValueError, "compliance has shape (1,), expected 2 numbers"),
        ({"terrains": ()}, ValueError, "against 0 terrains"),
        ({"points_ee": BOX.expand(3, 4, 2), "friction": torch.full((2, 2), 0.4)}, ValueError,
         "batch axes are points_ee (3,), friction (2,), compliance (2,), expected axes that broad"),
    ],
)  # fmt: skip
def test_what_is_no_scene_is_refused_in_one_line(change, kind, told):
    scene = make_scene()
    with pytest.raises(kind) as raised:
        ContactScene(**{**vars(scene), "compliance": None, **change})
    assert told in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("length", [0.0, 0.5, 2.0])
def test_a_terrain_whose_direction_is_no_unit_vector_has_no_answer(length):
    terrains = HalfPlane(vector(0, length), vector(0.0)[0]), make_scene().terrains[1]
    scene = ContactScene(BOX, terrains, [0.4, 0.4])
    found = simulate_step(scene, POSE, COMMAND, STIFFNESS)
    assert int(found.status) == StepStatus.INVALID_INPUT and found.pose.isnan().all()
    rounded = replace(scene, terrains=(HalfPlane(vector(0.001, 1.0), vector(0.0)[0]), terrains[1]))
    found = simulate_step(rounded, POSE, COMMAND, STIFFNESS)
    assert int(found.status) == StepStatus.CONVERGED


def test_an_outline_in_millimetres_is_refused_unless_the_caller_insists():
    scene = make_scene(1e3 * BOX)
    with pytest.raises(ValueError, match="points_ee reaches .*millimetres.*unusual=True"):
        simulate_step(scene, POSE, COMMAND, STIFFNESS)
    simulate_step(scene, POSE, COMMAND, STIFFNESS, unusual=True)


@pytest.mark.parametrize("learn", [estimate, prior_belief, estimate_paper])
@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"poses": (2, 1, np.nan)}, r"poses is nan at \[2, 1\], expected a finite number"),
        ({"wrenches": (1, 0, np.inf)}, r"wrenches is inf at \[1, 0\], expected a finite number"),
        ({"sensor_std": (3, np.nan)}, r"sensor_std is nan at 3|sensor_std is nan, expected"),
        ({"sensor_std": (3, -0.3)}, "sensor_std of F_x is -0.3, expected >= 0"),
    ],
)
def test_rows_that_nothing_can_be_learnt_from_are_named(episode: Episode, learn, change, told):
    ((name, (*place, value)),) = change.items()
    values = getattr(episode, name).clone()
    values[tuple(place)] = value
    shape = PolygonShape(builtin_outlines()["mug"])
    with pytest.raises(ValueError, match=told):
        list(learn(replace(episode, **{name: values}), shape, torch.Generator()))
    with pytest.raises(ValueError, match="no rows"):
        list(learn(episode.first(0), shape, torch.Generator()))


@pytest.mark.parametrize(
    ("name", "bounds", "told"),
    [
        ("friction", (-0.5, 0.5), "expected a positive range"),
        ("friction", (0.9, 0.1), "expected finite low < high"),
        ("wall_position", (0.1, np.inf), "expected finite low < high"),
        ("scale", (0.0, 1.0), "expected a positive range"),
        ("floor_height", (-20, 20), "looks like mm"),
        ("friction", 0.5, r"prior of friction has shape \(\), expected 2 numbers"),
    ],
)
def test_a_prior_that_a_scene_cannot_have_is_refused(episode: Episode, name, bounds, told):
    with pytest.raises(ValueError, match=told):
        replace(episode, priors={name: bounds}).check_learnable()
    if "looks" not in told:
        with pytest.raises(ValueError, match=told):
            make_prior(PolygonShape(builtin_outlines()["mug"]), {name: bounds})


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_a_misfit_that_is_no_size_is_refused(value):
    for name in ("misfit_sd", "misfit_spread", "least_misfit_sd", "least_misfit_spread"):
        with pytest.raises(ValueError, match=f"{name} is .*expected a finite number"):
            EstimatorSettings(**{name: value})


def test_limits_and_budgets_of_another_kind_are_refused():
    with pytest.raises(ValueError, match="step, low and high have 2, 3 and 3 numbers, expected 3"):
        Limits(step=(0.08, 0.3))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="particles is 1.5, expected a whole number"):
        ActiveSettings(particles=1.5)  # type: ignore[arg-type]
