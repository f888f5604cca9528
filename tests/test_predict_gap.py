"""Predictions with a known misfit, against steps with the gap of the angle that is reached.

The object is pressed off its centre, so that it settles beside the commanded angle, and
the field changes with the angle: what the predictor adds to its step counts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.contact import scene_from_parameters
from tpcd.effects.catalogue import find_effect
from tpcd.parameters import Parameters
from tpcd.planar import rotate
from tpcd.predict import ContactPredictor
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings, StepStatus, Transition, simulate_step

FIELD = MisfitField(sd=1e-3)
STIFFNESS = torch.tensor([1000.0, 1000.0, 10.0], dtype=torch.float64)
THETA = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.18]], dtype=torch.float64)
COEFFICIENTS = 5e-4 * torch.tensor(
    [[0.3, 1.0, 0.4, -1.0, 0.2, 1.0, -0.3, -0.6, 0.7, 0.4, -0.3, 0.9, -0.8, 0.1]],
    dtype=torch.float64,
)
"""Of floor and wall [m]."""
TOLERANCE = 1.5e-5


@pytest.fixture(scope="module")
def shape() -> PolygonShape:
    return PolygonShape(builtin_outlines()["milk_carton"])


@pytest.fixture(scope="module")
def moves(shape: PolygonShape) -> tuple[Tensor, Tensor]:
    """Start poses, which are commands as well, and commands: onto the floor on one corner."""
    z = -float(shape.outline.vertices[:, 1].min())
    starts = torch.tensor([[0.0, z + 0.02, 0.15], [0.0, z + 0.02, -0.12]], dtype=torch.float64)
    down = torch.tensor([[0.0, z - 0.012, 0.15], [0.01, z - 0.010, -0.12]], dtype=torch.float64)
    return starts, down


@pytest.fixture(scope="module")
def expected(shape: PolygonShape, moves: tuple[Tensor, Tensor]) -> Tensor:
    """Where the moves end with the field at the angle that is reached."""
    scene = scene_from_parameters(shape, Parameters.from_vector(THETA))
    coefficients = COEFFICIENTS[0]
    ends = []
    for start, command in zip(*moves, strict=True):
        angle = command[2]
        for _ in range(40):
            gap = FIELD.gap(coefficients, angle)[None]
            there = simulate_step(scene.further(gap), start, command, STIFFNESS, previous=start)
            slope = coefficients.reshape(2, -1) @ FIELD.basis(angle)[1]
            pose = there.pose[0] + (there.pose_from_lever[0] * slope[:, None]).sum(0)
            angle = 0.5 * (angle + pose[2])
        ends.append(pose)
    return torch.stack(ends)


@pytest.fixture(
    scope="module", params=[(), ("force_bias",), ("floor_compliance",)], ids=["", "bias", "soft"]
)
def predictor(request: pytest.FixtureRequest, shape: PolygonShape) -> ContactPredictor:
    """Of one particle that knows its field, with effects that do nothing."""
    return predictor_of(shape, request.param, 1e-5, COEFFICIENTS)


def predictor_of(
    shape: PolygonShape,
    effects: tuple[str, ...],
    misfit_sd: float,
    coefficients: Tensor,
    field: MisfitField = FIELD,
) -> ContactPredictor:
    prior = make_prior(shape, effects=[find_effect(name) for name in effects])
    null = torch.zeros(1, len(prior.names) - THETA.shape[1], dtype=torch.float64)
    size = COEFFICIENTS.shape[1]
    belief = Belief(
        prior=prior,
        vectors=torch.cat((THETA, null), dim=-1),
        weights=torch.ones(1, dtype=torch.float64),
        misfit=field,
        misfit_sd=torch.tensor([misfit_sd], dtype=torch.float64),
        misfit_mean=coefficients,
        misfit_covariance=torch.zeros(1, size, size, dtype=torch.float64),
        step=StepSettings(),
        stiffness=STIFFNESS,
        log_evidence=0.0,
        log_evidence_std=0.0,
    )
    return ContactPredictor(belief)


def test_the_moves_turn_the_object_and_the_field_matters(
    shape: PolygonShape, moves: tuple[Tensor, Tensor], expected: Tensor
) -> None:
    scene = scene_from_parameters(shape, Parameters.from_vector(THETA))
    starts, commands = moves
    without = simulate_step(scene, starts, commands, STIFFNESS, previous=starts).pose
    assert float((expected[:, 2] - commands[:, 2]).abs().min()) > 5e-3
    assert float((without - expected)[:, :2].abs().amax(-1).min()) > 3 * TOLERANCE
    # Also what the field changes between the commanded angle and the one that is reached.
    coefficients = COEFFICIENTS.expand(2, -1)
    here = FIELD.gap(coefficients, commands[:, 2])
    there = FIELD.gap(coefficients, expected[:, 2])
    assert float((there - here)[:, 0].abs().max()) > 2 * TOLERANCE


def test_predictions_end_there(
    predictor: ContactPredictor, moves: tuple[Tensor, Tensor], expected: Tensor
) -> None:
    starts, commands = moves
    both = predictor.predict(starts, commands, previous=starts)
    torch.testing.assert_close(both.mean[:, :3], expected, atol=TOLERANCE, rtol=0.0)


def test_rollouts_end_there(
    predictor: ContactPredictor, moves: tuple[Tensor, Tensor], expected: Tensor
) -> None:
    for start, command, end in zip(*moves, expected, strict=True):
        drawn = predictor.rollout(
            start, command[None], torch.Generator().manual_seed(0), samples=3, previous=start
        )
        torch.testing.assert_close(drawn[:, 0, :3], end.expand(3, 3), atol=TOLERANCE, rtol=0.0)


@pytest.mark.parametrize("effects", [(), ("floor_compliance",)], ids=["", "soft"])
def test_rollouts_are_as_unsure_as_predictions_where_no_bump_reaches(
    shape: PolygonShape, effects: tuple[str, ...]
) -> None:
    """At 0.6 and 0.9 rad the field's known coefficients tell little of the outline, or nothing."""
    unsure = predictor_of(shape, effects, 2e-3, torch.zeros_like(COEFFICIENTS))
    for angle in (0.6, 0.9):
        turned = rotate(torch.tensor(angle), torch.from_numpy(shape.outline.vertices.copy()))
        z = -float(turned[:, 1].min())
        start = torch.tensor([0.0, z + 0.02, angle], dtype=torch.float64)
        down = torch.tensor([[0.0, z - 0.02, angle]], dtype=torch.float64)
        expected = float(unsure.predict(start[None], down, previous=start[None]).std[0, 1])
        assert expected > 1e-3
        drawn = unsure.rollout(
            start, down, torch.Generator().manual_seed(0), samples=2000, previous=start
        )
        assert float(drawn[:, 0, 1].std()) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("effects", [(), ("floor_compliance",)], ids=["", "soft"])
