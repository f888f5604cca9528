"""Folders of the blind benchmark scored together: suites and seeds that were run apart.

python -m eval.blind.combine runs/medium runs/small runs/clean --out runs/all
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.blind.__main__ import COMMAND, Blind, case_seed, cases_of
from tpcd.cli import run


@dataclass(frozen=True)
class Combine:
    """Settings of the command."""

    folders: tuple[Path, ...] = ()
    """Folders of finished runs with the same shape prior; a case that two hold counts once."""
    out: Path = Path("runs/blind_together")
    """Folder for the results."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        if not self.folders:
            raise ValueError(f"folders is empty, expected some of {COMMAND}")


def combine(config: Combine) -> None:
    """Open the keys of all folders, score, print and draw."""
    from eval.blind.pages import write_report
    from eval.blind.score import read_scores
    from tpcd.errors import RunError
    from tpcd.results import run_folder

    runs = {folder: _finished_run(folder) for folder in config.folders}
    first = next(iter(runs))
    for folder, (asked, _) in runs.items():
        prior = runs[first][0].prior
        if asked.prior != prior:
            raise RunError(
                folder, f"has the prior {asked.prior}, but {first} has {prior}", "score them apart"
            )
    with run_folder(config.out, "python -m eval.blind.combine", config, config.overwrite) as out:
        scores, failed = read_scores(list(runs))
        told = [
            {"folder": str(folder), "suites": asked.suites, "runs": asked.runs,
             "seed": case_seed(asked), "versions": versions}
            for folder, (asked, versions) in runs.items()
        ]  # fmt: skip
        seeds = tuple(dict.fromkeys(case_seed(asked) for asked, _ in runs.values()))
        write_report(scores, failed, out, runs[first][0].prior, seeds, runs=told)


def _finished_run(folder: Path) -> tuple[Blind, dict[str, Any]]:
    """What a run was asked, and by which revision; raises `RunError` where it is none or not done,
    since keys are not opened before."""
    from eval.blind.trial import read_verdicts
    from tpcd.errors import RunError
    from tpcd.files import read_json
    from tpcd.plain_yaml import read_yaml
    from tpcd.results import CONFIG_FILE, VERSIONS_FILE

    versions = read_json(folder / VERSIONS_FILE) if (folder / VERSIONS_FILE).is_file() else {}
    if versions.pop("command", None) != COMMAND:
        raise RunError(folder, f"is no run of {COMMAND}", "name folders that it wrote")
    kept = read_yaml(folder / CONFIG_FILE, RunError)
    asked = Blind(
        suites=tuple(kept["suites"]),
        **{name: kept[name] for name in ("runs", "seed", "prior", "quick")},
    )
    done = {line["case"] for lines in read_verdicts(folder) for line in lines}
    cases = [case.token(case_seed(asked)) for case in cases_of(asked)]
    missing = sum(case not in done for case in cases)
    if missing:
        raise RunError(
            folder, f"lacks {missing} of {len(cases)} verdicts", f"go on with {COMMAND} --resume"
        )
    return asked, versions


if __name__ == "__main__":
    run(combine, Combine, prog="python -m eval.blind.combine", positional=("folders",))
