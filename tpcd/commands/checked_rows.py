"""An episode, checked row by row: what its readings repeat, what its rows say of units, signs and
noise, and what they tell of arm and sensor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tpcd.commands.checked import Checked
from tpcd.data.checks import episode_findings
from tpcd.data.episode import COLUMNS, Episode
from tpcd.data.files import read_episode
from tpcd.data.noise import noise_findings
from tpcd.identification.identify import identify
from tpcd.logs.columns import log_from_columns
from tpcd.quality.stream import Stream


def check_rows_of(path: Path) -> Checked:
    """Read and check an episode; raises `EpisodeError` for one that breaks the format."""
    episode = read_episode(path)
    findings = [*episode.doubts, *episode_findings(episode), *noise_findings(episode)]
    stream = _rows_stream(episode)
    table = dict(zip(stream.channels, stream.values.T, strict=True)) | {"time": stream.times}
    log = log_from_columns(
        table,
        ["time=time", *(f"{name}={name}" for name in stream.channels)],
        episode.path or path,
    )
    quantities = identify(replace(log, findings=()), tuple(episode.stiffness.tolist()))
    found = tuple(findings)
    return Checked(episode.path or path, "episode", (stream,), found, quantities=quantities)


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