@pytest.mark.parametrize("own", [{"grain": 2.0}, {"roughness": 20.0}], ids=["grain", "rough"])
def test_rollouts_are_as_unsure_as_predictions_of_what_each_reading_has_of_its_own(
    shape: PolygonShape, effects: tuple[str, ...], own: dict[str, float], moves: Any
) -> None:
    field = replace(FIELD, **own)
    unsure = predictor_of(shape, effects, 2e-3, torch.zeros_like(COEFFICIENTS), field)
    smooth = predictor_of(shape, effects, 2e-3, torch.zeros_like(COEFFICIENTS))
    told = 0
    for start, command in zip(*moves, strict=True):
        arguments = (start[None], command[None], start[None])
        expected = unsure.predict(*arguments).std[0, :3]
        wider = expected > 1.5 * smooth.predict(*arguments).std[0, :3]
        generator = torch.Generator().manual_seed(0)
        drawn = unsure.rollout(start, command[None], generator, samples=4000, previous=start)
        found = drawn[:, 0, :3].std(0)
        torch.testing.assert_close(found[wider], expected[wider], rtol=0.1, atol=0.0)
        told += int(wider.sum())
    assert told > 2


def test_a_trajectory_without_answer_is_replaced_by_another(
    shape: PolygonShape, moves: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoilt(*arguments: Any, **named: Any) -> Transition:
        found = simulate_step(*arguments, **named)
        status = found.status.clone()
        status[: int(lost)] = int(StepStatus.INVALID_INPUT)
        pose = torch.where((status == 3)[:, None], torch.nan, found.pose)
        return replace(found, status=status, pose=pose)

    known = predictor_of(shape, (), 1e-5, COEFFICIENTS)
    (start, _), (command, _) = moves
    arguments = (start, command[None], torch.Generator().manual_seed(0), 4, start)
    lost = 0
    whole = known.rollout(*arguments)
    monkeypatch.setattr("tpcd.predict.simulate_step", spoilt)
    lost = 3
    torch.testing.assert_close(known.rollout(*arguments), whole, atol=1e-4, rtol=0)
    lost = 4
    assert torch.isnan(known.rollout(*arguments)).all()
