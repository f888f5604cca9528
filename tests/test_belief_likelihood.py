"""The history likelihood against brute force: merging, misfit, outliers, per-element truth."""

from __future__ import annotations

import math
from dataclasses import replace

import filter_oracle
import pytest
import torch
from torch import Tensor

from tpcd.belief import likelihood
from tpcd.belief.belief import estimate
from tpcd.belief.filter import HistoryLikelihood, filter_history
from tpcd.belief.free_start import free_starts, start_gaps
from tpcd.belief.history import History, history_of
from tpcd.belief.likelihood import effective_setting, highest_terms, history_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.belief.setting import PARITY_LIMIT
from tpcd.belief.settings import EstimatorSettings, SamplerSettings
from tpcd.contact import ContactScene, scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.effects.catalogue import find_effect
from tpcd.effects.conditions import Conditions
from tpcd.effects.protocol import Added
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import StepSettings, StepStatus, simulate_step
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

FIELD = MisfitField(sd=1e-3, grain=0.2, roughness=15.0)


@pytest.fixture(scope="module")
def shape() -> PolygonShape:
    return PolygonShape(builtin_outlines()["mug"])


@pytest.fixture(scope="module")
def episode(shape: PolygonShape) -> Episode:
    generator = torch.Generator().manual_seed(1)
    scene = draw_scene("mug", shape.outline.vertices, generator)
    motion = make_motion("rich", scene, 6, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 6, generator).measured


@pytest.fixture(scope="module")
def particles(shape: PolygonShape) -> Tensor:
    prior = make_prior(shape)
    return prior.to_vector(prior.sample(12, torch.Generator().manual_seed(2)))


def test_merging_pose_and_wrench_keeps_what_a_normal_of_six_dimensions_says(
    episode: Episode,
) -> None:
    """Log densities of pose and wrench at two settled poses differ as those of the merged."""
    history = history_of(episode, least_std=0.0)
    generator = torch.Generator().manual_seed(0)
    poses = episode.poses[1:] + 1e-3 * torch.randn(2, 6, 3, generator=generator).double()
    std, stiffness = episode.sensor_std, episode.stiffness

    def six(settled: Tensor) -> Tensor:
        wrench = stiffness * (settled - episode.commands[1:])
        error = torch.cat((episode.poses[1:] - settled, episode.wrenches[1:] - wrench), -1)
        return -0.5 * (error / std).square().sum(-1)

    def three(settled: Tensor) -> Tensor:
        return -0.5 * ((history.settled - settled) ** 2 / history.variance[1:]).sum(-1)

    good = history_of(episode).merged.chi_square[0, 1:] <= PARITY_LIMIT
    assert good.any()
    torch.testing.assert_close(
        (six(poses[0]) - six(poses[1]))[good], (three(poses[0]) - three(poses[1]))[good]
    )


def evaluate(
    shape: PolygonShape,
    vectors: Tensor,
    history: History,
    field: MisfitField = FIELD,
    least: Tensor | None = None,
) -> HistoryLikelihood:
    sd = torch.full((len(vectors),), field.sd, dtype=torch.float64)
    parameters = Parameters.from_vector(vectors)
    return history_likelihood(shape, parameters, sd, history, field, StepSettings(), least)


def of_the_start(scene: ContactScene, history: History, field: MisfitField, sd: Tensor) -> Tensor:
    """What the free start says, given the field that is found."""
    setting, rows = history.setting(scene), free_starts(history)
    assert rows.tolist() == [0]
    found = filter_history(scene.points_ee, setting, sd, field, StepSettings())
    gaps = start_gaps(scene.points_ee, setting, history.poses[:, 2], rows)
    return gaps.log_free(field, sd, found.field_mean, found.field_covariance)


