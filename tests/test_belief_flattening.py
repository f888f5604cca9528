"""The map to flat coordinates: an exact change of coordinates, and flat where contact is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from eval.drawn import draw_episode
from tpcd.belief.belief import target_of
from tpcd.belief.contact_rows import LINEAR
from tpcd.belief.flattening import INSIDE, Flattening, flattening
from tpcd.belief.history import History, history_of
from tpcd.belief.prior import ParameterPrior, make_prior
from tpcd.belief.settings import EstimatorSettings
from tpcd.belief.target import ContactTarget
from tpcd.planar import rotate
from tpcd.shape.checkpoint import load_prior

SETTINGS = EstimatorSettings(misfit_sd=2e-4, misfit_spread=0.0)
SEEDS = range(70, 90)
"""Of drawn episodes; nothing was chosen by them."""


def drawn(seed: int, steps: int = 6) -> tuple[Tensor, ContactTarget]:
    """The true score of an episode drawn from the model, and the posterior given it."""
    shape = load_prior("ycb21-z2")
    prior, generator = make_prior(shape), torch.Generator().manual_seed(seed)
    truth, episode = draw_episode(prior, SETTINGS, steps, generator)
    target = target_of(episode, shape, SETTINGS).given(history_of(episode))
    return torch.cat((prior.to_score(truth[:-1]), torch.zeros(1)))[None].double(), target


@pytest.fixture(scope="module")
def episodes() -> list[tuple[Tensor, ContactTarget]]:
    return [drawn(seed) for seed in SEEDS]


def at_truth(score: Tensor, target: ContactTarget) -> Flattening:
    contact = target.log_likelihood_and_contact(score)[1]
    return target.coordinates(score, torch.ones(1, dtype=torch.float64), contact)


def test_back_and_forth_is_the_same_and_slopes_are_those_of_differences(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    truth, target = episodes[0]
    found = at_truth(truth, target)
    generator = torch.Generator().manual_seed(0)
    score = 0.7 * torch.randn(7, truth.shape[-1], generator=generator, dtype=torch.float64)
    flat, log_slope = found.from_score(score)
    back, again = found.to_score(flat)
    torch.testing.assert_close(back, score, atol=1e-9, rtol=0)
    torch.testing.assert_close(again, log_slope, atol=1e-9, rtol=0)
    step = 1e-6 * torch.eye(score.shape[-1], dtype=torch.float64)
    columns = [
        (found.from_score(score + row)[0] - found.from_score(score - row)[0]) / 2e-6 for row in step
    ]
    jacobian = torch.stack(columns, dim=-1)
    torch.testing.assert_close(-torch.linalg.slogdet(jacobian)[1], log_slope, atol=1e-5, rtol=0)


def test_entries_are_about_standard_normal_at_the_truth(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    """A quarter of standard normal numbers is below 0.32 in size, a half below 0.67 and a tenth
    above 1.64. The prior's box is taken for a normal, and rolling for a line, so not quite."""
    sizes = torch.cat(
        [at_truth(*each).from_score(each[0])[0][:, at_truth(*each).entries] for each in episodes]
    ).abs()
    assert 0.5 < float(sizes.median()) < 0.85
    assert 0.04 < float((sizes > 1.64).double().mean()) < 0.2
    assert float((sizes > 4).double().mean()) < 0.02


