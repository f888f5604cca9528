"""The gap workflow put to a blind test: hidden effects, sealed keys, verdicts first.

Each case draws an object, a scene and effects, records an episode and a fresh one, seals the
key, and lets the workflow diagnose the files; its verdict goes into a line of `verdicts-*.jsonl`
with the hash of the key. Keys are opened only once all verdicts are there. Suites: clean,
medium, small, pairs, outside, press, short30, short15, noise3, mujoco, and with a part of the
workflow switched off no_base_refit, no_from_prior, no_adequacy, no_parity. A run of `medium`
has one case for each of 23 effects; `clean` asks for 200 runs.

Each case is independent of how many processes share the work, so that a stopped run goes on
where it was, and a finished one can be given more suites and runs with --resume.

python -m eval.blind --suites clean medium --runs 10 --workers 2 --out runs/blind
python -m eval.blind --suites clean --runs 200 --workers 2 --out runs/blind --resume
python -m eval.blind.combine runs/blind runs/more --out runs/all
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.blind.suites import SUITES, Case, plan
from eval.lines import append_lines, write_line
from eval.opened import shared_run
from tpcd.cli import check_numbers, run

COMMAND = "python -m eval.blind"
TUNING_SEED = 10000
"""Cases of this seed may be looked at."""


@dataclass(frozen=True)
class Blind:
    """Settings of the benchmark."""

    out: Path = Path("runs/blind")
    """Folder for the results; a stopped run in it goes on with --resume."""
    suites: tuple[str, ...] = ("clean", "medium")
    """Suites to run, such as clean, medium, small, pairs, outside, press, mujoco."""
    runs: int = 10
    """Cases of each suite, for suites of single effects of each effect."""
    seed: int = 20000
    """Seed of all cases; tuning, and --quick, have 10000."""
    prior: str = "ycb-rich"
    """Shape prior of the workflow; ycb-rich-holdout has not seen the objects."""
    workers: int = 1
    """Processes that share the work on this machine."""
    quick: bool = False
    """Three cases of 20 steps, for a smoke run of two to four minutes."""
    resume: bool = False
    """Go on with the cases that an earlier run in the folder did not finish."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"runs": 1, "workers": 1})
        if not self.suites:
            raise ValueError("suites is empty, expected at least one")
        for suite in self.suites:
            if suite not in SUITES:
                raise ValueError(f"suite is {suite!r}, expected one of {', '.join(SUITES)}")


def run_blind(config: Blind) -> None:
    """Name hidden effects without the key, then open it and score."""
    import torch

    torch.set_num_threads(1)
    # More cases may be asked of an earlier run; what is in a case must stay the same.
    free = ("out", "workers", "suites", "runs", "quick")
    with shared_run(config, COMMAND, free):
        _run_shared(config)


def _run_shared(config: Blind) -> None:
    """The work of this process and, for the first one, the score of all."""
    from datetime import timedelta

    from lightning.fabric import Fabric
    from lightning.fabric.strategies.ddp import DDPStrategy

    # Workers end at different times; the first waits for the last.
    parallel: Any = DDPStrategy(process_group_backend="gloo", timeout=timedelta(days=7))
    if "LT_CLI_USED" in os.environ:  # `fabric run` has made the processes and says how many
        fabric = Fabric(strategy=parallel)
    else:
        strategy = parallel if config.workers > 1 else "auto"
        fabric = Fabric(accelerator="cpu", devices=config.workers, strategy=strategy)
        fabric.launch()
    missing = fabric.broadcast(_missing(config))
    _run(config, missing[fabric.global_rank :: fabric.world_size], fabric.global_rank)
    fabric.barrier()
    if fabric.global_rank == 0:
        score(config)


def case_seed(config: Blind) -> int:
    """Seed of the cases; a smoke run must not look at those of the benchmark."""
    return TUNING_SEED if config.quick else config.seed


def cases_of(config: Blind) -> list[Case]:
    """All cases that a configuration asks for."""
    return plan(("quick",), 1) if config.quick else plan(config.suites, config.runs)


def _missing(config: Blind) -> list[Case]:
    """The cases that have no verdict yet."""
    from eval.blind.trial import read_verdicts

    done = {line["case"] for line in read_verdicts(config.out)[0]}
    return [case for case in cases_of(config) if case.token(case_seed(config)) not in done]


def _run(config: Blind, cases: Sequence[Case], rank: int) -> None:
    """This process's share of the cases."""
    from tqdm import tqdm

    from eval.blind.trial import run_case

    with append_lines(config.out / f"verdicts-{rank}.jsonl") as lines:
        for case in tqdm(cases, unit="case", disable=rank > 0):
            write_line(lines, run_case(case, case_seed(config), config.prior, config.out))


def score(config: Blind) -> None:
    """Open all keys of the folder, score, print and draw.

    Raises `RunError` for a key or an episode that is not the one sealed, `ValueError` where
    there is no verdict.
    """
    from eval.blind.pages import write_report
    from eval.blind.score import FAILED, read_scores

    scores, failed = read_scores([config.out])
    if all(one.verdict == FAILED["verdict"] for one in scores):
        why = failed[0]["failed"] if failed else "none was run"
        raise ValueError(f"no case of {len(failed)} has a verdict; the first: {why}")
    write_report(scores, failed, config.out, config.prior, (case_seed(config),))


if __name__ == "__main__":
    run(run_blind, Blind, prog=COMMAND)