@pytest.mark.parametrize("sd", [0.0, 1e-3])
def test_the_last_transition_changes_nothing_of_what_came_before(
    shape: PolygonShape, episode: Episode, particles: Tensor, sd: float
) -> None:
    history, field = history_of(episode), MisfitField(sd=sd)
    whole = evaluate(shape, particles, history, field)
    shorter = evaluate(shape, particles, history.first(5), field)
    last = highest_terms(history)[-1]
    assert (whole.total <= shorter.total + last + 1e-9).all()
    scene = scene_from_parameters(shape, Parameters.from_vector(particles))
    sds = torch.full((len(particles),), sd, dtype=torch.float64)
    setting = history.setting(scene)
    each = filter_history(scene.points_ee, setting, sds, field, StepSettings(), innovations=True)
    terms = -(0.5 * each.whitened**2 + each.log_scale + 0.5 * math.log(2 * math.pi)).sum(-1)
    known = torch.isfinite(shorter.total)
    assert known.any()
    first = history.first(5)
    known = known & torch.isfinite(terms).flatten(1).all(-1)
    start = of_the_start(scene, first, field, sds)
    torch.testing.assert_close(shorter.total[known], (start + terms[:, :5].sum(-1))[known])
    if sd == 0.0:
        assert whole.field_mean.shape == (12, 0)


