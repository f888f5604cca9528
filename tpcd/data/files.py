"""Episodes on disk: read, written whole or not at all, found by name.

An episode is a pair of files, NAME.csv (or .parquet) with the columns step, u_x, u_z, u_phi, x, z,
phi, F_x, F_z, tau and NAME.yaml with stiffness, sensor noise and priors; further columns are kept.
SI units.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from tpcd.data.checks import check_rows, check_steps
from tpcd.data.episode import COLUMNS, Episode
from tpcd.data.header import ESTIMATE_NOISE, Header, encode_header, parse_header, read_header
from tpcd.data.limits import COMMAND_COLUMNS, POSE_COLUMNS, WRENCH_COLUMNS
from tpcd.data.measured import NoCommandsError
from tpcd.data.table import Table, encode_table, read_table
from tpcd.errors import EpisodeError
from tpcd.files import named
from tpcd.plain_yaml import parse_yaml

TABLE_SUFFIXES = (".csv", ".parquet")


def read_episode(path: str | Path) -> Episode:
    """Read an episode from NAME.csv, NAME.parquet, NAME.yaml, NAME or a folder with one.

    Raises `EpisodeError` with one line that names file, row, column, what was found, what
    is expected and what to do.
    """
    table_path, header_path = locate(Path(path))
    return read_rows(table_path, read_header(header_path))


def read_rows(table_path: Path, header: Header) -> Episode:
    """The table of an episode whose YAML has been read; raises as `read_episode` does.

    A recording without set points raises `NoCommandsError`.
    """
    if not header.commands_known:
        raise NoCommandsError(table_path)
    if header.sensor_std is None:
        raise EpisodeError(
            _add(_stem(table_path), ".yaml"), "key sensor_std is missing", ESTIMATE_NOISE
        )
    table = read_table(table_path, COLUMNS)
    check_steps(table_path, table["step"])
    commands, poses, wrenches = (
        np.stack([table[name] for name in names], axis=1)
        for names in (COMMAND_COLUMNS, POSE_COLUMNS, WRENCH_COLUMNS)
    )
    std, stiffness = np.array(header.sensor_std), np.array(header.stiffness)
    check_rows(table_path, commands, poses, wrenches, std, stiffness, header.unusual)
    return Episode(
        commands=torch.from_numpy(commands),
        poses=torch.from_numpy(poses),
        wrenches=torch.from_numpy(wrenches),
        stiffness=torch.tensor(header.stiffness, dtype=torch.float64),
        sensor_std=torch.tensor(header.sensor_std, dtype=torch.float64),
        object=header.object,
        notes=header.notes,
        time_step_s=header.time_step_s,
        priors=header.priors,
        extra={name: column for name, column in table.items() if name not in COLUMNS},
        doubts=header.doubts,
        path=table_path,
        unusual=header.unusual,
    )


def write_episode(
    episode: Episode,
    path: str | Path,
    format: Literal["csv", "parquet"] = "csv",
    overwrite: bool = False,
) -> Path:
    """Write the pair NAME.csv (or .parquet) and NAME.yaml; returns the path of the table.

    `path` is NAME with or without suffix; the folder is made if needed. Both files appear
    complete or not at all. Raises `EpisodeError` if an episode of that name exists in any
    format and `overwrite` is false, or if the content breaks the format.
    """
    contents = episode_contents(episode, path, format)
    write_together(contents, overwrite)
    return next(iter(contents))


def episode_contents(
    episode: Episode, path: str | Path, format: Literal["csv", "parquet"] = "csv"
) -> dict[Path, bytes | None]:
    """What the files of an episode hold: table, YAML, and None for the other format's table.

    Raises `EpisodeError` if the content breaks the format, `ValueError` for another format.
    """
    if format not in ("csv", "parquet"):
        raise ValueError(f"format is {format!r}, expected 'csv' or 'parquet'")
    stem = _stem(Path(path))
    table_path, header_path = _add(stem, f".{format}"), _add(stem, ".yaml")
    other_path = _add(stem, ".csv" if format == "parquet" else ".parquet")
    header = Header(
        stiffness=tuple(episode.stiffness.tolist()),
        sensor_std=tuple(episode.sensor_std.tolist()),
        object=episode.object,
        notes=episode.notes,
        time_step_s=episode.time_step_s,
        priors=dict(episode.priors),
        unusual=episode.unusual,
        doubts=episode.doubts,
    )
    header_bytes = encode_header(header)
    parse_header(parse_yaml(header_bytes), header_path)
    commands, poses, wrenches = (
        value.numpy() for value in (episode.commands, episode.poses, episode.wrenches)
    )
    table: Table = {"step": np.arange(len(episode), dtype=np.int64)}
    check_steps(table_path, table["step"])
    std, stiffness = episode.sensor_std.numpy(), episode.stiffness.numpy()
    check_rows(table_path, commands, poses, wrenches, std, stiffness, episode.unusual)
    for names, values in (
        (COMMAND_COLUMNS, commands),
        (POSE_COLUMNS, poses),
        (WRENCH_COLUMNS, wrenches),
    ):
        table.update({name: values[:, axis] for axis, name in enumerate(names)})
    table_bytes = encode_table({**table, **episode.extra}, table_path)
    return {table_path: table_bytes, header_path: header_bytes, other_path: None}


def write_together(contents: dict[Path, bytes | None], overwrite: bool = True) -> None:
    """Write several files so that all appear complete or, on failure, all stay as they were.

    None removes a file. Raises `EpisodeError` if one exists and `overwrite` is false.
    """
    for path in contents:
        if path.exists() and not overwrite:
            raise EpisodeError(path, "exists already", "choose another name or overwrite")
    staged: dict[Path, Path] = {}
    before: dict[Path, bytes | None] = {}
    try:
        for path, content in contents.items():
            if content is None:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
            staged[path] = Path(name)
            with named(path), os.fdopen(handle, "wb") as file:
                file.write(content)
            os.chmod(name, 0o644)
        for path in contents:
            before[path] = path.read_bytes() if path.exists() else None
            if path in staged:
                os.replace(staged[path], path)
            else:
                path.unlink(missing_ok=True)
    except BaseException:
        for path, content in before.items():
            if content is None:
                path.unlink(missing_ok=True)
            else:
                path.write_bytes(content)
        raise
    finally:
        for temporary in staged.values():
            temporary.unlink(missing_ok=True)


def locate(path: Path) -> tuple[Path, Path]:
    """Table and header of the episode that `path` names."""
    if path.is_dir():
        names = sorted(
            {
                _stem(file)
                for file in path.iterdir()
                if file.suffix in TABLE_SUFFIXES
                and not _stem(file).name.endswith(".truth")
                and not file.name.startswith(".")
            }
        )
        if len(names) != 1:
            found = ", ".join(name.name for name in names[:6]) or "none"
            raise EpisodeError(
                path,
                f"found {len(names)} episodes ({found}) in the folder, expected one",
                "name the file NAME.csv" if names else "put NAME.csv and NAME.yaml there",
            )
        path = names[0]
    stem = _stem(path)
    tables = [_add(stem, suffix) for suffix in TABLE_SUFFIXES if _add(stem, suffix).is_file()]
    if path.suffix in TABLE_SUFFIXES:
        if not path.is_file():
            raise EpisodeError(path, "no such file", "give NAME.csv, NAME.parquet or their folder")
        return path, _add(stem, ".yaml")
    if len(tables) > 1:
        raise EpisodeError(stem, "has both a .csv and a .parquet table", "name one of them")
    if not tables and path.is_file() and path.suffix != ".yaml":
        raise EpisodeError(path, "is no .csv or .parquet table", "export the episode as CSV")
    if not tables:
        missing = _add(stem, ".csv")
        raise EpisodeError(missing, "no such file", "give NAME.csv, NAME.parquet or their folder")
    return tables[0], _add(stem, ".yaml")


def _stem(path: Path) -> Path:
    """NAME of NAME.csv, NAME.parquet or NAME.yaml; dots elsewhere in the name stay."""
    return path.with_suffix("") if path.suffix in (*TABLE_SUFFIXES, ".yaml") else path


def _add(stem: Path, suffix: str) -> Path:
    return stem.with_name(stem.name + suffix)
