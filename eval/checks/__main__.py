"""How often the checks of recordings are right: identification, conventions, faults of channels,
delays, whether a recording fits a belief; and how deep the simulator's good answers are in terrain.

Everything is simulated (tests/made_*.py), so that all of it is known. Run r of a part takes
seed + r, and a part has its share of `--runs`. Each run is one line of `runs.jsonl`, independent of
the others, so that a stopped command goes on with --resume.

python -m eval.checks --out runs/checks
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from eval.lines import append_lines, read_lines, write_line
from eval.opened import opened_run
from tpcd.cli import check_numbers, run

COMMAND = "python -m eval.checks"
RUNS_FILE = "runs.jsonl"
QUICK = 25
"""Of how many runs --quick makes one."""
SHARES = {
    "identification": 1.0,
    "conventions": 0.08,
    "channels": 0.4,
    "delays": 0.3,
    "fit": 0.2,
    "steps": 0.2,
}
"""Runs of each part, of those that are asked for."""


@dataclass(frozen=True)
class Checks:
    """Settings of the command."""

    out: Path = Path("runs/checks")
    """Folder for the results; a stopped run in it goes on with --resume."""
    runs: int = 100
    """Recordings of each kind to identify arms from; the other parts have 0.08 to 0.4 of them."""
    parts: tuple[str, ...] = tuple(SHARES)
    """Parts to measure."""
    seed: int = 110000
    """Run r of every part takes seed + r. Checks were made and changed on seeds below these."""
    quick: bool = False
    """One of 25 runs, for a smoke run of two minutes."""
    resume: bool = False
    """Go on with the runs that an earlier command in the folder did not finish, or add more."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"runs": 1, "seed": 0})
        for part in self.parts:
            if part not in SHARES:
                raise ValueError(f"part is {part!r}, expected one of {', '.join(SHARES)}")

    def seeds(self, part: str) -> range:
        """Seeds of the runs of a part."""
        runs = self.runs / QUICK if self.quick else self.runs
        return range(self.seed, self.seed + max(1, round(SHARES[part] * runs)))


def evaluate_checks(config: Checks) -> None:
    """Measure every part, then print and write what the runs come to."""
    import torch
    from tqdm import tqdm

    from eval.checks.arms import identify_runs
    from eval.checks.page import page_text, tables_of
    from eval.checks.recordings import channel_runs, convention_runs, delay_runs
    from eval.checks.scenes import fit_runs, step_runs
    from tpcd.files import read_json, to_plain, write_text
    from tpcd.results import write_results

    makers = (identify_runs, convention_runs, channel_runs, delay_runs, fit_runs, step_runs)
    make = dict(zip(SHARES, makers, strict=True))
    torch.set_num_threads(1)
    with opened_run(config, COMMAND, ("out", "runs", "quick", "parts")) as folder:
        lines = {(line["part"], line["seed"]): line for line in read_lines(folder / RUNS_FILE)}
        wanted = [(part, seed) for part in config.parts for seed in config.seeds(part)]
        with append_lines(folder / RUNS_FILE) as file:
            for part, seed in tqdm([w for w in wanted if w not in lines], unit="run"):
                line = to_plain({"part": part, "seed": seed, "rows": make[part](seed)})
                lines[part, seed] = line
                write_line(file, line)
        tables = tables_of(lines[each] for each in wanted)
        runs = {part: len(config.seeds(part)) for part in config.parts}
        first = tables.pop("identification", [])
        write_results(folder, first, seeds=[config.seed], runs_of_parts=runs, **tables)
        page = page_text(read_json(folder / "results.json"))
        write_text(folder / "README.md", page)
    print(f"{page}\npage in {config.out / 'README.md'}")


if __name__ == "__main__":
    run(evaluate_checks, Checks, prog=COMMAND)