def test_the_filter_is_that_of_the_oracle(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    history = history_of(episode)
    found = evaluate(shape, particles, history)
    scene = scene_from_parameters(shape, Parameters.from_vector(particles))
    sd = torch.full((len(particles),), FIELD.sd, dtype=torch.float64)
    setting = history.setting(scene)
    expected = filter_oracle.filter_history(scene.points_ee, setting, sd, FIELD, StepSettings())
    start = of_the_start(scene, history, FIELD, sd)
    expected = replace(expected, total=expected.total + start)
    for name in ("total", "field_mean", "field_covariance"):
        value = getattr(expected, name)
        scale = FIELD.sd ** ("field_mean", "field_covariance").index(name) if "field" in name else 1
        torch.testing.assert_close(getattr(found, name), value, rtol=1e-8, atol=1e-8 * scale)


def test_the_filter_is_that_of_the_oracle_where_the_ground_gives_way(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    """By up to 2 mm; where it gives way by no number, that particle alone is impossible."""
    history = history_of(episode)
    scene = scene_from_parameters(shape, Parameters.from_vector(particles))
    setting = history.setting(scene)
    count, rows = len(particles), len(episode)
    give = torch.zeros(count, rows, 3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(5)
    give[..., :2] = 2e-3 * torch.rand(count, rows, 2, generator=generator, dtype=torch.float64)
    give[1, 3, 0] = torch.nan
    setting = replace(setting, conditions=replace(setting.conditions, give=give))
    sd = torch.full((count,), FIELD.sd, dtype=torch.float64)
    arguments = (scene.points_ee, setting, sd, FIELD, StepSettings())
    found = filter_history(*arguments, steps=True)
    expected = filter_oracle.filter_history(*arguments, steps=True)
    assert found.total[1] == expected.total[1] == -torch.inf
    others = torch.arange(count) != 1
    assert torch.isfinite(found.total[others]).any()
    torch.testing.assert_close(found.total[others], expected.total[others], rtol=1e-8, atol=1e-8)
    likely = torch.isfinite(found.total)
    assert found.steps is not None and expected.steps is not None
    torch.testing.assert_close(found.steps.pose[likely], expected.steps.pose[likely])
    plain = evaluate(shape, particles, history).total
    assert (found.total[likely] - plain[likely]).abs().max() > 1


def test_the_filter_is_that_of_the_oracle_where_outlines_are_warped(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    """Each row by up to 2 mm of its own; where by no number, that particle alone is impossible."""
    history = history_of(episode)
    scene = scene_from_parameters(shape, Parameters.from_vector(particles))
    setting = history.setting(scene)
    count, points = scene.points_ee.shape[:2]
    generator = torch.Generator().manual_seed(5)
    warp = torch.rand(count, len(episode), points, 2, generator=generator, dtype=torch.float64)
    warp = 2e-3 * warp
    warp[1, 3, 0] = torch.nan
    setting = replace(setting, conditions=replace(setting.conditions, warp=warp))
    sd = torch.full((count,), FIELD.sd, dtype=torch.float64)
    found = filter_history(scene.points_ee, setting, sd, FIELD, StepSettings())
    expected = filter_oracle.filter_history(scene.points_ee, setting, sd, FIELD, StepSettings())
    assert found.total[1] == expected.total[1] == -torch.inf
    others = torch.arange(count) != 1
    assert torch.isfinite(found.total[others]).any()
    torch.testing.assert_close(found.total[others], expected.total[others], rtol=1e-8, atol=1e-8)
    likely = torch.isfinite(found.total)
    plain = evaluate(shape, particles, history).total
    assert (found.total[likely] - plain[likely]).abs().max() > 1


def test_particles_over_an_uneven_floor_are_evaluated_in_groups_to_the_same_bits(
    shape: PolygonShape, episode: Episode, particles: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    history, count = history_of(episode), len(particles)
    bump = torch.tensor([[1e-3, 0.03, 0.02]], dtype=torch.float64).expand(count, -1)
    added = Added((find_effect("floor_height ~ bump"),), bump)
    sd = torch.full((count,), FIELD.sd, dtype=torch.float64)
    found = []
    for size in (count, 3):
        monkeypatch.setattr(likelihood, "AT_ONCE", size)
        parameters = Parameters.from_vector(particles)
        arguments = (shape, parameters, sd, history, FIELD, StepSettings())
        found.append(history_likelihood(*arguments, added=added, innovations=True, steps=True))
    whole, groups = found
    assert count > 4 and torch.isfinite(whole.total).any()
    assert torch.equal(whole.total, groups.total)
    assert torch.equal(whole.field_covariance, groups.field_covariance)
    torch.testing.assert_close(whole.whitened, groups.whitened, rtol=0, atol=0, equal_nan=True)
    pose, same = whole.steps.pose, groups.steps.pose
    torch.testing.assert_close(pose, same, rtol=0, atol=0, equal_nan=True)
    plain = evaluate(shape, particles, history).total
    assert (whole.total - plain).nan_to_num(0.0, 0.0, 0.0).abs().max() > 1


@pytest.mark.parametrize("effect", ["floor_compliance", "grasp_compliance", "force_bias"])
def test_where_no_particle_has_a_chance_none_is_evaluated(
    shape: PolygonShape,
    episode: Episode,
    particles: Tensor,
    effect: str,
) -> None:
    added = Added((found := find_effect(effect),), torch.zeros(3, len(found.parameters)).double())
    sd = torch.full((3,), FIELD.sd, dtype=torch.float64)
    parameters = Parameters.from_vector(particles[:3])
    arguments = (shape, parameters, sd, history_of(episode), FIELD, StepSettings())
    assert (history_likelihood(*arguments, torch.full_like(sd, torch.inf), added=added).total
            == -torch.inf).all()  # fmt: skip


def test_what_a_row_is_loaded_with_counts_where_its_transition_does_not(
    shape: PolygonShape,
    episode: Episode,
    particles: Tensor,
) -> None:
    """Surfaces that yield answer to the change of load since then."""
    history = history_of(episode)
    effects = tuple(find_effect(name) for name in ("floor_compliance", "tangential_compliance"))
    added = Added(effects, torch.full((len(particles), 2), 4e-4, dtype=torch.float64))
    scene = scene_from_parameters(shape, Parameters.from_vector(particles))
    sd = torch.full((len(particles),), FIELD.sd, dtype=torch.float64)

    def conditions(history: History) -> Conditions:
        arguments = (scene, history, sd, FIELD, StepSettings(), added)
        return effective_setting(*arguments)[0].conditions

    whole = conditions(history)
    assert whole.give.abs().max() > 1e-4
    for k in range(len(history) - 1):
        left_out = conditions(history.using(torch.arange(len(history)) != k))
        torch.testing.assert_close(left_out.give[:, k + 2], whole.give[:, k + 2])


def test_no_term_exceeds_the_density_of_its_noise_at_zero(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    history = history_of(episode)
    highest = highest_terms(history)
    totals = [evaluate(shape, particles, history.first(k)).total for k in range(1, 7)]
    terms = torch.stack([totals[0], *(b - a for a, b in zip(totals, totals[1:], strict=False))])
    assert (terms <= highest[:, None] + 1e-9).all()
    assert (terms > -torch.inf).any()


def test_a_threshold_changes_only_what_stays_below_it(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    history = history_of(episode)
    plain = evaluate(shape, particles, history).total
    least = torch.full_like(plain, float(plain.median()))
    least[0], least[1] = torch.inf, -torch.inf
    found = evaluate(shape, particles, history, least=least).total
    above = plain >= least
    assert above.any() and not above.all()
    torch.testing.assert_close(found[above], plain[above], rtol=0, atol=0)
    given_up = found == -torch.inf
    assert (given_up | (found == plain)).all()
    assert given_up[0] and not given_up[1] and not (given_up & above).any()


def test_a_nan_particle_is_impossible_and_changes_no_other(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    history = history_of(episode)
    clean = evaluate(shape, particles, history)
    broken = particles.clone()
    broken[4, 0] = torch.nan
    found = evaluate(shape, broken, history)
    others = torch.arange(12) != 4
    assert found.total[4] == -torch.inf
    torch.testing.assert_close(found.total[others], clean.total[others], atol=0, rtol=0)
    torch.testing.assert_close(found.field_mean[others], clean.field_mean[others])
    assert torch.isfinite(found.field_covariance).all()


def test_a_jammed_particle_is_answered_like_the_torch_path(
    shape: PolygonShape, episode: Episode
) -> None:
    """Friction of 1.5, and a floor and a wall that reach 1 mm into the object at its start: no
    motion satisfies what is linearised there."""
    prior, history = make_prior(shape), history_of(episode)
    names = prior.names
    jammed = prior.to_vector(prior.sample(40, torch.Generator().manual_seed(2)))
    jammed[:, names.index("friction")] = 1.5
    points = scene_from_parameters(shape, Parameters.from_vector(jammed)).points_ee
    at_start = points + history.start[0, :2]
    jammed[:, names.index("floor_height")] = at_start[..., 1].amin(-1) + 0.001
    jammed[:, names.index("wall_position")] = at_start[..., 0].amax(-1) - 0.001
    scene = scene_from_parameters(shape, Parameters.from_vector(jammed))
    starts, rest = (row[1].expand(40, 3) for row in (history.start, history.previous))
    settled = simulate_step(
        scene, starts, rest, history.stiffness, StepSettings(substeps=1), unusual=True
    )
    assert (settled.status == int(StepStatus.RELAXED)).any()
    sd = torch.full((len(jammed),), FIELD.sd, dtype=torch.float64)
    setting = history.setting(scene)
    expected = filter_oracle.filter_history(scene.points_ee, setting, sd, FIELD, StepSettings())
    found = evaluate(shape, jammed, history)
    start = of_the_start(scene, history, FIELD, sd)
    torch.testing.assert_close(found.total, start + expected.total, rtol=0, atol=1e-4)


def test_one_chunk_or_many_and_any_order_of_particles_agree(
    shape: PolygonShape, episode: Episode, particles: Tensor
) -> None:
    history = history_of(episode)

    def total(vectors: Tensor) -> Tensor:
        return evaluate(shape, vectors, history).total

    whole = total(particles)
    torch.testing.assert_close(torch.cat([total(part) for part in particles.split(5)]), whole)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(total(particles[order]), whole[order])


@pytest.mark.parametrize("spike", ["pose", "force"])
def test_one_bad_reading_moves_the_belief_by_little_more_than_a_posterior_sd(
    shape: PolygonShape, episode: Episode, spike: str
) -> None:
    """20 mm in a pose or 10 N in a force at row 4, against the same episode without."""
    rows = len(episode)
    if spike == "pose":
        change = torch.zeros(rows, 3, dtype=torch.float64)
        change[4, 1] = 0.020
        bad = replace(episode, poses=episode.poses + change)
    else:
        change = torch.zeros(rows, 3, dtype=torch.float64)
        change[4, 0] = 10.0
        bad = replace(episode, wrenches=episode.wrenches + change)
    settings = EstimatorSettings(sampler=SamplerSettings(particles=400), misfit_sd=5e-4)

    def last(data: Episode) -> tuple[Tensor, Tensor]:
        *_, step = estimate(data, shape, torch.Generator().manual_seed(0), settings)
        return step.belief.mean(), step.belief.std()

    clean_mean, clean_std = last(episode)
    mean, std = last(bad)
    # Losing the row costs what it taught, here about friction; it must not make the belief
    # surely wrong.
    shift = (mean - clean_mean).abs() / torch.maximum(std, clean_std)
    assert shift.max() < 1.5
    assert shift.median() < 0.5
