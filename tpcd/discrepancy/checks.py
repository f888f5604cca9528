"""What a diagnosis is given: episodes of one set-up whose noise is known and not plainly wrong.

Noise that no YAML states is estimated from repeated commands, of the episodes that are diagnosed
alone; a recording without set points gets its answer here, since there is nothing to fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from tpcd.data.checks import (
    INVERTED,
    check_scale,
    episode_findings,
    inverted_told,
    wrench_ratios,
)
from tpcd.data.doubts import doubts_told
from tpcd.data.episode import Episode
from tpcd.data.files import locate
from tpcd.data.header import Header, read_header
from tpcd.data.measured import read_measured
from tpcd.data.noise import check_noise
from tpcd.data.noisy import read_noisy
from tpcd.data.same_rows import row_marks, rows_among
from tpcd.discrepancy.diagnosis import Diagnosis
from tpcd.errors import EpisodeError

NOISE_FACTOR = 2.0
"""Measured noise of one set-up may differ by less than this."""
ONE_SET_UP = "episodes of one run must come from one set-up, so diagnose them apart"


@dataclass(frozen=True, eq=False)
class Data:
    """Episodes that are ready for a diagnosis, or its answer where there can be none."""

    episodes: tuple[Episode, ...]
    fresh: tuple[Episode, ...]
    notes: tuple[str, ...] = ()
    """What the episodes were accepted in spite of, what was done about the noise, and doubts about
    it; part of the verdict."""
    warnings: tuple[str, ...] = ()
    """What else looks odd about the episodes."""
    answer: Diagnosis | None = None
    """The verdict where nothing can be fitted."""


def read_data(paths: Sequence[Path], fresh: Sequence[Path] = ()) -> Data:
    """Read and check the episodes of a diagnosis.

    Raises `EpisodeError` for files that cannot be read, for episodes of different set-ups, for a
    force of the opposite sign, which no effect makes but many can be fitted to, and for noise
    that is plainly wrong, or neither stated nor shown by the data.
    """
    places = [locate(Path(path)) for path in (*paths, *fresh)]
    headers = [read_header(header) for _, header in places]
    check_one_set_up([header for _, header in places], headers)
    for (table, _), header in zip(places, headers, strict=True):
        if not header.commands_known:
            doubts = [line for line in [doubts_told(header.doubts, table)] if line]
            return Data((), (), tuple(doubts), answer=_without_commands(table, header))
    episodes, notes = read_noisy(paths, fresh)
    for k, ((table, _), episode) in enumerate(zip(places, episodes, strict=True)):
        _check_signs(table, episode)
        _check_new(table, episode, episodes[:k])
    doubts = [doubts_told(episode.doubts, episode.path) for episode in episodes]
    told = [line for line in doubts if line]
    told += [line for episode in episodes for line in check_noise(episode)]
    warnings = [str(each) for episode in episodes for each in episode_findings(episode)]
    count = len(paths)
    given, noted = one_noise(episodes[:count])
    return Data(given, tuple(episodes[count:]), (*notes, *noted, *told), tuple(warnings))


def _check_signs(path: Path, episode: Episode) -> None:
    check_scale(episode)
    # The torque may turn with the point that it is about.
    for name, ratios in wrench_ratios(episode).items():
        if name != "tau" and all(ratio < INVERTED for ratio in ratios):
            raise EpisodeError(path, *inverted_told(episode, name, ratios[0]))


def _check_new(path: Path, episode: Episode, before: Sequence[Episode]) -> None:
    for other in before:
        again = rows_among(episode, set(row_marks(other)))
        if again:
            raise EpisodeError(
                path,
                f"{len(again)} of {len(episode) - 1} rows (row {again[0]} first) are also in"
                f" {other.path}",
                "give each recording once, and as --fresh what was not learnt from",
            )


def check_one_set_up(paths: Sequence[Path], headers: Sequence[Header]) -> None:
    """Refuse episodes whose YAMLs differ in what makes a set-up; raises `EpisodeError`.

    Where one of them says nothing of noise, object or time step, it takes the others'. Noise that
    was measured differs from one recording to the next, and may by a factor of `NOISE_FACTOR`.
    """
    for name in ("stiffness", "sensor_std", "object", "time_step_s", "priors"):
        first: tuple[Path, object] | None = None
        for path, header in zip(paths, headers, strict=True):
            value = getattr(header, name)
            if value is None:
                continue
            if first is None:
                first = path, value
            elif not _same(name, value, first[1]):
                raise EpisodeError(
                    path,
                    f"{name} is {_shown(value)}, but {_shown(first[1])} in {first[0]}",
                    ONE_SET_UP,
                )


def _same(name: str, value: object, other: object) -> bool:
    if name != "sensor_std" or not (isinstance(value, tuple) and isinstance(other, tuple)):
        return value == other
    pairs = zip(value, other, strict=True)
    return all(a == b or max(a, b) < NOISE_FACTOR * min(a, b) for a, b in pairs)


def one_noise(episodes: Sequence[Episode]) -> tuple[tuple[Episode, ...], tuple[str, ...]]:
    """The episodes with one standard deviation for each channel, the root mean square of theirs,
    and a note where they differ."""
    stated = torch.stack([episode.sensor_std for episode in episodes])
    if bool((stated == stated[0]).all()):
        return tuple(episodes), ()
    common = stated.square().mean(0).sqrt()
    text = ", ".join(f"{value:.3g}" for value in common.tolist())
    note = f"the episodes state different sensor_std; taken as [{text}], their root mean square"
    return tuple(replace(episode, sensor_std=common) for episode in episodes), (note,)


def _without_commands(table: Path, header: Header) -> Diagnosis:
    noise = "" if header.sensor_std else "; nor is the noise of the sensors known"
    return Diagnosis(
        "not_enough_information",
        f"the set points of the controller were not recorded in {table.name}, so it is unknown"
        " what the springs K (x - u) push with and which motion was asked for;"
        f" {read_measured(table).summary()}{noise}; a diagnosis needs commands, a free start,"
        " and contacts that are made, pressed at several loads, slid and broken",
    )


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(f'{entry:g}' for entry in value)}]"
    return f"{value!r}" if value or isinstance(value, str) else "nothing"
