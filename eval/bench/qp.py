"""Time and check the contact QP solver against others.

python -m eval.bench.qp --out runs/bench_qp

Problems are made like those of the simulator (contact_problems.py): mixed numbers of
contacts, so that most are padded, with duplicates and flat faces. All solvers run on the
same problems in one process; on the CPU the seconds are CPU seconds, so that a busy
machine matters less, and the ratio to qpth is taken within the run.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    import numpy as np

    from eval.bench.qp_solvers import Solver
    from tpcd.qp import ContactQP

QUICK_PROBLEMS = 200
FORMATS = {
    "seconds": ".4g",
    "times_qpth": ".1f",
    "error_n": ".1e",
    "solved": ".2%",
}
TAGS = {
    "seconds": "seconds_by_rows",
    "error_n": "largest_force_error_N_by_rows",
    "wrong": "wrong_answers_by_rows",
    "failed": "failed_by_rows",
}
"""Columns of the table that TensorBoard gets as scalars, with the number of rows as step."""


@dataclass(frozen=True)
class Benchmark:
    """What to time, on how many problems."""

    out: Path = Path("runs/bench_qp")
    """Folder for results.json, the figure and the TensorBoard log."""
    problems: int = 25_000
    """Problems of each size."""
    rows: tuple[int, ...] = (8, 16, 20)
    """Sizes: rows of a problem, two for each contact."""
    threads: int = 1
    """Threads of torch."""
    wrong_above: float = 1e-6
    """A claimed solution whose force is off by more than this counts as wrong [N]."""
    seed: int = 0
    """Seed of the problems."""
    quick: bool = False
    """Few problems, to see that everything works."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        """Refuse numbers that no benchmark can be made of."""
        check_numbers(self, least={"problems": 1, "threads": 1}, above={"wrong_above": 0.0})
        if not self.rows or any(rows < 2 or rows % 2 for rows in self.rows):
            raise ValueError(f"rows is {self.rows}, expected even numbers: two for each contact")


def benchmark(config: Benchmark) -> None:
    """Print seconds, force errors and failures of every contact QP solver that is installed."""
    import torch

    from tpcd.results import run_folder

    torch.set_num_threads(config.threads)
    with run_folder(config.out, "python -m eval.bench.qp", config, config.overwrite) as folder:
        compare_solvers(config, folder)
    print(f"\nwritten to {config.out}")


def compare_solvers(config: Benchmark, folder: Path) -> None:
    """The benchmark in an opened run folder."""
    from torch.utils.tensorboard import SummaryWriter

    from eval.bench.contact_problems import random_contact_problems
    from eval.bench.figures import solver_seconds
    from eval.bench.qp_solvers import available_solvers, reference_forces
    from tpcd.figures.sinks import save_figure
    from tpcd.results import format_table, write_results

    count = min(config.problems, QUICK_PROBLEMS) if config.quick else config.problems
    table: list[dict[str, Any]] = []
    sources = set()
    for rows in config.rows:
        problem = random_contact_problems(count, rows, config.seed)
        forces, source = reference_forces(problem)
        sources.add(source)
        for solver in available_solvers():
            _show_progress(f"{rows} rows: {solver.name}")
            table.append({"rows": rows, **measure(solver, problem, forces, config)})
    if len(config.rows) > 1:
        table += totals(table)
    _add_ratios(table)
    _show_progress("")
    print(format_table(table, formats=FORMATS))
    note = (
        f"{count} problems of each size. seconds: CPU seconds for all of them (scaled up "
        f"where fewer were solved); times_qpth: how many times faster than "
        f"qpth ('qpth plain' is one call of the package, which gives up early); error_n: "
        f"largest force error of what is claimed to be solved [N], against "
        f"{', '.join(sorted(sources))}; wrong: claimed solutions off by more than "
        f"{config.wrong_above:g} N; failed: not solved."
    )
    print("\n" + note)
    write_results(folder, table, seeds=[config.seed], note=note)
    with SummaryWriter(folder / "tensorboard") as writer:
        figure = solver_seconds(table, count, "CPU")
        save_figure(figure, folder / "figures", "solver_seconds", writer)
        for line in table:
            for quantity, group in TAGS.items():
                if line[quantity] is not None and line["rows"] != "all":
                    writer.add_scalar(f"{group}/{line['solver']}", line[quantity], line["rows"])
        writer.add_text("table", "```\n" + format_table(table, formats=FORMATS) + "\n```")
        writer.add_text("note", note)


def _show_progress(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r{text:<40}\r{text}", end="", file=sys.stderr, flush=True)


def measure(
    solver: Solver, problem: ContactQP, forces: np.ndarray, config: Benchmark
) -> dict[str, Any]:
    """One line of the table: how long a solver takes and how right it is."""
    import numpy as np

    count = len(forces)
    used = max(1, round(solver.share * count))
    given = _part(problem, slice(0, used))
    solver.run(_part(problem, slice(0, 2)))  # imports and compilation
    seconds, answer = float("inf"), None
    for _ in range(solver.repeats):
        start = time.process_time()
        answer = solver.run(given)
        seconds = min(seconds, time.process_time() - start)
    assert answer is not None
    motions, solved = answer
    hessian = problem.hessian.expand(count, *problem.hessian.shape[-2:])[:used].numpy()
    found = np.einsum("bij,bj->bi", hessian, motions - problem.target[:used].numpy())
    error = np.abs(found - forces[:used]).max(-1)
    error = np.where(np.isnan(error), np.inf, error)[solved]
    return {
        "solver": solver.name,
        "problems": used,
        "seconds": seconds * count / used,
        "times_qpth": None,
        "error_n": float(error.max()) if len(error) else None,
        "wrong": int((error > config.wrong_above).sum()),
        "failed": int((~solved).sum()),
        "solved": float(solved.mean()),
    }


def totals(table: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A line for each solver over all sizes."""
    lines = []
    for solver in dict.fromkeys(line["solver"] for line in table):
        own = [line for line in table if line["solver"] == solver]
        count = sum(line["problems"] for line in own)
        errors = [line["error_n"] for line in own if line["error_n"] is not None]
        lines.append(
            {
                "rows": "all",
                "solver": solver,
                "problems": count,
                "seconds": sum(line["seconds"] for line in own),
                "times_qpth": None,
                "error_n": max(errors, default=None),
                "wrong": sum(line["wrong"] for line in own),
                "failed": sum(line["failed"] for line in own),
                "solved": 1 - sum(line["failed"] for line in own) / count,
            }
        )
    return lines


def _add_ratios(table: list[dict[str, Any]]) -> None:
    base = {line["rows"]: line["seconds"] for line in table if line["solver"] == "qpth"}
    for line in table:
        if line["rows"] in base:
            line["times_qpth"] = base[line["rows"]] / line["seconds"]


def _part(problem: ContactQP, part: slice) -> ContactQP:
    """Some of the problems."""
    from tpcd.qp import ContactQP

    mask = problem.row_mask
    return ContactQP(
        hessian=problem.hessian,
        target=problem.target[part],
        rows=problem.rows[part],
        offsets=problem.offsets[part],
        row_mask=None if mask is None else mask[part],
    )


if __name__ == "__main__":
    run(benchmark, Benchmark)
