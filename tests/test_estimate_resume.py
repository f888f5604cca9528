"""An estimation that was stopped goes on to the very answer of one that was not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from short_episode import short_episode

from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
from tpcd.belief.belief import EstimationStep
from tpcd.belief.paper import PaperSettings, estimate_paper
from tpcd.belief.state import EstimatorState, load_state, save_state
from tpcd.belief.storage import load_belief
from tpcd.commands.estimation import run_estimation
from tpcd.data.episode import Episode
from tpcd.errors import RunError
from tpcd.shape.checkpoint import load_prior

PRIOR = "ycb21-z2"
STEPS = 4


@pytest.fixture(scope="module")
def episode() -> Episode:
    return short_episode(STEPS)


def steps(
    kind: str, episode: Episode, state: EstimatorState | None = None
) -> Iterator[EstimationStep]:
    generator = torch.Generator().manual_seed(0)
    shape = load_prior(PRIOR)
    if kind == "paper":
        return estimate_paper(episode, shape, generator, PaperSettings(particles=200), state)
    settings = EstimatorSettings(sampler=SamplerSettings(particles=64))
    return estimate(episode, shape, generator, settings, state)


def stopped_after(count: int, whole: Iterator[EstimationStep]) -> Iterator[EstimationStep]:
    for step in whole:
        if step.index > count:
            raise KeyboardInterrupt
        yield step


@pytest.mark.parametrize("kind", ["default", "paper"])
def test_a_stopped_estimation_goes_on_to_the_same_belief(
    kind: str, episode: Episode, tmp_path: Path
) -> None:
    whole = run_estimation(
        steps(kind, episode), episode, PRIOR, tmp_path / "whole", show_progress=False
    )
    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run_estimation(
            stopped_after(2, steps(kind, episode)), episode, PRIOR, folder, show_progress=False
        )
    # A line of a step whose state was not written any more.
    with (folder / "steps.jsonl").open("a") as file:
        file.write('{"step": 3, "cut')
    state = load_state(folder, episode, PRIOR)
    assert state is not None and state.index == 2
    again = run_estimation(
        steps(kind, episode, state), episode, PRIOR, folder, show_progress=False, state=state
    )
    torch.testing.assert_close(again.vectors, whole.vectors, rtol=0, atol=0)
    torch.testing.assert_close(again.weights, whole.weights, rtol=0, atol=0)
    torch.testing.assert_close(load_belief(folder).vectors, whole.vectors, rtol=0, atol=0)
    rows = [json.loads(line) for line in (folder / "steps.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3, 4]
    assert "NaN" not in (folder / "steps.jsonl").read_text()
    for row in rows:
        assert row["distinct"] > 1 and (row["log_evidence_std"] is None) == (kind == "paper")


def test_a_state_of_other_data_or_version_or_cut_off_is_refused(
    episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load_state(tmp_path, episode, PRIOR) is None
    save_state(next(steps("default", episode)).state, tmp_path, episode, PRIOR)
    with monkeypatch.context() as patch:
        patch.setattr("tpcd.belief.state.STATE_VERSION", "later")
        with pytest.raises(RunError, match="another version"):
            load_state(tmp_path, episode, PRIOR)
    with pytest.raises(RunError, match="other weights of the prior ycb-rich"):
        load_state(tmp_path, episode, "ycb-rich")
    other = replace(episode, poses=episode.poses + 1e-4)
    with pytest.raises(RunError, match="other numbers"):
        load_state(tmp_path, other, PRIOR)
    path = tmp_path / "state.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(RunError, match="cannot be read"):
        load_state(tmp_path, episode, PRIOR)
