"""Result folders: what was run, with which configuration and versions, and what came out.

A run folder holds `config.yaml` (the resolved configuration, readable by `--config`),
`versions.json` (command, date, git revision, packages, hardware) and, once the work is
done, `results.json` (the printed table with all of that). `run_folder` leaves a folder only
where the work in it is done, or can go on. While work goes on in a folder, no other process gets
it (`ownership`). Nothing heavy is imported here.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from tpcd.cli_messages import REMEDIES, file_of
from tpcd.errors import RunError
from tpcd.files import to_plain, write_json, write_text
from tpcd.ownership import check_none_within, is_lock, owned
from tpcd.plain_yaml import to_yaml
from tpcd.targets import ELSEWHERE, check_place
from tpcd.versions import differing_parts, versions

CONFIG_FILE = "config.yaml"
VERSIONS_FILE = "versions.json"
RESULTS_FILE = "results.json"
RESTORE = "restore it, or begin anew in a new folder"
STORAGE = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.EIO,
)
"""Errors of a disk that takes no more; what raises them often does not say for which file."""


@contextmanager
def run_folder(
    path: str | Path,
    command: str,
    config: Mapping[str, Any] | Any,
    overwrite: bool = False,
    resumable: str | None = None,
) -> Iterator[Path]:
    """A run folder that says what is run, belongs to this process while it runs, and stays only if
    the work in it is done.

    `command` names the program (`scripts/estimate.py`), `config` is its dataclass or a mapping.
    Where the body raises or is interrupted, what it wrote is removed and an earlier run
    that it was to replace is put back. `resumable` names the file or folder with which a stopped
    run can go on (`resumed_run`): once it is there, the run stays.

    Raises `RunError` when the folder belongs to another process or already holds something; with
    `overwrite` an earlier run there is replaced, but never a folder that is not a run, or that
    holds a file which the configuration names.
    """
    folder = Path(path).resolve()
    _check_place(Path(path))
    with owned(path, command):
        aside = _aside(folder, resumable)
        replacing = _holds_run(Path(path), overwrite, resumable)
        was_there = folder.is_dir() and not replacing
        if replacing:
            _spare_inputs(Path(path), config)
            check_none_within(path)
            _move_aside(folder, aside)
        try:
            _start(folder, command, config)
            yield Path(path)
        except BaseException as error:
            if resumable and (folder / resumable).exists():
                shutil.rmtree(aside, ignore_errors=True)
                _raise_told(error, path, f"{path} goes on with --resume")
            shutil.rmtree(folder, ignore_errors=True)
            if replacing:
                os.replace(aside, folder)
            elif was_there:
                folder.mkdir(exist_ok=True)
            kept = "the earlier run is as it was" if replacing else "nothing of the run is kept"
            if isinstance(error, KeyboardInterrupt):
                raise
            _raise_told(error, path, kept)
        shutil.rmtree(aside, ignore_errors=True)


@contextmanager
def resumed_run(
    path: str | Path, config: Mapping[str, Any] | Any, free: Sequence[str] = ()
) -> Iterator[Path]:
    """The folder of a run that was stopped, to go on in it; it belongs to this process meanwhile.

    Raises `RunError` when it belongs to another process, or holds no run or one of another
    configuration; entries named in `free` may differ, `resume` and `overwrite` always, and the
    run's `config.yaml` takes their new values. A file may be named in another way, as from another
    folder.
    """
    folder = Path(path)
    if not (folder / CONFIG_FILE).is_file():
        raise RunError(folder, "holds no run to go on with", "leave out --resume")
    with owned(path, str(_recorded(folder)["command"])):
        _continue(folder, config, free)
        shutil.rmtree(_earlier(folder.resolve()), ignore_errors=True)
        try:
            yield folder
        except BaseException as error:
            _raise_told(error, path, f"{path} goes on with --resume")


def _raise_told(error: BaseException, path: str | Path, what: str) -> NoReturn:
    """Raise what stopped a run, with what is left of it where that is in question."""
    if isinstance(error, KeyboardInterrupt):
        said = f"{error}; " if str(error) else ""
        raise KeyboardInterrupt(f"{said}{what}") from error
    if not isinstance(error, OSError) or error.errno not in STORAGE:
        raise error
    remedy = REMEDIES.get(error.errno)
    hint = f"{remedy}; {what}" if remedy else what
    raise RunError(file_of(error) or path, error.strerror or str(error), hint) from error


def _check_place(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise RunError(folder, "is a file", "name a folder for the results")
    check_place(folder)


def _holds_run(folder: Path, overwrite: bool, resumable: str | None = None) -> bool:
    """Whether an earlier run is to be replaced; `RunError` where nothing may be put there."""
    if not folder.is_dir() or all(is_lock(entry) for entry in folder.iterdir()):
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


def _earlier(folder: Path) -> Path:
    """Where a run waits until the one that replaces it is done."""
    return folder.with_name(f".{folder.name}.earlier")


def _aside(folder: Path, resumable: str | None) -> Path:
    """The place for an earlier run, empty. One is there where a process was killed while it
    replaced it: it comes back, unless what replaces it is done or can go on."""
    aside = _earlier(folder)
    if aside.is_dir():
        names = (RESULTS_FILE, *([resumable] if resumable else []))
        if any((folder / name).exists() for name in names):
            shutil.rmtree(aside)
        else:
            check_none_within(folder)
            shutil.rmtree(folder, ignore_errors=True)
            os.replace(aside, folder)
    return aside


def _move_aside(folder: Path, aside: Path) -> None:
    try:
        os.replace(folder, aside)
    except OSError as error:
        fault = f"cannot be replaced ({error.strerror})"
        raise RunError(folder, fault, "name a new folder") from error


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


def _start(folder: Path, command: str, config: Mapping[str, Any] | Any) -> None:
    """Make the folder and write what is about to run."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(folder, f"cannot be made ({error.strerror})", ELSEWHERE) from error
    body = to_yaml(_kept(config))
    write_text(folder / CONFIG_FILE, f"# {command}\n{body}")
    write_json(folder / VERSIONS_FILE, {"command": command, **versions()})


