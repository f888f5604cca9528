"""Noise of the sensors from the data alone: what it is, and when what is stated cannot be."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from tpcd.data.episode import Episode
from tpcd.data.files import write_episode
from tpcd.data.noise import check_noise, estimate_noise, resolution
from tpcd.data.noisy import read_noisy
from tpcd.effects import CATALOGUE
from tpcd.errors import EpisodeError
from tpcd.random import stream
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.recording import DEFAULT_SENSOR_STD, make_motion, record
from tpcd.truth.scene import draw_scene

STD = np.array(DEFAULT_SENSOR_STD)
SEEDS = range(4)
LEVEL = 1e-4
"""False-alarm rate of each comparison with a distribution."""
SIZES: dict[str, dict[str, float]] = {
    "command_lag": {"share": 0.1},
    "stiffness_error": {"log_ratio_x": 0.1, "log_ratio_z": -0.08},
    "arm_friction": {"force": 0.3},
    "payload": {"weight": 1.0, "lever": 0.03},
    "force_bias": {"F_x": 0.6, "F_z": -0.9, "tau": 0.03},
    "force_drift": {"F_x": 1.0, "F_z": -1.2},
    "force_gain": {"gain": 0.08},
    "sensor_rotation": {"angle": 0.08},
    "wrench_reference_point": {"x": 0.02, "z": -0.01},
    "grasp_slip": {"angle": 0.03, "at": 0.5},
    "floor_compliance": {"compliance": 2.5e-4},
}
"""Medium sizes of what arm, sensors, grasp and floor may do."""


@cache
def episode_of(seed: int, steps: int = 60, effect: str = "") -> Episode:
    names = sorted(builtin_outlines())
    name = names[seed % len(names)]
    scene = draw_scene(name, builtin_outlines()[name].vertices, stream(seed, 0))
    hidden = {effect: SIZES[effect]} if effect else {}
    truth = make_truth(scene, "quasistatic", hidden, steps)
    motion = make_motion("diagnosis", scene, steps, stream(seed, 1))
    return record(truth, scene, motion, steps, stream(seed, 2)).measured


def stated(episode: Episode, factor: float, channels: slice) -> Episode:
    std = episode.sensor_std.clone()
    std[channels] *= factor
    return replace(episode, sensor_std=std)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_noise_of_sixty_steps_is_found(seed: int) -> None:
    found = estimate_noise([episode_of(seed)])
    assert found is not None
    freedom = np.array(found.freedom)
    assert freedom.min() >= 12
    # Rows are chosen by what they read, so a fifth more or less is no surprise.
    low, high = (np.sqrt(chi2.ppf(p, freedom) / freedom) for p in (LEVEL / 2, 1 - LEVEL / 2))
    ratio = np.array(found.std) / STD / (1 + 1 / np.sqrt(2 * freedom))
    assert (ratio > 0.8 * low).all() and (ratio < 1.25 * high).all(), ratio


def test_episodes_together_say_more() -> None:
    together = estimate_noise([episode_of(seed) for seed in SEEDS])
    alone = estimate_noise([episode_of(0)])
    assert together is not None and alone is not None
    assert min(together.freedom) > 3 * min(alone.freedom)
    error = 1 / np.sqrt(2 * min(together.freedom))
    assert np.allclose(np.array(together.std) / STD / (1 + error), 1.0, atol=2 * error)
    assert f"good to about {error:.0%}" in together.sentence()


def test_what_is_stated_does_not_matter_to_the_estimate() -> None:
    episode = episode_of(1)
    assert estimate_noise([episode]) == estimate_noise([stated(episode, 50.0, slice(0, 6))])


def test_without_repeated_commands_there_is_no_estimate() -> None:
    assert estimate_noise([episode_of(0, steps=15)]) is None


def test_readings_without_any_scatter_have_the_noise_of_rounding() -> None:
    episode = episode_of(0)
    poses = (episode.poses / 0.002).round() * 0.002
    found = estimate_noise([replace(episode, poses=poses)])
    assert found is not None and found.std[0] >= 0.002 / np.sqrt(12.0) - 1e-12
    assert resolution(np.ones(5)) == 0.0


@pytest.mark.parametrize("seed", SEEDS)
def test_right_noise_is_not_doubted(seed: int) -> None:
    for steps in (15, 30, 60):
        assert check_noise(episode_of(seed, steps)) == []
    assert check_noise(stated(episode_of(seed), 1.5, slice(0, 6))) == []
    # Too small by as much may be doubted, but is not refused.
    told = check_noise(stated(episode_of(seed), 1 / 1.5, slice(0, 6)))
    assert all("too small, or the arm creeps or lags" in line for line in told)


@pytest.mark.parametrize("seed", SEEDS)
def test_noise_that_is_too_small_is_said(seed: int) -> None:
    """2.5 times too small is said, and of no channel but those at fault."""
    for channels, names in ((slice(0, 3), {"x", "z", "phi"}), (slice(3, 6), {"F_x", "F_z", "tau"})):
        told = check_noise(stated(episode_of(seed), 0.4, channels))
        assert told and all("too small, or the arm creeps or lags" in line for line in told)
        assert {line.split()[2] for line in told} <= names


@pytest.mark.parametrize("seed", SEEDS)
def test_rounded_readings_are_not_doubted(seed: int) -> None:
    def rounded(values: torch.Tensor, steps: list[float]) -> torch.Tensor:
        grid = torch.tensor(steps, dtype=torch.float64)
        return (values / grid).round() * grid

    # Steps as large as the noise, commands on the same grid.
    episode, steps = episode_of(seed), [2e-4, 2e-4, 5e-4]
    coarse = replace(
        episode,
        commands=rounded(episode.commands, steps),
        poses=rounded(episode.poses, steps),
        wrenches=rounded(episode.wrenches, [0.3, 0.3, 0.02]),
    )
    assert check_noise(coarse) == []


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("channels", [slice(0, 3), slice(3, 6)], ids=["pose", "wrench"])
def test_ten_times_too_large_is_refused(seed: int, channels: slice) -> None:
    with pytest.raises(EpisodeError, match="plainly too large") as caught:
        check_noise(stated(episode_of(seed), 10.0, channels))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", SEEDS)
def test_ten_times_too_small_is_refused_or_said(seed: int) -> None:
    with pytest.raises(EpisodeError, match="w - K .* plainly too small"):
        check_noise(stated(episode_of(seed), 0.1, slice(3, 6)))
    told = check_noise(stated(episode_of(seed), 0.1, slice(0, 3)))
    assert told and all("too small, or the arm creeps or lags" in line for line in told)


@pytest.mark.parametrize("effect", SIZES)
def test_no_effect_is_taken_for_wrong_noise(effect: str) -> None:
    assert effect in {known.name for known in CATALOGUE}
    for seed in (0, 1):
        told = check_noise(episode_of(seed, effect=effect))
        if effect == "command_lag":  # it shows in pauses, as noise does
            assert all("too small, or the arm creeps or lags" in line for line in told)
        else:
            assert told == []


def silent(path: Path) -> Path:
    """The episode without what its YAML says of noise."""
    header = path.with_suffix(".yaml")
    lines = header.read_text().splitlines()
    header.write_text("\n".join(line for line in lines if not line.startswith("sensor_std")))
    return path


def test_missing_noise_is_taken_from_the_data_or_from_the_others(tmp_path: Path) -> None:
    first, second = (write_episode(episode_of(seed), tmp_path / f"e{seed}.csv") for seed in (0, 1))
    for path in (first, second):
        silent(path)
    episodes, (note,) = read_noisy([first, second])
    assert torch.equal(episodes[0].sensor_std, episodes[1].sensor_std)
    assert np.allclose(episodes[0].sensor_std.numpy() / STD, 1.0, atol=0.4)
    assert note.startswith(f"{tmp_path}/e0.yaml, {tmp_path}/e1.yaml: sensor_std estimated as [")
    known = write_episode(episode_of(2), tmp_path / "e2.csv")
    episodes, (note,) = read_noisy([first, known])
    assert torch.equal(episodes[0].sensor_std, episode_of(2).sensor_std)
    assert "sensor_std taken from" in note


def test_fresh_episodes_take_the_noise_and_give_none(tmp_path: Path) -> None:
    given, fresh = (silent(write_episode(episode_of(k), tmp_path / f"{k}.csv")) for k in (0, 1))
    (alone,), _ = read_noisy([given])
    (told, other), (note,) = read_noisy([given], [fresh])
    assert torch.equal(told.sensor_std, alone.sensor_std)
    assert torch.equal(other.sensor_std, alone.sensor_std)
    assert note.startswith(f"{tmp_path}/0.yaml, {tmp_path}/1.yaml: sensor_std estimated as [")
    # What a fresh one says of its own noise is of no other.
    known = write_episode(stated(episode_of(2), 1.5, slice(0, 6)), tmp_path / "2.csv")
    (told, other), _ = read_noisy([given], [known])
    assert torch.equal(told.sensor_std, alone.sensor_std)
    assert torch.equal(other.sensor_std, 1.5 * episode_of(2).sensor_std)
    (told, other), (note,) = read_noisy([known], [given])
    assert torch.equal(told.sensor_std, other.sensor_std)
    assert note == f"{tmp_path}/0.yaml: sensor_std taken from {tmp_path}/2.yaml"
    short = silent(write_episode(episode_of(0, steps=15), tmp_path / "short.csv"))
    with pytest.raises(EpisodeError, match=r"short\.yaml: key sensor_std is missing"):
        read_noisy([short], [known])


def test_missing_noise_that_nothing_shows_names_the_motion_that_would(tmp_path: Path) -> None:
    short = silent(write_episode(episode_of(0, steps=15), tmp_path / "short.csv"))
    with pytest.raises(EpisodeError, match="repeat commands in free space and in contact"):
        read_noisy([short])
    lagging = silent(write_episode(episode_of(0, effect="command_lag"), tmp_path / "lag.csv"))
    with pytest.raises(EpisodeError, match="creeps or lags in pauses"):
        read_noisy([lagging])


def test_readings_in_steps_that_the_stated_noise_does_not_know_of_are_said() -> None:
    """Whole millimetres under 0.2 mm of noise; in tenths of them nothing is said."""
    episode = episode_of(SEEDS[0])
    for digits, told in ((3, ["x is in steps of 0.001", "z is in steps of 0.001"]), (4, [])):
        poses = episode.poses.clone()
        poses[:, :2] = (poses[:, :2] * 10**digits).round() / 10**digits
        found = check_noise(replace(episode, poses=poses))
        assert [line.partition(",")[0] for line in found if "in steps" in line] == told
