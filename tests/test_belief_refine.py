"""The last belief of an episode, found once more with many more draws."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from linear_model import DIMENSION, LinearModel
from short_episode import short_episode

from tpcd.belief import EstimatorSettings, SamplerSettings, refine
from tpcd.belief.belief import EstimationStep, target_of
from tpcd.belief.cloud import start_cloud
from tpcd.belief.importance import assimilate
from tpcd.belief.state import load_state
from tpcd.belief.storage import load_belief
from tpcd.commands.estimation import run_estimation
from tpcd.data.episode import Episode
from tpcd.effects import find_effect
from tpcd.exploration import Estimator
from tpcd.shape.checkpoint import load_prior
from tpcd.threads import torch_in_one_thread

PRIOR, STEPS = "ycb21-z2", 4
SETTINGS = EstimatorSettings(
    sampler=SamplerSettings(particles=64, draws=600),
    closing=SamplerSettings(
        rough=False,
        draws=3000,
        fresh_modes=60,
        flat_rounds=4,
        flat_worth=math.inf,
        flat_starts=4000,
        flat_draws=800,
    ),
)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return short_episode(STEPS)


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return Estimator(load_prior(PRIOR), settings=SETTINGS)


@pytest.fixture(scope="module")
def steps(episode: Episode, estimator: Estimator) -> list[EstimationStep]:
    return list(estimator.steps(episode, torch.Generator().manual_seed(0)))


def test_the_same_data_again_count_once() -> None:
    model, settings = LinearModel(4), SamplerSettings(particles=2000, draws=6000)
    generator = torch.Generator().manual_seed(2)
    normal = torch.randn(500, DIMENSION, generator=generator, dtype=torch.float64)
    cloud = start_cloud(normal)
    for _ in range(3):
        cloud, _ = assimilate(cloud, model.target(4), 4, settings, generator)
    mean, covariance, log_evidence = model.posterior(4)
    std = covariance.diagonal().sqrt()
    assert ((cloud.weights @ cloud.positions - mean).abs() / std).max() < 0.1
    found = (cloud.weights @ (cloud.positions - mean) ** 2).sqrt()
    torch.testing.assert_close(found, std, rtol=0.08, atol=0)
    assert abs(cloud.log_evidence - log_evidence) < 4 * cloud.log_evidence_std


def test_the_closing_budget_has_the_particles_of_the_other_and_more_draws_for_effects() -> None:
    closing = SamplerSettings(particles=700, places=35, draws=550, modes=15, fresh_modes=55)
    given = EstimatorSettings(sampler=SamplerSettings(particles=40, draws=110), closing=closing)
    assert given.closing_budget == replace(closing, particles=40)
    assert given.budget.draws == 110
    effect = replace(given, effects=(find_effect("adhesion"),))
    assert effect.closing_budget == replace(closing, particles=40, draws=1650)
    assert effect.budget.draws == 330


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("closing_passes", 0, "at least 1"),
        ("closing_worth", math.nan, "at least 0"),
        ("likelihood_power", 0.0, "above 0 and at most 1"),
        ("likelihood_power", 1.1, "above 0 and at most 1"),
    ],
)
def test_settings_without_meaning_are_refused(name: str, value: float, expected: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is .*, expected {expected}"):
        EstimatorSettings(**{name: value})


def test_the_likelihood_counts_to_the_power_of_the_settings(
    episode: Episode, estimator: Estimator
) -> None:
    for power in (0.5, 1.0):
        settings = replace(SETTINGS, likelihood_power=power)
        assert target_of(episode, estimator.shape, settings).power == power


def test_it_draws_as_often_as_the_closing_budget_says_and_the_same_every_time(
    episode: Episode, estimator: Estimator, steps: list[EstimationStep]
) -> None:
    last = steps[-1]
    before = {name: value.clone() for name, value in last.state.tensors.items()}
    closed = refine(episode, estimator.shape, last.state, SETTINGS)
    again = refine(episode, estimator.shape, last.state, SETTINGS)
    assert last.info.draws == 600 and closed.info.draws == 3000
    assert torch.equal(closed.belief.vectors, again.belief.vectors)
    assert torch.equal(closed.belief.weights, again.belief.weights)
    assert not torch.equal(closed.belief.vectors, last.belief.vectors)
    assert closed.index == STEPS and closed.state is last.state
    for name, value in before.items():
        assert torch.equal(last.state.tensors[name], value)
    whole = estimator.learn(episode, torch.Generator().manual_seed(0))
    assert torch.equal(whole.belief.vectors, closed.belief.vectors)


def test_the_mixture_is_adapted_again_while_too_few_draws_count(
    episode: Episode, estimator: Estimator, steps: list[EstimationStep]
) -> None:
    def closed(passes: int, worth: float) -> EstimationStep:
        settings = replace(SETTINGS, closing_passes=passes, closing_worth=worth)
        return refine(episode, estimator.shape, steps[-1].state, settings)

    one, two, three = (closed(passes, math.inf) for passes in (1, 2, 3))
    spent = [each.info.evaluations for each in (one, two, three)]
    # The first pass looks for modes besides; each has four rounds, the last of which only shapes
    # the mixture, and draws that count.
    assert spent[1] - spent[0] == spent[2] - spent[1] == 3 * 800 + 3000 < spent[0]
    assert [each.info.draws for each in (one, two, three)] == [3000] * 3
    rounds = SETTINGS.closing.rounds
    assert [each.info.rounds for each in (one, two, three)] == [rounds + 4, rounds + 8, rounds + 12]
    assert not torch.equal(one.belief.vectors, two.belief.vectors)
    # Where the draws after the first pass already count enough, it is the only one.
    enough = closed(3, 1e-9)
    assert enough.info.evaluations == spent[0] and enough.info.rounds == rounds + 4
    assert len(enough.belief.vectors) > 1


def test_without_rounds_in_flat_coordinates_there_is_one_pass(
    episode: Episode, estimator: Estimator, steps: list[EstimationStep]
) -> None:
    plain = replace(SETTINGS, closing=replace(SETTINGS.closing, flat_rounds=0), closing_passes=3)
    found = refine(episode, estimator.shape, steps[-1].state, plain)
    assert found.info.rounds == SETTINGS.closing.rounds and found.info.draws == 3000


def test_the_middle_of_an_episode_is_refined_from_its_own_data(
    episode: Episode, estimator: Estimator, steps: list[EstimationStep]
) -> None:
    two = refine(episode.first(3), estimator.shape, steps[1].state, SETTINGS).belief
    cut = refine(episode, estimator.shape, steps[1].state, SETTINGS).belief
    assert torch.equal(two.vectors, cut.vectors)


def test_the_papers_filter_is_left_as_it_is(episode: Episode, estimator: Estimator) -> None:
    paper = Estimator(estimator.shape, "paper")
    *_, last = paper.steps(episode, torch.Generator().manual_seed(0))
    assert paper.closing is None
    whole = paper.learn(episode, torch.Generator().manual_seed(0))
    assert torch.equal(whole.belief.vectors, last.belief.vectors)


def test_a_run_ends_with_the_closing_draws_and_one_stopped_during_them_does_too(
    episode: Episode, estimator: Estimator, steps: list[EstimationStep], tmp_path: Path
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    folder = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        run_estimation(iter(steps), episode, PRIOR, folder, show_progress=False, closing=stop)
    assert not (folder / "summary.json").exists()
    torch.testing.assert_close(load_belief(folder).vectors, steps[-1].belief.vectors)
    found = run_estimation(
        iter(()),
        episode,
        PRIOR,
        folder,
        show_progress=False,
        state=load_state(folder, episode, PRIOR),
        closing=estimator.closing,
    )
    expected = refine(episode, estimator.shape, steps[-1].state, SETTINGS)
    assert torch.equal(found.vectors, expected.belief.vectors)
    assert torch.equal(load_belief(folder).vectors, found.vectors)
    rows = [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3, 4]
    assert rows[-1]["closed"]["effective_sample_size"] == expected.info.effective_sample_size
    assert rows[-1]["effective_sample_size"] == steps[-1].info.effective_sample_size
    assert "closed" not in rows[-2]


def test_where_the_closing_draws_explain_nothing_the_belief_stays(
    episode: Episode, steps: list[EstimationStep], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    def nothing(*_: object) -> EstimationStep:
        raise ValueError("no particle explains")

    found = run_estimation(
        iter(steps), episode, PRIOR, tmp_path, show_progress=False, closing=nothing
    )
    assert torch.equal(found.vectors, steps[-1].belief.vectors)
    assert "as it was: no particle explains" in capsys.readouterr().err
    assert (tmp_path / "summary.json").is_file()


def test_a_state_gives_back_the_belief_that_left_it(
    episode: Episode, estimator: Estimator, steps: list[EstimationStep]
) -> None:
    held = estimator.held(episode, steps[1].state)
    assert held is not None
    for name in ("vectors", "weights", "misfit_sd", "misfit_mean", "misfit_covariance"):
        assert torch.equal(getattr(held, name), getattr(steps[1].belief, name))
    assert Estimator(estimator.shape, "paper").held(episode, steps[1].state) is None


def test_torch_takes_one_thread_meanwhile_and_as_many_as_before_afterwards(
    episode: Episode, estimator: Estimator, steps: list[EstimationStep]
) -> None:
    """So the answer does not depend on how many it may take."""
    alone = refine(episode, estimator.shape, steps[-1].state, SETTINGS)
    before = torch.get_num_threads()
    seen: list[int] = []

    def fails() -> None:
        seen.append(torch.get_num_threads())
        raise ValueError

    torch.set_num_threads(3)
    try:
        with pytest.raises(ValueError):
            torch_in_one_thread(fails)()
        beside = refine(episode, estimator.shape, steps[-1].state, SETTINGS)
        assert seen == [1] and torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert torch.equal(alone.belief.vectors, beside.belief.vectors)