def _continue(folder: Path, config: Mapping[str, Any] | Any, free: Sequence[str]) -> None:
    """Refuse to go on with another configuration, and keep the new values; versions that have
    changed since are told, and kept beside those before."""
    from tpcd.records import fitting

    before, now = _kept(_configuration(folder)), _kept(config)
    recorded, here = _recorded(folder), versions()
    began_in = Path(str(recorded.get("folder", "")))
    changed = [key for key in now if now[key] != before.get(key)]
    differing = [key for key in changed if not _same(before.get(key), now[key], began_in)]
    differing = [key for key in differing if key not in free]
    if differing:
        raise RunError(
            folder, f"holds a run whose {_listed(differing)} not the same", "name a new folder"
        )
    with fitting(folder / VERSIONS_FILE, RESTORE):
        since = list(recorded.get("gone_on_with", []))
        other = differing_parts((since or [recorded])[-1], here)
    if other:
        told = f"note: {folder} goes on with other versions than before ({', '.join(other)})"
        print(f"{told}; both are in its {VERSIONS_FILE}", file=sys.stderr)
        recorded["gone_on_with"] = [*since, here]
    if changed:
        write_text(folder / CONFIG_FILE, to_yaml(now))
        recorded["folder"] = os.getcwd()
    if changed or other:
        write_json(folder / VERSIONS_FILE, recorded)


def _same(before: Any, now: Any, began_in: Path) -> bool:
    """Whether two entries are equal, or name the same file: one from where the run began, one from
    here."""
    if isinstance(before, list) and isinstance(now, list):
        pairs = zip(before, now, strict=False)
        return len(before) == len(now) and all(_same(*pair, began_in) for pair in pairs)
    if isinstance(before, str) and isinstance(now, str) and Path(now).exists():
        return (began_in / before).resolve() == Path(now).resolve()
    return before == now


def _configuration(folder: Path) -> dict[str, Any]:
    """What a run was begun with, or gone on with since; raises `FileError`."""
    from tpcd.records import read_entries

    return read_entries(folder / CONFIG_FILE, RESTORE)


def _recorded(folder: Path) -> dict[str, Any]:
    """What a run was begun by; raises `FileError`."""
    from tpcd.records import read_entries

    recorded = read_entries(folder / VERSIONS_FILE, RESTORE)
    if "command" not in recorded:
        raise RunError(folder / VERSIONS_FILE, "has no entry command", RESTORE)
    return recorded


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
    further entries beside it. Raises `RunError` when the folder was not made by `run_folder`.
    """
    folder = Path(folder)
    if not (folder / CONFIG_FILE).is_file() or not (folder / VERSIONS_FILE).is_file():
        raise RunError(folder, "is not an opened run", "make it with run_folder first")
    recorded = _recorded(folder)
    content = {
        "command": recorded.pop("command"),
        "table": list(table),
        **extra,
        "seeds": list(seeds),
        "config": _configuration(folder),
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
