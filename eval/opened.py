"""Run folders of benchmarks, which always stay: what was worked out counts when they go on."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from tpcd.errors import RunError
from tpcd.files import read_json, write_json
from tpcd.results import CONFIG_FILE, resumed_run, run_folder

PRIORS_FILE = "priors.json"
"""Name of each prior and the SHA-256 of its weights."""


@contextmanager
def opened_run(
    config: Any, command: str, free: Sequence[str], resume: bool | None = None
) -> Iterator[Path]:
    """The folder `config.out`, new or, with `config.resume` or `resume`, that of an earlier run, of
    which the entries `free` may differ, but not what the priors hold. Raises `RunError`."""
    if config.resume if resume is None else resume:
        opened = resumed_run(config.out, config, free)
    else:
        overwrite = getattr(config, "overwrite", False)
        opened = run_folder(config.out, command, config, overwrite, resumable=CONFIG_FILE)
    with opened as folder:
        _check_priors(config, folder)
        yield folder


def _check_priors(config: Any, folder: Path) -> None:
    """Keep which weights the priors of the configuration have; refuse others in the same run."""
    from tpcd.shape.checkpoint import prior_hash

    given = [getattr(config, name, None) for name in ("prior", "paper_prior")]
    names = [str(name) for name in (*given, *getattr(config, "priors", ())) if name]
    now = {name: prior_hash(name) for name in names}
    path = folder / PRIORS_FILE
    before = read_json(path) if path.is_file() else {}
    changed = [name for name, weights in now.items() if before.get(name, weights) != weights]
    if changed:
        told = f"goes on with another prior {', '.join(changed)} than it began with"
        raise RunError(folder, told, "name a new folder with --out")
    write_json(path, before | now)


def shared_run(config: Any, command: str, free: Sequence[str]) -> AbstractContextManager[Path]:
    """As `opened_run`, where several processes share the work: the folder is the first one's, which
    opens it before there are others, so that a folder in use is one line and not a crash."""
    first = int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0"))) == 0
    return opened_run(config, command, free) if first else nullcontext(config.out)
