"""An episode, checked row by row: what its readings repeat, what its rows say of units, signs and
noise, and what they tell of arm and sensor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tpcd.commands.checked import Checked
from tpcd.data.checks import FREE_OF_NOISE, check_episode, repeated_readings
from tpcd.data.episode import COLUMNS, Episode
from tpcd.data.files import read_episode
from tpcd.data.noise import check_noise
from tpcd.errors import EpisodeError
from tpcd.logs.columns import log_from_columns
from tpcd.quality.finding import Finding, Weight
from tpcd.quality.identify import identify
from tpcd.quality.stream import Stream


def check_rows_of(path: Path) -> Checked:
    """Read and check an episode; raises `EpisodeError` for one that breaks the format."""
    episode = read_episode(path)
    repeats = repeated_readings(episode)
    told = {str(each) for each in repeats}
    doubts = [sentence for sentence in check_episode(episode) if sentence not in told]
    try:
        doubts += check_noise(episode)
    except EpisodeError as error:
        doubts.append(error.problem)
    findings = (*repeats, *(Finding("row", _weight(each), each) for each in doubts))
    stream = _rows_stream(episode)
    table = dict(zip(stream.channels, stream.values.T, strict=True)) | {"time": stream.times}
    log = log_from_columns(
        table,
        ["time=time", *(f"{name}={name}" for name in stream.channels)],
        episode.path or path,
    )
    quantities = identify(replace(log, findings=()), tuple(episode.stiffness.tolist()))
    return Checked(episode.path or path, "episode", (stream,), findings, quantities=quantities)


def _weight(sentence: str) -> Weight:
    """What is said of an episode without noise, as a simulated one is, is no doubt."""
    return Weight.NOTE if sentence.endswith(FREE_OF_NOISE) else Weight.DOUBT


def _rows_stream(episode: Episode) -> Stream:
    """The rows as samples, at their times where these are known, else a second apart."""
    values = np.column_stack(
        (episode.commands.numpy(), episode.poses.numpy(), episode.wrenches.numpy())
    )
    times = np.arange(len(episode), dtype=np.float64)
    recorded = episode.extra.get("time_s")
    if recorded is not None and recorded.dtype.kind == "f" and (np.diff(recorded) > 0).all():
        times = recorded - recorded[0]
    name = episode.path.name if episode.path else "episode"
    return Stream(name, COLUMNS[1:], times, values)
