"""Any recording, read as far as it can be and checked: streams, findings, noise, arm and sensor.

A recording that cannot be imported is checked all the same: without a pose the wrench alone, and
what is missing is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tpcd.commands.checked import Checked
from tpcd.identification.identify import identify
from tpcd.identification.quantity import Quantity
from tpcd.logs.bags import is_bag, read_bag
from tpcd.logs.columns import log_from_columns, parse_map, read_numbers
from tpcd.logs.log import Log, LogError
from tpcd.logs.table import Table, read_columns
from tpcd.quality.finding import Finding
from tpcd.quality.noise import check_noise_at_rest, noise_at_rest
from tpcd.quality.recording import check_recording
from tpcd.quality.stream import Stream
from tpcd.quality.suggest import suggest_map

LEAST_USABLE = 0.5
"""A recording of which less than this part of the time is left is not usable."""
ZERO = "nothing recorded"
"""Name of a column of zeros that stands in for positions which were not recorded."""


def check_file(
    path: Path,
    entries: Sequence[str] = (),
    topics: Sequence[str] = (),
    euler: str = "ZYX",
    rate: float | None = None,
    stiffness: Sequence[float] | None = None,
) -> Checked:
    """Read and check a recording or an episode; raises `LogError` or `EpisodeError` for one that
    cannot be read at all, `ValueError` for options that do not fit it."""
    if is_bag(path) and not _is_episode(path):
        if entries or rate is not None:
            raise ValueError("map and rate are for tables; name a bag's topics with --topics")
        log = read_bag(path, topics)
        return _checked(log, log.streams, log.findings, stiffness, notes=log.notes)
    if topics:
        raise ValueError("topics are for bags; name a table's columns with --map")
    if not entries and _is_episode(path):
        from tpcd.commands.checked_rows import check_rows_of  # episodes are tensors

        return check_rows_of(path)
    columns = read_columns(path)
    _give_back()
    suggestion = suggest_map(columns)
    used = tuple(entries) or suggestion.entries
    if not used:
        raise LogError(
            path,
            "no column is named as a pose or a wrench",
            f"map them with --map NAME=COLUMN; the columns are {', '.join(list(columns)[:40])}",
        )
    notes = (
        [] if entries else [f"no map was given; taken is what the names suggest: {suggestion.line}"]
    )
    log, streams, problem = _read_table(path, columns, used, euler, rate, notes)
    columns.clear()
    _give_back()
    found = check_recording(streams) if log is None else ()
    if log is not None:
        found = tuple(f for f in log.findings if not f.channels or set(f.channels) - log.missing)
    return replace(
        _checked(log, streams, found, stiffness, problem, notes),
        path=path,
        suggestion=suggestion,
        mapped=used,
    )


def _give_back() -> None:
    """Return to the system what the reader of tables keeps for the next one."""
    import pyarrow

    pyarrow.default_memory_pool().release_unused()


def _is_episode(path: Path) -> bool:
    """Whether a path names an episode: a table with its YAML beside it."""
    if path.is_dir() and (path / "metadata.yaml").is_file():
        return False
    if path.is_dir():
        return any(file.suffix == ".yaml" for file in path.iterdir())
    return path.suffix == ".yaml" or path.with_suffix(".yaml").is_file()


def _read_table(
    path: Path,
    columns: Table,
    entries: Sequence[str],
    euler: str,
    rate: float | None,
    notes: list[str],
) -> tuple[Log | None, tuple[Stream, ...], str]:
    """The recording of a table; without a pose or a wrench, its streams and what it lacks."""
    mapped = parse_map(entries, columns, path)
    for name in set(columns) - {column for column, _ in mapped.values()}:
        del columns[name]  # of a million rows they are worth their memory
    if "time" not in mapped and rate is None:
        # The order of the samples is all that is known; what takes seconds counts samples.
        rate = 1.0
        notes.append("no column of times and no --rate: one sample a second is taken")
    try:
        log = log_from_columns(columns, entries, path, euler, rate)
    except LogError as error:
        turned = [n for n in mapped if n[0] in "qre" or n == "phi"]
        if not {"F_x", "F_z"} <= set(mapped) or {"x", "z"} <= set(mapped) or not turned:
            return None, _streams(path, columns, mapped, rate), error.problem
        zeros = {ZERO: np.zeros(len(next(iter(columns.values()))))}
        more = [f"{name}={ZERO}" for name in ("x", "z") if name not in mapped]
        log = log_from_columns({**columns, **zeros}, [*entries, *more], path, euler, rate)
        log = replace(log, missing=log.missing | {"x", "z"} - set(mapped))
        notes.append("no positions were recorded: rotation and wrench alone are checked")
    notes += log.notes
    return log, tuple(_recorded(stream, log.missing) for stream in log.streams), ""


def _recorded(stream: Stream, missing: frozenset[str]) -> Stream:
    """The stream without channels that only stand in for something."""
    kept = [k for k, name in enumerate(stream.channels) if name not in missing]
    names = tuple(stream.channels[k] for k in kept)
    return replace(stream, channels=names, values=stream.values[:, kept])


def _streams(
    path: Path, columns: Table, mapped: dict[str, tuple[str, str]], rate: float | None
) -> tuple[Stream, ...]:
    """What the map gives, as one stream for set points and one for the rest."""
    values, _ = read_numbers(columns, mapped, path)
    times = values.pop("time", None)
    if times is None:
        times = np.arange(len(next(iter(columns.values())))) / (rate or 1.0)
    timed = np.isfinite(times)
    groups = ([n for n in values if not n.startswith("u_")], [n for n in values if n[:2] == "u_"])
    return tuple(
        Stream(
            path.name, tuple(names), times[timed], np.stack([values[n][timed] for n in names], 1)
        )
        for names in groups
        if names
    )


def _checked(
    log: Log | None,
    streams: Sequence[Stream],
    findings: Sequence[Finding],
    stiffness: Sequence[float] | None,
    problem: str = "",
    notes: Sequence[str] = (),
) -> Checked:
    noises = noise_at_rest(streams)
    found = (*findings, *check_noise_at_rest(noises))
    quantities: tuple[Quantity, ...] = ()
    if log is not None:
        quantities = identify(replace(log, findings=found), stiffness)
    path = log.path if log is not None else Path()
    return Checked(
        path, "recording", tuple(streams), found, noises, quantities, problem, notes=tuple(notes)
    )
