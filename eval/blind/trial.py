"""One case from its making to its verdict: sealed, diagnosed from files, written down."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterable
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

from eval.blind.cases import draw_world, record_case
from eval.blind.sealing import Seal, read_sealed, seal
from eval.blind.suites import Case
from eval.lines import read_lines
from tpcd.data import Episode
from tpcd.discrepancy.diagnosis import Diagnosis
from tpcd.files import to_plain
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.protocol import Shape

LEFT_OUT = ("cells_before", "cells_after")
"""Long parts of a diagnosis that are not scored."""


def run_case(case: Case, seed: int, prior: str, folder: Path) -> dict[str, Any]:
    """The line of a case: its seal and the verdict, or why there is none."""
    token = case.token(seed)
    line: dict[str, Any] = {"case": token}
    started = time.perf_counter()
    try:
        sealed = make_case(case, seed, folder)
        line |= asdict(sealed)
        main, fresh = read_sealed(folder, token)
        started = time.perf_counter()
        diagnosis = find_effects(main, fresh, load_shape(prior), token, case.settings.without)
        line["wall_s"] = time.perf_counter() - started
        plain = {k: v for k, v in diagnosis.to_plain().items() if k not in LEFT_OUT}
        return {**line, "diagnosis": to_plain(plain, flagged=[])}
    except Exception as error:  # one case must not cost the others
        place = traceback.extract_tb(error.__traceback__)[-1]
        line["failed"] = (
            f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
        )
        return {**line, "wall_s": time.perf_counter() - started}


def make_case(case: Case, seed: int, folder: Path) -> Seal:
    """Draw the world of a case, record its episodes, and seal them with the key."""
    world = draw_world(case, seed)
    main, fresh = (record_case(world, case, seed, fresh=late) for late in (False, True))
    key = {
        **asdict(case),
        "seed": seed,
        "settings": asdict(case.settings) | {"labels": None},
        **world.key(),
        "not_settled": [k for k, still in enumerate(main.settled) if not still],
        "fresh_not_settled": [k for k, still in enumerate(fresh.settled) if not still],
    }
    return seal(folder, case.token(seed), main.measured, fresh.measured, key)


def find_effects(
    main: Episode, fresh: Episode, shape: Shape, token: str, without: str
) -> Diagnosis:
    """The workflow under test, whose own seed has nothing to do with that of the case."""
    from tpcd.discrepancy.search import DiagnosisSettings, diagnose

    switches: dict[str, Any] = {without: False} if without else {}
    settings = DiagnosisSettings(seed=int(token[:7], 16), **switches)
    return diagnose([main], shape, settings, fresh=[fresh])


@lru_cache(maxsize=1)
def load_shape(prior: str) -> Shape:
    """The shape prior, read once for each process."""
    return load_prior(prior)


def read_verdicts(folder: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Lines of all processes with a verdict, and of cases that have only failed so far."""
    lines: Iterable[dict[str, Any]] = (
        line for path in sorted(folder.glob("verdicts-*.jsonl")) for line in read_lines(path)
    )
    good: dict[str, dict[str, Any]] = {}
    bad: dict[str, dict[str, Any]] = {}
    for line in lines:
        # The first verdict of a case stands.
        (bad if "failed" in line else good).setdefault(line["case"], line)
    return list(good.values()), [line for case, line in bad.items() if case not in good]
