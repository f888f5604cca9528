"""Rows and columns in the wrong place are told by w = K (x - u), and what departs from it too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tpcd.data import Episode, check_episode
from tpcd.data.checks import check_units, episode_findings
from tpcd.data.files import read_episode, write_episode
from tpcd.errors import EpisodeError
from tpcd.quality.finding import Weight
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene


@pytest.fixture(scope="module")
def episode() -> Episode:
    generator = torch.Generator().manual_seed(3)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    motion = make_motion("rich", scene, 15, generator)
    return record(make_truth(scene, "quasistatic"), scene, motion, 15, generator).measured


def late(values: torch.Tensor) -> torch.Tensor:
    return torch.cat((values[:1], values[:-1]))


def swapped(values: torch.Tensor) -> torch.Tensor:
    return values[:, [1, 0, 2]]


ORDERS = {
    "commands of the row before": lambda e: {"commands": late(e.commands)},
    "poses of the row before": lambda e: {"poses": late(e.poses)},
    "wrenches of the row before": lambda e: {"wrenches": late(e.wrenches)},
    "F_x and F_z seem to be swapped": lambda e: {"wrenches": swapped(e.wrenches)},
    "relative to the pose of the row before": lambda e: {
        "commands": torch.cat((e.commands[:1], e.commands[1:] - e.poses[:-1]))
    },
}


@pytest.mark.parametrize("told", ORDERS)
def test_an_order_in_which_the_law_holds_is_named(told: str, episode: Episode) -> None:
    wrong = replace(episode, **ORDERS[told](episode))
    with pytest.raises(EpisodeError, match=told):
        check_units(wrong)
    (found,) = (each for each in episode_findings(wrong) if each.kind == "wrench")
    assert found.weight is Weight.SERIOUS and told in found.sentence


@pytest.mark.parametrize("name", ["commands", "poses", "wrenches"])
def test_the_row_after_is_named_too(name: str, episode: Episode) -> None:
    ahead = torch.cat((getattr(episode, name)[:1], getattr(episode, name)[2:]))
    short = episode.first(len(episode) - 1)
    with pytest.raises(EpisodeError, match=f"{name} of the row after .* one row down"):
        check_units(replace(short, **{name: ahead}))


@pytest.mark.parametrize(("name", "told"), [("commands", "u_x and u_z"), ("poses", "x and z")])
def test_a_start_that_is_off_since_columns_are_swapped_says_so(
    name: str, told: str, episode: Episode, tmp_path: Path
) -> None:
    path = write_episode(episode, tmp_path / "a")
    names = {"commands": ("u_x", "u_z"), "poses": ("x", "z")}[name]
    header, *rows = path.read_text().splitlines()
    columns = header.split(",")
    first, second = map(columns.index, names)
    columns[first], columns[second] = columns[second], columns[first]
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")
    with pytest.raises(EpisodeError, match=f"{told} seem to be swapped.*; swap these columns"):
        read_episode(path)


def test_commands_and_poses_that_are_swapped_are_no_inverted_force(episode: Episode) -> None:
    with pytest.raises(EpisodeError, match="u_x and x look swapped, or F_x inverted"):
        check_units(replace(episode, commands=episode.poses, poses=episode.commands))
    with pytest.raises(EpisodeError, match="F_x looks inverted: .* change the sign"):
        check_units(replace(episode, wrenches=-episode.wrenches))


def test_rows_in_disorder_are_no_angles_in_degrees(episode: Episode) -> None:
    """The torque is then 0.013 times K (phi - u_phi), but not by the law."""
    order = torch.cat((torch.zeros(1, dtype=torch.long), torch.arange(1, 16).flip(0)))
    check_units(replace(episode, wrenches=episode.wrenches[order]))


def test_good_rows_and_those_that_effects_make_keep_their_order(episode: Episode) -> None:
    assert check_episode(episode) == []
    for wrenches in (
        1.4 * episode.wrenches,
        0.6 * episode.wrenches,
        episode.wrenches + torch.tensor([3.0, -4.0, 0.3]),
    ):
        found = episode_findings(replace(episode, wrenches=wrenches))
        assert not any("row" in str(each) for each in found)


def test_a_stiffness_of_another_arm_is_told_unless_effects_may_explain_it(episode: Episode) -> None:
    stiff = replace(episode, stiffness=1.5 * episode.stiffness)
    (told,) = check_episode(stiff)
    assert "differs from K (pose - command) by" in told and "times the noise" in told
    assert check_episode(stiff, effects=True) == []


@pytest.mark.parametrize(("channel", "factor"), [(2, 57.3), (3, 1e3), (5, 100.0)])
def test_noise_in_another_unit_is_told(channel: int, factor: float, episode: Episode) -> None:
    std = episode.sensor_std.clone()
    std[channel] *= factor
    told = check_episode(replace(episode, sensor_std=std))
    assert any("plainly too large" in line for line in told)