def test_the_six_are_pinned_far_below_the_prior(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    """Given the rest, their joint volume is a small part of the prior's."""
    for truth, target in episodes[:5]:
        found, none = at_truth(truth, target), untouched(target.prior, target)
        pinned = found.from_score(truth)[1] - none.from_score(truth)[1]
        assert float(pinned) < math.log(1e-3)


def untouched(prior: ParameterPrior, target: ContactTarget) -> Flattening:
    assert target.history is not None
    nothing = torch.zeros(len(target.history), 2, dtype=torch.bool)
    return flattening(prior, target.misfit, target.history, nothing, nothing)


def test_without_contact_the_entries_are_places_in_their_boxes(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    truth, target = episodes[1]
    found = untouched(target.prior, target)
    flat, _ = found.from_score(truth)
    low, high = (edge[found.entries] for edge in (target.prior.low, target.prior.high))
    value = target.prior.to_vector(truth[:, :-1])[:, found.entries]
    expected = (value - 0.5 * (low + high)) / (high - low) * math.sqrt(12)
    torch.testing.assert_close(flat[:, found.entries], expected)


def test_what_leaves_its_box_is_infinite_and_has_no_density(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    truth, target = episodes[2]
    found = at_truth(truth, target)
    flat, _ = found.from_score(truth)
    flat = flat.repeat(2, 1)
    flat[1, found.entries[0]] += 1e4
    score, _ = found.to_score(flat)
    assert torch.isfinite(score[0]).all() and torch.isinf(score[1]).any()
    log_prior = target.log_prior(score)
    assert float(log_prior[1]) == -math.inf and math.isfinite(float(log_prior[0]))
    total = target.log_likelihood(score, torch.where(torch.isfinite(log_prior), 0.0, torch.inf))
    alone = target.log_likelihood(score[:1], torch.zeros(1, dtype=torch.float64))
    assert float(total[1]) == -math.inf
    torch.testing.assert_close(total[:1], alone)


def test_the_likeliest_six_are_the_best_of_their_box(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    """None of many places in the box has a larger normal density; where the mean is in it, the mean
    is taken. An absurd latent does not disturb the others."""
    inside = 0
    for truth, target in episodes[:4]:
        found = at_truth(truth, target)
        generator = torch.Generator().manual_seed(5)
        rest = target.sample(200, generator)
        score, likely = found.likeliest(rest)
        others = [k for k in range(rest.shape[-1]) if k not in found.entries]
        assert torch.equal(score[:, others], rest[:, others])
        assert torch.isfinite(score).all()

        def log_normal(at: Tensor, found: Flattening = found) -> Tensor:
            flat, _ = found.from_score(at)
            return found.log_marginal(flat) - 0.5 * flat[:, found.entries].square().sum(-1)

        torch.testing.assert_close(log_normal(score), likely, atol=1e-5, rtol=1e-6)
        for size in (1.0, 0.1, 0.01):
            place = torch.special.ndtr(score[:, found.entries])
            step = size * torch.randn(place.shape, generator=generator, dtype=place.dtype)
            other = score.clone()
            other[:, found.entries] = torch.special.ndtri((place + step).clamp(INSIDE, 1 - INSIDE))
            assert bool((log_normal(other) <= likely + 1e-5 * likely.abs()).all())
        flat = rest.clone()
        flat[:, found.entries] = 0.0
        place = torch.special.ndtr(found.to_score(flat)[0][:, found.entries])
        within = ((place > INSIDE) & (place < 1 - INSIDE)).all(-1)
        inside += int(within.sum())
        torch.testing.assert_close(score[within], found.to_score(flat)[0][within])
        rest[3, 0], rest[3, -1] = -60.0, 400.0
        found = replace(found, misfit=replace(found.misfit, spread=2.0))
        again, there = found.likeliest(rest)
        assert torch.isfinite(again[3]).all()
        score, likely = found.likeliest(torch.cat((rest[:3], rest[4:])))
        kept = torch.arange(200) != 3
        torch.testing.assert_close(again[kept], score)
        torch.testing.assert_close(there[kept], likely)
    assert 20 < inside < 700


def test_rows_that_points_contradict_are_left_out(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    """A slide that is taken for rolling says that the floor is elsewhere."""
    one = torch.ones(1, dtype=torch.float64)
    for truth, target in episodes:
        history = target.history
        assert history is not None
        touched = torch.zeros(len(history), 2, dtype=torch.bool)
        touched[:, 0] = True
        wrong = flattening(target.prior, target.misfit, history, touched, touched)
        six = target.prior.to_vector(truth[:, :-1])[:, wrong.entries]
        off = (six @ wrong.rows.mT - wrong.values)[0].abs()
        if slides_and_turns(history) and float(off.max()) > 5:
            break
    else:
        pytest.fail("no episode contradicts that all slides are rolling")
    kept = wrong.consistent(truth, one)
    assert len(kept.rows) == int((off < 3).sum()) < len(wrong.rows)


def test_touches_that_points_contradict_are_left_out(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    """No outline touches the wall where it lies on the floor alone."""
    truth, target = episodes[0]
    history = target.history
    assert history is not None
    nothing = torch.zeros(len(history), 2, dtype=torch.bool)
    everything = torch.ones(len(history), 2, dtype=torch.bool)
    wrong = flattening(target.prior, target.misfit, history, everything, nothing)
    right = at_truth(truth, target)
    kept = wrong.consistent(truth, torch.ones(1, dtype=torch.float64))
    assert int((wrong.terrains == 1).sum()) == len(history)
    assert kept.terrains.tolist() == right.terrains.tolist()
    torch.testing.assert_close(kept.poses, right.poses)


def slides_and_turns(history: History) -> bool:
    turn = (history.settled - history.start)[:, 2].abs() > 0.1
    moved = (history.settled - history.start)[:, 0].abs() > 0.02
    return bool((turn & moved)[1:].any())


def test_absurd_points_do_not_disturb_their_neighbours(
    episodes: list[tuple[Tensor, ContactTarget]],
) -> None:
    """A misfit of kilometres, latents far out, entries at the edge of their boxes; all readings at
    one angle and no grain, so that large misfits are alike in all of them."""
    truth, target = episodes[3]
    found = at_truth(truth, target)
    poses = found.poses.clone()
    poses[:, 2] = poses[0, 2]
    bare = replace(found.misfit, grain=0.0, spread=2.0)
    found = replace(found, poses=poses, misfit=bare)
    many = truth.repeat(4, 1)
    many[1, -1], many[2, 0], many[3, found.entries] = 400.0, -60.0, math.inf
    flat, log_slope = found.from_score(many)
    # As many rows, since decoding one row rounds otherwise than decoding four.
    usual, slope = found.from_score(truth.repeat(4, 1))
    torch.testing.assert_close(flat[:1], usual[:1])
    torch.testing.assert_close(log_slope[:1], slope[:1])
    assert torch.isfinite(flat).all()
    back, _ = found.to_score(flat)
    torch.testing.assert_close(back[:3], many[:3], atol=1e-6, rtol=0)


@pytest.mark.parametrize("at_once", [1, 3, 100])
def test_touches_are_where_each_outline_is_lowest(
    episodes: list[tuple[Tensor, ContactTarget]], at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many outlines are taken at once, for each as a loop over its points says."""
    monkeypatch.setattr("tpcd.belief.flattening._OUTLINES_AT_ONCE", at_once)
    truth, target = episodes[0]
    found = at_truth(truth, target)
    noise = torch.randn(7, truth.shape[-1], generator=torch.Generator().manual_seed(1)).double()
    vector = target.prior.to_vector((truth + 0.5 * noise)[:, :-1])
    design, _ = found._touches(vector)
    scale = found.entries.index(target.prior.names.index("scale"))
    parameters = target.prior.parameters_of(vector)
    assert len(found.poses) > 1
    for k, outline in enumerate(target.prior.shape.boundary_points(parameters.latent).double()):
        for c, normal in enumerate(found.normals):
            angle = found.poses[c, 2] + parameters.mount[k, 2]
            lowest = (rotate(angle[None], outline) @ normal).min()
            torch.testing.assert_close(design[k, c, scale], lowest)
    assert found._touches(vector[:0])[0].shape == (0, len(found.poses), 6)


def test_the_linear_entries_are_named_in_the_order_of_theta() -> None:
    prior = make_prior(load_prior("ycb21-z2"))
    entries = [prior.names.index(name) for name in LINEAR]
    assert entries == sorted(entries)
