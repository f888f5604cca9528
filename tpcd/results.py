"""Result folders: what was run, with which configuration and versions, and what came out.

A run folder holds `config.yaml` (the resolved configuration, readable by `--config`),
`versions.json` (command, date, git revision, packages, hardware) and, once the work is
done, `results.json` (the printed table with all of that). `run_folder` leaves a folder only
where the work in it is done. Nothing heavy is imported here.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tpcd.errors import RunError
from tpcd.files import read_json, to_plain, write_json, write_text
from tpcd.targets import ELSEWHERE, check_place
from tpcd.versions import versions

CONFIG_FILE = "config.yaml"
VERSIONS_FILE = "versions.json"
RESULTS_FILE = "results.json"


def open_run(
    path: str | Path, command: str, config: Mapping[str, Any] | Any, overwrite: bool = False
) -> Path:
    """Make a run folder that says what is about to run, and return it; see also `run_folder`.

    `command` names the program (`scripts/estimate.py`), `config` is its dataclass or a
    mapping. Raises `RunError` when the folder already holds something; with `overwrite`
    an earlier run there is removed, but never a folder that is not a run, or that holds a file
    which the configuration names.
    """
    folder = Path(path)
    if _holds_run(folder, overwrite):
        _spare_inputs(folder, config)
        shutil.rmtree(folder)
    return _started(folder, command, config)


@contextmanager
def run_folder(
    path: str | Path,
    command: str,
    config: Mapping[str, Any] | Any,
    overwrite: bool = False,
    resumable: str | None = None,
) -> Iterator[Path]:
    """A run folder as `open_run` makes it that stays only if the work in it is done.

    Where the body raises or is interrupted, what it wrote is removed and an earlier run
    that it was to replace is put back. `resumable` names the file or folder with which a stopped
    run can go on (`continue_run`): once it is there, the run stays.
    """
    folder = Path(path).absolute()
    aside = folder.with_name(f".{folder.name}.{os.getpid()}.earlier")
    replacing = _holds_run(Path(path), overwrite, resumable)
    if replacing:
        _spare_inputs(Path(path), config)
    was_there = folder.is_dir() and not replacing
    new_parents = [parent for parent in folder.parents if not parent.exists()]
    if replacing:
        os.replace(folder, aside)
    try:
        yield _started(Path(path), command, config)
    except BaseException as error:
        if resumable and (folder / resumable).exists():
            shutil.rmtree(aside, ignore_errors=True)
            if isinstance(error, KeyboardInterrupt):
                raise _interrupted(path, error) from error
            raise
        shutil.rmtree(folder, ignore_errors=True)
        if replacing:
            os.replace(aside, folder)
        elif was_there:
            folder.mkdir()
        for parent in new_parents:
            with suppress(OSError):  # something else may have come into it
                parent.rmdir()
        raise
    shutil.rmtree(aside, ignore_errors=True)


@contextmanager
def resumed_run(
    path: str | Path, config: Mapping[str, Any] | Any, free: Sequence[str] = ()
) -> Iterator[Path]:
    """The folder of `continue_run`; where the body is interrupted, what is told says how the run
    goes on."""
    folder = continue_run(path, config, free)
    try:
        yield folder
    except KeyboardInterrupt as error:
        raise _interrupted(path, error) from error


def _interrupted(path: str | Path, error: KeyboardInterrupt) -> KeyboardInterrupt:
    said = f"{error}; " if str(error) else ""
    return KeyboardInterrupt(f"{said}{path} goes on with --resume")


def _holds_run(folder: Path, overwrite: bool, resumable: str | None = None) -> bool:
    """Whether an earlier run is to be replaced; `RunError` where nothing may be put there."""
    if folder.exists() and not folder.is_dir():
        raise RunError(folder, "is a file", "name a folder for the results")
    if not folder.is_dir() or not any(folder.iterdir()):
        check_place(folder)
        return False
    if not overwrite:
        stopped = bool(resumable) and (folder / str(resumable)).exists()
        stopped = stopped and not (folder / RESULTS_FILE).exists()
        remedy = "go on with --resume, name" if stopped else "name"
        raise RunError(folder, "is not empty", f"{remedy} a new folder or pass --overwrite")
    if not (folder / VERSIONS_FILE).is_file():
        raise RunError(
            folder, f"is not a run (no {VERSIONS_FILE}), not overwritten", "name a new folder"
        )
    return True


def _spare_inputs(folder: Path, config: Mapping[str, Any] | Any) -> None:
    """Refuse to remove what the configuration names, such as the recording to work on."""
    whole = folder.resolve()
    for key, value in (config if isinstance(config, Mapping) else vars(config)).items():
        names = value if isinstance(value, (tuple, list)) else (value,)
        for name in names:
            if key == "out" or not isinstance(name, (str, Path)) or not str(name):
                continue
            place = Path(name).resolve()
            within = place == whole or whole in place.parents
            if within and (place.exists() or _episode_there(place)):
                raise RunError(
                    folder, f"holds {name}, which would be removed", "name a new folder for --out"
                )


def _episode_there(place: Path) -> bool:
    """Whether the path is an episode's name without its suffix."""
    return any(place.with_name(place.name + suffix).exists() for suffix in (".csv", ".parquet"))


