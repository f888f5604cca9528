"""A recording that begins in free space says where floor and wall are not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tpcd.belief.belief import prior_belief
from tpcd.belief.free_start import StartGaps, free_starts, start_gaps
from tpcd.belief.history import History, history_of, joined_history
from tpcd.belief.likelihood import history_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.settings import EstimatorSettings
from tpcd.contact import scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.effects.catalogue import CATALOGUE, find_effect
from tpcd.effects.protocol import Added
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings

STIFFNESS = torch.tensor([1000.0, 1000.0, 30.0], dtype=torch.float64)
NOISE = torch.tensor([2e-4, 2e-4, 5e-4, 0.3, 0.3, 0.02], dtype=torch.float64)
SD = 5e-4
FIELD = MisfitField(sd=SD)


@pytest.fixture(scope="module")
def shape() -> PolygonShape:
    return PolygonShape(builtin_outlines()["milk_carton"])


def theta(floor: Tensor, wall: float = 0.18) -> Tensor:
    """Particles that differ in the height of the floor [m]."""
    rest = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.5, 0.0, wall], dtype=torch.float64)
    vectors = rest.expand(len(floor), 7).clone()
    vectors[:, 5] = floor
    return vectors


def lowest(shape: PolygonShape) -> float:
    return float(shape.outline.vertices[:, 1].min())


def hovering(shape: PolygonShape, height: float, loaded: float = 0.0) -> Episode:
    """Two rows `height` above world z = 0, the first `loaded` by so many newtons from below."""
    z = height - lowest(shape)
    commands = torch.tensor([[0.0, z, 0.0], [0.0, z + 0.01, 0.0]], dtype=torch.float64)
    poses = commands.clone()
    poses[0, 1] += loaded / 1000.0
    return Episode(commands, poses, STIFFNESS * (poses - commands), STIFFNESS, NOISE)


def first_row(shape: PolygonShape) -> Episode:
    """The lowest point of the object at world z = 0, before any move."""
    both = hovering(shape, 0.0)
    return Episode(both.commands[:1], both.poses[:1], both.wrenches[:1], STIFFNESS, NOISE)


def total(shape: PolygonShape, vectors: Tensor, history: History, **further) -> Tensor:
    sd = torch.full((len(vectors),), SD, dtype=torch.float64)
    parameters = Parameters.from_vector(vectors)
    return history_likelihood(
        shape, parameters, sd, history, FIELD, StepSettings(), **further
    ).total


@pytest.mark.parametrize("field", [FIELD, MisfitField(SD, 1.0, grain=0.3), MisfitField(0.0)])
def test_before_any_data_is_with_the_prior_covariance(field: MisfitField) -> None:
    """At angles on a bump, between two and beyond all of them; also for absurd particles, beside
    which the others are as they would be alone."""
    random = torch.Generator().manual_seed(0)
    gap = 1e-3 * torch.randn(7, 4, 2, generator=random, dtype=torch.float64)
    variance = 1e-7 * (1 + torch.rand(7, 4, 2, generator=random, dtype=torch.float64))
    gap[5] = torch.nan
    angle = torch.tensor([0.0, 0.07, -0.45, 2.0], dtype=torch.float64)
    starts = StartGaps(gap, variance, angle)
    sd = torch.tensor([1e-5, 1e-4, 5e-4, 1e-3, 1e-2, 1e-3, torch.nan], dtype=torch.float64)
    count = field.bumps * 2
    covariance = torch.diag_embed((sd**2)[:, None].expand(-1, count))
    expected = starts.log_free(field, sd, torch.zeros(7, count, dtype=torch.float64), covariance)
    found = starts.log_free_before(field, sd)
    torch.testing.assert_close(found, expected)
    assert torch.isfinite(found[:5]).all() and found[5] == -torch.inf
    one = StartGaps(gap[3:4], variance[3:4], angle)
    torch.testing.assert_close(one.log_free_before(field, sd[3:4]), found[3:4])


def test_the_probability_is_that_of_a_normal_gap(shape: PolygonShape) -> None:
    floor = torch.tensor([-0.02, -1e-3, 0.0, 5e-4, 2e-3], dtype=torch.float64)
    history = history_of(hovering(shape, 0.0))
    sd = torch.full((5,), SD, dtype=torch.float64)
    scene = scene_from_parameters(shape, Parameters.from_vector(theta(floor)))
    rows = torch.tensor([0])
    starts = start_gaps(scene.points_ee, history.setting(scene), history.poses[:, 2], rows)
    foot = scene.points_ee[0, scene.points_ee[0, :, 1].argmin(), 0].abs()
    noise = history.variance[0, 1] + foot**2 * history.variance[0, 2]
    expected = torch.special.log_ndtr(-floor / (noise + SD**2).sqrt())
    torch.testing.assert_close(starts.log_free_before(FIELD, sd), expected, rtol=1e-3, atol=1e-9)
    # Known to be 1 mm closer for sure, and 1 mm further away.
    bump = FIELD.basis(torch.zeros((), dtype=torch.float64))[0]
    mean = torch.cat((-1e-3 * bump / bump.square().sum(), torch.zeros_like(bump))).expand(5, -1)
    nothing = torch.zeros(5, mean.shape[1], mean.shape[1], dtype=torch.float64)
    left = SD**2 * (1 - bump.square().sum()).clamp_min(0.0)
    for sign in (1.0, -1.0):
        found = starts.log_free(FIELD, sd, sign * mean, nothing)
        expected = torch.special.log_ndtr((-floor - sign * 1e-3) / (noise + left).sqrt())
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-9)


def test_angles_of_pose_and_hand_turn_the_outline(shape: PolygonShape) -> None:
    """Turned by a quarter in the hand, the carton is as far from the floor as it is wide."""
    history = history_of(hovering(shape, 0.1))
    floor = torch.zeros(1, dtype=torch.float64)
    scene = scene_from_parameters(shape, Parameters.from_vector(theta(floor)))
    setting = history.setting(scene)
    quarter = torch.full((1, 1, 1), torch.pi / 2, dtype=torch.float64)
    turned = replace(setting, conditions=replace(setting.conditions, turn=quarter))
    rows = torch.tensor([0])
    found = start_gaps(scene.points_ee, turned, history.poses[:, 2], rows).gap[0, 0, 0]
    side = -float(scene.points_ee[0, :, 0].min())
    assert float(found) == pytest.approx(0.1 - lowest(shape) - side, abs=1e-9)
    # The pose itself, by as much the other way.
    poses = setting.merged.poses.clone()
    poses[:, 0, 2] = -torch.pi / 2
    back = replace(turned, merged=replace(setting.merged, poses=poses))
    found = start_gaps(scene.points_ee, back, history.poses[:, 2], rows).gap[0, 0, 0]
    assert float(found) == pytest.approx(0.1, abs=1e-9)


def test_a_start_just_above_the_floor_does_not_push_the_floor_down(shape: PolygonShape) -> None:
    """What the misfit at the floor is found to be is its gap at the start as well: the mean of the
    floor stays where contact says."""
    z = -lowest(shape)
    heights = (z + 3e-4, z - 4e-3)
    commands = torch.tensor([[0.0, h, 0.0] for h in heights], dtype=torch.float64)
    poses = commands.clone()
    poses[1, 1] = z
    touch = Episode(commands, poses, STIFFNESS * (poses - commands), STIFFNESS, NOISE)
    floor = torch.linspace(-5e-3, 5e-3, 401, dtype=torch.float64)
    weights = total(shape, theta(floor), history_of(touch)).softmax(0)
    # Taken for another misfit than that of the touch, the start would push it down by 0.5.
    assert abs(float(weights @ floor)) < 0.25 * SD


def test_more_recordings_of_one_start_say_no_more_than_one(shape: PolygonShape) -> None:
    floor = torch.tensor([5e-4], dtype=torch.float64)
    alone = total(shape, theta(floor), history_of(hovering(shape, 0.0)))
    far = total(shape, theta(floor - 0.05), history_of(hovering(shape, 0.0)))
    three = joined_history([hovering(shape, 0.0)] * 3)
    again = total(shape, theta(floor), three) - total(shape, theta(floor - 0.05), three)
    torch.testing.assert_close(again, alone - far)
    assert float(alone - far) < -1.0


def test_what_would_overlap_at_the_start_is_all_but_impossible(shape: PolygonShape) -> None:
    """On its way up the object tells nothing of the floor, but that it is not where it began."""
    floor = torch.tensor([-5e-3, 5e-3], dtype=torch.float64)
    below, inside = total(shape, theta(floor), history_of(hovering(shape, 0.0)))
    assert below - inside > 10.0
    walls = torch.cat((theta(floor[:1], wall=0.2), theta(floor[:1], wall=0.02)))
    clear, through = total(shape, walls, history_of(hovering(shape, 0.0)))
    assert clear - through > 100.0


def test_a_start_under_load_says_nothing_of_this_kind(shape: PolygonShape) -> None:
    assert free_starts(history_of(hovering(shape, 0.0))).tolist() == [0]
    assert free_starts(history_of(hovering(shape, 0.0, loaded=3.0))).tolist() == []


def test_each_recording_begins_anew_and_only_what_counts_is_asked(shape: PolygonShape) -> None:
    both = joined_history([hovering(shape, 0.0), hovering(shape, 0.01)])
    assert free_starts(both).tolist() == [0, 2]
    assert free_starts(both.using(torch.tensor([False, False, True]))).tolist() == [2]
    floor = torch.tensor([-5e-3, 5e-3], dtype=torch.float64)
    values = total(shape, theta(floor), both.using(torch.tensor([False, False, True])))
    torch.testing.assert_close(values[0], values[1])


def test_a_threshold_and_a_nan_concern_one_particle_alone(shape: PolygonShape) -> None:
    history = history_of(hovering(shape, 0.0))
    floor = torch.tensor([-5e-3, 5e-3, torch.nan], dtype=torch.float64)
    plain = total(shape, theta(floor), history)
    assert torch.isfinite(plain[:2]).all() and plain[2] == -torch.inf
    least = plain.nan_to_num(0.0) + torch.tensor([-1.0, -1.0, 0.0])
    torch.testing.assert_close(total(shape, theta(floor), history, least=least), plain)
    above = total(shape, theta(floor), history, least=least + 50.0)
    assert (above == -torch.inf).all()


def test_effects_move_the_floor_there_as_elsewhere(shape: PolygonShape) -> None:
    """A floor that drifts from -5 mm on is free at first, one that is tilted may not be."""
    history = history_of(hovering(shape, 0.0))
    floor = torch.full((2,), -1e-4, dtype=torch.float64)
    tilt = Added((find_effect("floor_tilt"),), torch.tensor([[0.0], [0.2]], dtype=torch.float64))
    flat, tilted = total(shape, theta(floor), history, added=tilt)
    assert flat - tilted > 10.0


@pytest.mark.parametrize("effect", [effect.name for effect in CATALOGUE])
def test_before_any_transition_any_effect_may_be_asked_for(
    shape: PolygonShape, effect: str
) -> None:
    """Draws of the prior with it, which the start tells apart."""
    settings = EstimatorSettings(misfit_sd=SD, effects=(find_effect(effect),))
    belief = prior_belief(first_row(shape), shape, torch.Generator().manual_seed(0), settings)
    assert torch.isfinite(belief.weights).all() and float(belief.weights.sum()) == pytest.approx(1)
    assert float(belief.weights.min()) < 1e-6 * float(belief.weights.max())


def test_before_any_transition_the_floor_may_be_tilted(shape: PolygonShape) -> None:
    """Draws with a corner deep below the tilted floor are impossible, those clear of it alike."""
    settings = EstimatorSettings(misfit_sd=SD, effects=(find_effect("floor_tilt"),))
    start, away = first_row(shape), torch.tensor([-0.3, 0.0, 0.0])
    start = replace(start, poses=start.poses + away, commands=start.commands + away)
    belief = prior_belief(start, shape, torch.Generator().manual_seed(0), settings)
    scene = scene_from_parameters(shape, belief.parameters)
    x, z = (scene.points_ee + start.poses[0, :2]).unbind(-1)
    tilt = belief.vectors[:, -1:]
    floor = belief.parameters.floor_height
    gap = (z * tilt.cos() - x * tilt.sin()).amin(-1) - floor * tilt[:, 0].cos()
    flat = z.amin(-1) - floor
    deep, clear = gap < -8e-3, gap > 8e-3
    told = deep & (flat > 0)
    assert int(told.sum()) > 5 and float(belief.weights[deep].sum()) < 1e-3
    assert float(belief.weights[clear].max() - belief.weights[clear].median()) < 1e-4


def test_before_any_transition_draws_are_weighted_by_it(shape: PolygonShape) -> None:
    start = first_row(shape)
    belief = prior_belief(
        start, shape, torch.Generator().manual_seed(0), EstimatorSettings(misfit_sd=SD)
    )
    scene = scene_from_parameters(shape, belief.parameters)
    gap = (scene.points_ee[..., 1] + start.poses[0, 1]).amin(-1) - belief.parameters.floor_height
    deep, clear = belief.weights[gap < -8e-3], belief.weights[gap > 8e-3]
    assert len(deep) > 20 and float(deep.sum()) < 1e-3
    assert float(clear.max() - clear.median()) < 1e-4
    pressed = torch.tensor([0.0, 5e-3, 0.0], dtype=torch.float64)
    leans = replace(
        start, commands=start.commands - pressed, wrenches=start.wrenches + STIFFNESS * pressed
    )
    loaded = prior_belief(leans, shape, torch.Generator().manual_seed(0))
    assert float(loaded.weights.max() - loaded.weights.min()) == 0.0
    below = torch.tensor([0.0, 0.2, 0.0])
    nowhere = replace(start, poses=start.poses - below, commands=start.commands - below)
    lost = prior_belief(nowhere, shape, torch.Generator().manual_seed(0))
    assert float(lost.weights.max() - lost.weights.min()) == 0.0
