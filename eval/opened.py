"""Run folders of benchmarks, which always stay: what was worked out counts when they go on."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from tpcd.results import CONFIG_FILE, resumed_run, run_folder


def opened_run(
    config: Any, command: str, free: Sequence[str], resume: bool | None = None
) -> AbstractContextManager[Path]:
    """The folder `config.out`, new or, with `config.resume` or `resume`, that of an earlier run, of
    which the entries `free` may differ. Raises `RunError`."""
    if config.resume if resume is None else resume:
        return resumed_run(config.out, config, free)
    overwrite = getattr(config, "overwrite", False)
    return run_folder(config.out, command, config, overwrite, resumable=CONFIG_FILE)


def shared_run(config: Any, command: str, free: Sequence[str]) -> AbstractContextManager[Path]:
    """As `opened_run`, where several processes share the work: the folder is the first one's, which
    opens it before there are others, so that a folder in use is one line and not a crash."""
    first = int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0"))) == 0
    return opened_run(config, command, free) if first else nullcontext(config.out)