def _started(folder: Path, command: str, config: Mapping[str, Any] | Any) -> Path:
    """Make the folder and write what is about to run."""
    import yaml

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(folder, f"cannot be made ({error.strerror})", ELSEWHERE) from error
    body = yaml.safe_dump(_kept(config), sort_keys=False, allow_unicode=True)
    write_text(folder / CONFIG_FILE, f"# {command}\n{body}")
    write_json(folder / VERSIONS_FILE, {"command": command, **versions()})
    return folder


def continue_run(
    path: str | Path, config: Mapping[str, Any] | Any, free: Sequence[str] = ()
) -> Path:
    """Return the folder of a run that was stopped, to go on in it.

    Raises `RunError` when the folder holds no run, or one of another configuration; entries
    named in `free` may differ, `resume` and `overwrite` always, and the run's `config.yaml` takes
    their new values.
    """
    import yaml

    folder = Path(path)
    if not (folder / CONFIG_FILE).is_file():
        raise RunError(folder, "holds no run to go on with", "leave out --resume")
    before = yaml.safe_load((folder / CONFIG_FILE).read_text(encoding="utf-8"))
    before, now = _kept(before), _kept(config)
    differing = [key for key in now if key not in free and now[key] != before.get(key)]
    if differing:
        raise RunError(
            folder, f"holds a run whose {_listed(differing)} not the same", "name a new folder"
        )
    if any(now[key] != before.get(key) for key in now):
        write_text(folder / CONFIG_FILE, yaml.safe_dump(now, sort_keys=False))
    return folder


def _kept(config: Mapping[str, Any] | Any) -> dict[str, Any]:
    """What a run keeps of a configuration: how it was begun or gone on with does not matter."""
    plain = to_plain(config)
    return {key: False if key in ("resume", "overwrite") else plain[key] for key in plain}


def _listed(names: Sequence[str]) -> str:
    """Names with the verb that fits them."""
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'}"


def write_results(
    folder: str | Path,
    table: Sequence[Mapping[str, Any]],
    *,
    seeds: Sequence[int] = (),
    **extra: Any,
) -> Path:
    """Write `results.json` into an opened run: table, configuration, versions, seeds.

    `table` is what was printed, or the numbers behind it, one mapping for each row; `extra` adds
    further entries beside it. Raises `RunError` when the folder was not made by `open_run`.
    """
    import yaml

    folder = Path(folder)
    if not (folder / CONFIG_FILE).is_file() or not (folder / VERSIONS_FILE).is_file():
        raise RunError(folder, "is not an opened run", "make it with open_run first")
    recorded = read_json(folder / VERSIONS_FILE)
    content = {
        "command": recorded.pop("command"),
        "table": list(table),
        **extra,
        "seeds": list(seeds),
        "config": yaml.safe_load((folder / CONFIG_FILE).read_text(encoding="utf-8")),
        "versions": recorded,
    }
    return write_json(folder / RESULTS_FILE, content)


def format_table(
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[str] = (),
    formats: Mapping[str, str] | None = None,
) -> str:
    """Align rows as text: a line of names, a rule, one line for each row.

    `columns` chooses and orders the columns (default: all, as they first appear);
    `formats` gives a format specification for a column, else numbers get 4 digits.
    Numbers are set flush right, text flush left; a missing value shows as '-'.
    """
    columns = columns or list(dict.fromkeys(name for row in rows for name in row))
    formats = formats or {}
    cells = [[_cell(row.get(name), formats.get(name)) for name in columns] for row in rows]
    numeric = [
        any(isinstance(row.get(name), (int, float)) for row in rows)
        and not any(isinstance(row.get(name), str) for row in rows)
        for name in columns
    ]
    widths = [max([len(name), *(len(line[i]) for line in cells)]) for i, name in enumerate(columns)]

    def aligned(line: Sequence[str]) -> str:
        return "  ".join(
            text.rjust(width) if right else text.ljust(width)
            for text, width, right in zip(line, widths, numeric, strict=True)
        ).rstrip()

    rule = "  ".join("-" * width for width in widths)
    return "\n".join([aligned(list(columns)), rule, *(aligned(line) for line in cells)])


def _cell(value: Any, specification: str | None) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if specification:
        return format(value, specification)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
