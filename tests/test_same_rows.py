"""Rows that are one measurement are told: copied, given twice, or learnt from and tested on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tpcd.commands.plausibility import keep_rows, run_warnings
from tpcd.data import Episode, check_episode
from tpcd.data.files import write_episode
from tpcd.data.same_rows import copied_rows, row_marks, rows_among
from tpcd.discrepancy.checks import read_data
from tpcd.errors import EpisodeError
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.recording import Recording, make_motion, record
from tpcd.truth.scene import draw_scene


def made(seed: int) -> Recording:
    generator = torch.Generator().manual_seed(seed)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, torch.Generator().manual_seed(1))
    motion = make_motion("diagnosis", scene, 20, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 20, generator)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return made(1).measured


@pytest.fixture(scope="module")
def other() -> Episode:
    return made(2).measured


def rows(episode: Episode, *places: int) -> Episode:
    index = torch.tensor(places)
    names = ("commands", "poses", "wrenches")
    return replace(episode, **{name: getattr(episode, name)[index] for name in names})


def test_a_copied_row_is_told(episode: Episode) -> None:
    assert check_episode(episode) == []
    told = check_episode(rows(episode, *range(8), 7, *range(8, 21)))
    assert [line for line in told if line.startswith("row 8 is row 7 again, to the last digit")]


@pytest.mark.parametrize("digits", [1e-4, 5e-4, 1e-3])
def test_few_digits_and_no_noise_make_rows_alike(episode: Episode, digits: float) -> None:
    """A diagnosis motion holds commands, so coarse readings repeat."""
    poses = (episode.poses / digits).round() * digits
    wrenches = (episode.wrenches / (100 * digits)).round() * 100 * digits
    assert copied_rows(replace(episode, poses=poses, wrenches=wrenches)) == ()
    for std in (episode.sensor_std, torch.zeros(6)):
        assert copied_rows(replace(made(1).true, sensor_std=std)) == ()


def test_rows_of_another_recording_are_found(episode: Episode, other: Episode) -> None:
    marks = set(row_marks(episode))
    assert rows_among(other, marks) == []
    assert rows_among(rows(episode, *range(13)), marks) == list(range(1, 13))
    assert rows_among(replace(made(1).true), set(row_marks(made(1).true))) == list(range(1, 21))


def test_a_recording_given_twice_or_as_its_own_test_is_refused(
    episode: Episode, other: Episode, tmp_path: Path
) -> None:
    first, copy, new = (
        write_episode(each, tmp_path / name)
        for each, name in ((episode, "a"), (rows(episode, *range(15)), "b"), (other, "c"))
    )
    for given in (([first, copy], []), ([first, new], [copy])):
        with pytest.raises(EpisodeError, match=f"14 of 14 rows .* are also in {first}; give each"):
            read_data(*given)
    assert len(read_data([first], [new]).fresh) == 1


def test_predicting_what_was_learnt_from_is_told(
    episode: Episode, other: Episode, tmp_path: Path
) -> None:
    keep_rows([episode], tmp_path)
    (told,) = run_warnings(tmp_path, [rows(episode, *range(13))])
    assert told.startswith(f"12 of 12 rows are what {tmp_path} was learnt from")
    assert run_warnings(tmp_path, [other]) == []
    (told,) = run_warnings(tmp_path, [other, other])
    assert told == "20 of 20 rows are given more than once, and count as often"
