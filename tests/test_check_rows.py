"""Rows of an episode whose readings a sensor repeated are told by every command that reads it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_logs import an_episode

from tpcd.data.checks import check_episode, repeated_readings
from tpcd.data.episode import Episode
from tpcd.quality.episode_rows import check_repeats
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

STATED = torch.tensor([2e-4, 2e-4, 2e-3, 0.3, 0.3, 0.02], dtype=torch.float64)


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    """Simulated episodes with and without noise, of all motions."""
    made = []
    for seed, name in enumerate(("soup_can", "mug", "wine_bottle")):
        for motion in ("diagnosis", "rich", "press_and_slide", "test"):
            generator = torch.Generator().manual_seed(seed)
            scene = draw_scene(name, builtin_outlines()[name].vertices, generator)
            truth = make_truth(scene, "quasistatic")
            planned = make_motion(motion, scene, 30, generator)
            recorded = record(truth, scene, planned, 30, generator)
            made += [recorded.true, recorded.measured]
    return made


def pressed(episode: Episode, rows: slice, axis: int) -> float:
    """By how much K (pose - command) changes in some rows."""
    away = (episode.poses - episode.commands)[rows, axis] * episode.stiffness[axis]
    return float(away.max() - away.min())


def test_rows_that_were_measured_raise_no_alarm(episodes: list[Episode]) -> None:
    # Printed digits repeat readings, and so do pauses and free space without noise.
    for episode in episodes:
        for stated in (episode.sensor_std, STATED):
            for digits in (2, 1, 9):
                rounded = episode.wrenches.round(decimals=digits)
                kept = replace(episode, wrenches=rounded, sensor_std=stated)
                assert repeated_readings(kept) == ()


def test_free_space_read_without_noise_is_not_frozen() -> None:
    # An arm that lags, or has friction, is away from its command where nothing touches it.
    random = np.random.default_rng(0)
    commands = np.cumsum(0.03 * random.standard_normal((40, 3)), axis=0)
    poses = commands + 0.04 * random.standard_normal((40, 3))
    stiffness, std = np.array([100.0, 100.0, 50.0]), np.zeros(6)
    touching = np.isin(np.arange(40) // 5, (1, 4, 6))[:, None]
    for bias in (np.zeros(3), np.array([1.0, -1.0, 0.05])):
        wrenches = np.where(touching, stiffness * (poses - commands), 0.0) + bias
        assert check_repeats(commands, poses, wrenches, stiffness, std) == ()
        dead = np.tile(bias, (40, 1))
        (told,) = check_repeats(commands, poses, dead, stiffness, std)
        assert told.rows == (0, 40) and len(told.channels) == 3


@pytest.mark.parametrize("length", [3, 8])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_frozen_channel_is_named_with_its_rows(
    episodes: list[Episode], length: int, axis: int
) -> None:
    tried = 0
    for k, episode in enumerate(episodes):
        first = 3 + 2 * k % (len(episode) - length - 3)
        rows = slice(first, first + length)
        noise = np.hypot(STATED[3 + axis], episode.stiffness[axis] * STATED[axis])
        again = int((episode.wrenches[:, axis] == episode.wrenches[first, axis]).sum())
        if pressed(episode, rows, axis) < 8.0 * float(noise) or again > 1:
            continue  # without noise, what is read in free space is read again and again
        wrenches = episode.wrenches.clone()
        wrenches[rows, axis] = wrenches[first, axis]
        told = repeated_readings(replace(episode, wrenches=wrenches, sensor_std=STATED))
        own = [
            f for f in told if f.kind == "frozen" and f.channels == (("F_x", "F_z", "tau")[axis],)
        ]
        assert len(own) == 1 and own[0].rows is not None
        assert own[0].rows[0] <= first and own[0].rows[1] >= first + length
        tried += 1
    assert tried >= 2


def test_a_frozen_wrench_or_pose_is_named(episodes: list[Episode]) -> None:
    episode = episodes[1]
    away = (episode.poses - episode.commands) * episode.stiffness
    first = int((away[1:] - away[:-1])[3:, :2].abs().amax(1).argmax()) + 3
    for name in ("wrenches", "poses"):
        values = getattr(episode, name).clone()
        values[first : first + 4] = values[first]
        told = repeated_readings(replace(episode, **{name: values}))
        assert any(f.rows == (first, first + 4) and len(f.channels) == 3 for f in told), name


@pytest.mark.parametrize("part", [0.6, 0.75])
def test_a_channel_at_the_end_of_its_range_is_named(episodes: list[Episode], part: float) -> None:
    tried = 0
    for episode in episodes[1::2]:
        wrenches = episode.wrenches.clone()
        limit = float(wrenches[:, 1].abs().quantile(part))
        wrenches[:, 1] = wrenches[:, 1].clamp(-limit, limit)
        cut = [s * episode.wrenches[:, 1] > limit for s in (1.0, -1.0)]
        lost = [float((episode.wrenches[c, 1].abs() - limit).sum()) for c in cut]
        if max(lost) < 6.0 or any(0 < int(c.sum()) < 3 for c in cut):
            continue  # what is cut off by hardly more than the noise is not told
        told = repeated_readings(replace(episode, wrenches=wrenches))
        assert any(f.kind == "clipped" and f.channels == ("F_z",) for f in told)
        tried += 1
    assert tried >= 3


def test_what_reads_an_episode_repeats_it() -> None:
    episode = replace(an_episode(12), sensor_std=STATED)
    assert not any("frozen" in line for line in check_episode(episode))
    wrenches = episode.wrenches.clone()
    wrenches[4:10] = wrenches[4]
    told = [line for line in check_episode(replace(episode, wrenches=wrenches)) if "frozen" in line]
    assert len(told) == 1 and told[0].startswith("rows 4 to 9: F_x, F_z, tau exactly")
