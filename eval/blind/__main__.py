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
python -m eval.blind --combine runs/blind runs/more --out runs/all
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eval.blind.suites import SUITES, Case, plan
from eval.lines import append_lines, write_line
from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from eval.blind.score import Score

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
    """Three cases of 20 steps, for a smoke run."""
    resume: bool = False
    """Go on with the cases that an earlier run in the folder did not finish."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    combine: tuple[Path, ...] = ()
    """Folders of earlier runs to score together instead; a case that two hold counts once."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"runs": 1, "workers": 1})
        if self.combine and self.resume:
            raise ValueError("give --combine or --resume, not both")
        if not self.suites:
            raise ValueError("suites is empty, expected at least one")
        for suite in self.suites:
            if suite not in SUITES:
                raise ValueError(f"suite is {suite!r}, expected one of {', '.join(SUITES)}")


def run_blind(config: Blind) -> None:
    """Name hidden effects without the key, then open it and score."""
    from datetime import timedelta

    import torch
    from lightning.fabric import Fabric
    from lightning.fabric.strategies.ddp import DDPStrategy

    from tpcd.results import continue_run, open_run, run_folder

    torch.set_num_threads(1)
    if config.combine:
        with run_folder(config.out, "python -m eval.blind", config, config.overwrite):
            score(config, config.combine)
        return
    # Before there are other processes, so that a folder in use is one line and not a crash.
    if int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0"))) == 0:
        if config.resume:
            # More cases may be asked of an earlier run; what is in a case must stay the same.
            cases = ("suites", "runs", "quick", "combine")
            continue_run(config.out, config, ("out", "workers", *cases))
        else:
            open_run(config.out, "python -m eval.blind", config, config.overwrite)
    # Workers end at different times; the first waits for the last.
    parallel: Any = DDPStrategy(process_group_backend="gloo", timeout=timedelta(days=7))
    if "LT_CLI_USED" in os.environ:  # `fabric run` has made the processes and says how many
        fabric = Fabric(strategy=parallel)
    else:
        strategy = parallel if config.workers > 1 else "auto"
        fabric = Fabric(accelerator="cpu", devices=config.workers, strategy=strategy)
        fabric.launch()
    fabric.barrier()
    _run_missing(config, fabric.global_rank, fabric.world_size)
    fabric.barrier()
    if fabric.global_rank == 0:
        score(config)


def case_seed(config: Blind) -> int:
    """Seed of the cases; a smoke run must not look at those of the benchmark."""
    return TUNING_SEED if config.quick else config.seed


def cases_of(config: Blind) -> list[Case]:
    """All cases that a configuration asks for."""
    return plan(("quick",), 1) if config.quick else plan(config.suites, config.runs)


def _run_missing(config: Blind, rank: int, world: int) -> None:
    """This process's share of the cases."""
    from tqdm import tqdm

    from eval.blind.trial import read_verdicts, run_case

    seed = case_seed(config)
    done = {line["case"] for line in read_verdicts(config.out)[0]}
    mine = [case for case in cases_of(config)[rank::world] if case.token(seed) not in done]
    with append_lines(config.out / f"verdicts-{rank}.jsonl") as lines:
        for case in tqdm(mine, unit="case", disable=rank > 0):
            write_line(lines, run_case(case, seed, config.prior, config.out))


def score(config: Blind, folders: Sequence[Path] = ()) -> None:
    """Open all keys of the folder, or of several, score, print and draw.

    Raises `RunError` for a key or an episode that is not the one sealed or a folder that is no
    run, `ValueError` where there is no verdict.
    """
    from torch.utils.tensorboard import SummaryWriter

    from eval.blind.pages import report
    from eval.blind.trial import load_shape
    from tpcd.results import write_results

    runs = [_run_of(folder) for folder in folders]
    scores, failed = read_scores(folders or (config.out,))
    with SummaryWriter(config.out / "tensorboard") as writer:
        tables = report(scores, config.out, writer)
    seeds = tuple(dict.fromkeys(one["seed"] for one in runs)) or (case_seed(config),)
    priors = dict.fromkeys(one["prior"] for one in runs) or (config.prior,)
    note = " ".join(filter(None, (_known_objects(prior, load_shape(prior)) for prior in priors)))
    write_results(
        config.out, tables["marks"], seeds=seeds, suites=tables["suites"], runs=runs,
        effects=tables["effects"], detection=tables["detection"], cases=scores, failed=failed,
        note=note,
    )  # fmt: skip
    if note:
        print(f"\n{note}")
    for line in failed:
        print(f"failed: {line['case']}: {line['failed']}", file=sys.stderr)
    print(f"results in {config.out}")


def read_scores(folders: Sequence[Path]) -> tuple[list[Score], list[dict[str, Any]]]:
    """The scores of all cases of some folders, and the lines of those that only failed."""
    from eval.blind.score import score_verdicts
    from eval.blind.trial import read_verdicts

    scores: dict[str, Score] = {}
    all_failed: list[dict[str, Any]] = []
    has_verdict = False
    for folder in folders:
        verdicts, failed = read_verdicts(folder)
        has_verdict |= bool(verdicts)
        # Where the workflow itself failed, it has found nothing.
        lines = [*verdicts, *(line for line in failed if "key_sha256" in line)]
        lines = [line for line in lines if line["case"] not in scores]
        found = score_verdicts(folder, lines)
        scores |= {line["case"]: one for line, one in zip(lines, found, strict=True)}
        all_failed += failed
    if not has_verdict:
        why = all_failed[0]["failed"] if all_failed else "none was run"
        raise ValueError(f"no case of {len(all_failed)} has a verdict; the first: {why}")
    return list(scores.values()), all_failed


def _run_of(folder: Path) -> dict[str, Any]:
    """What a run in a folder was asked, and by which revision."""
    import yaml

    from tpcd.errors import RunError
    from tpcd.files import read_json
    from tpcd.results import CONFIG_FILE, VERSIONS_FILE

    if not (folder / CONFIG_FILE).is_file():
        raise RunError(folder, "holds no run", "give folders of python -m eval.blind to --combine")
    asked = yaml.safe_load((folder / CONFIG_FILE).read_text(encoding="utf-8"))
    versions = read_json(folder / VERSIONS_FILE)
    seed = TUNING_SEED if asked["quick"] else asked["seed"]
    kept = {key: asked[key] for key in ("suites", "runs", "prior")}
    return {"folder": str(folder), "seed": seed, **kept, "versions": versions}


def _known_objects(prior: str, shape: Any) -> str:
    """What to say of objects that a prior was trained on."""
    from eval.blind.cases import outlines

    trained = [str(name) for name in getattr(shape, "names", ())]
    seen = [n for n in outlines() if any(t == n or t.startswith(f"{n}/") for t in trained)]
    if not seen:
        return ""
    return f"The shape prior {prior} was trained on {len(seen)} of the {len(outlines())} objects."


if __name__ == "__main__":
    run(run_blind, Blind, prog="python -m eval.blind")
