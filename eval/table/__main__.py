"""The paper's experiment, with truths that the estimator does not share.

11 YCB objects that no prior has seen, policies, seeds and three truths: for each cell theta is
drawn from the priors, a policy explores for 15 moves, and three test trajectories of 30 steps
are predicted one step ahead from noisy measured poses. Errors and coverage are against the
noise-free truth. `decoded` is the project's own simulator with the outline that the prior
itself fits to the object, `quasistatic` the same with the true outline, `mujoco` MuJoCo with
the true outline; sensors are noisy in all of them.

Each cell is independent of how many processes share the work, and one line of a
`cells-*.jsonl`, so that a stopped run goes on where it was.

python -m eval.table --workers 4 --out runs/table
PYTHONPATH=. fabric run --accelerator cpu --devices 4 --num-nodes 2 --node-rank 0 \
    --main-address HOST eval/table/__main__.py --out SHARED/table    # and node-rank 1 elsewhere
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from eval.lines import append_lines, read_lines, write_line
from eval.opened import shared_run
from eval.unseen import UNSEEN
from tpcd.cli import check_numbers, run
from tpcd.errors import FileError

ROWS = (
    "paper/random",
    "paper/grid",
    "paper/expert",
    "default/random",
    "default/grid",
    "default/active",
    "default/expert",
)
OTHERS = (
    "default / random",
    "default / grid",
    "default / expert",
    "default / lookahead",
    "paper / grid",
)
"""What our active policy is compared with, cell by cell."""
QUICK_ROWS = ("paper/random", "default/random", "default/active")
KEY = ("truth", "object", "seed", "estimator", "policy")
"""What tells cells apart."""
TRUTHS = ("mujoco", "quasistatic", "decoded")
PAPER_NOTE = (
    "The paper reports 5.9-7.7 mm, 2.7-3.7 N and 0.21 N·m. Its forces and poses do not fit its "
    "stated stiffness: at K = 100 N/m an error of 7 mm is 0.7 N, not 3.7 N. Compare poses, and "
    "forces relative to the peak force."
)


@dataclass(frozen=True)
class Table:
    """Settings of the experiment."""

    out: Path = Path("runs/table")
    """Folder for the results; a stopped run in it goes on with --resume."""
    truths: tuple[str, ...] = TRUTHS
    """Truths: mujoco, quasistatic, decoded."""
    objects: tuple[str, ...] = ()
    """YCB objects; none named means the 11 that no prior was trained on."""
    rows: tuple[str, ...] = ROWS
    """Estimator and policy of each row: paper or default / random, grid, expert, active,
    lookahead, rich."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of scene, noise, motion and sampler."""
    steps: int = 15
    """Exploration moves; with 30 the curve of errors goes on to 30."""
    tests: int = 3
    """Test trajectories."""
    test_steps: int = 30
    """Steps of a test trajectory."""
    prior: str = "ycb-rich-holdout"
    """Shape prior of our estimator."""
    paper_prior: str = "ycb21-z2"
    """Shape prior of the paper's filter, which needs a uniform latent of two dimensions."""
    workers: int = 1
    """Processes that share the work on this machine."""
    quick: bool = False
    """Two objects, one truth, three rows and short motions, for a smoke run."""
    resume: bool = False
    """Go on with the cells that an earlier run in the folder did not finish."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        check_numbers(self, least=dict.fromkeys(("steps", "tests", "test_steps", "workers"), 1))
        if not self.seeds or not self.rows or not self.truths:
            raise ValueError("seeds, rows or truths are empty, expected at least one of each")
        for truth in self.truths:
            if truth not in TRUTHS:
                raise ValueError(f"truth is {truth!r}, expected one of {', '.join(TRUTHS)}")
        from tpcd.policies.named import PolicyName

        for row in self.rows:
            estimator, _, policy = row.partition("/")
            if estimator not in ("paper", "default") or policy not in get_args(PolicyName):
                raise ValueError(f"row is {row!r}, expected for example 'default/active'")


def make_table(config: Table) -> None:
    """Run the cells that are missing, in as many processes as asked, and print the table."""
    import torch

    from eval.objects import main_outlines

    torch.set_num_threads(1)
    main_outlines(config.objects)
    # More cells may be asked of an earlier run; what is in a cell must stay the same.
    free = ("out", "workers", "truths", "objects", "rows", "seeds")
    with shared_run(config, "python -m eval.table", free):
        _run_shared(config)


def _run_shared(config: Table) -> None:
    """The cells of this process and, for the first one, the table of all."""
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
    fabric.barrier()
    folder = config.out
    _run_missing(config, folder, fabric.global_rank, fabric.world_size)
    fabric.barrier()
    if fabric.global_rank == 0:
        _report(config, folder)


def plan(config: Table) -> list[Any]:
    """All cells, those of one scene one after another."""
    from eval.table.cells import Cell

    objects = config.objects or (UNSEEN[3:5] if config.quick else UNSEEN)
    truths = ("quasistatic",) if config.quick else config.truths
    rows = QUICK_ROWS if config.quick else config.rows
    seeds = config.seeds[:1] if config.quick else config.seeds
    return [
        Cell(truth, name, seed, *row.split("/"))
        for truth in truths
        for seed in seeds
        for name in objects
        for row in rows
    ]


def _run_missing(config: Table, folder: Path, rank: int, world: int) -> None:
    """This process's share of the cells."""
    from torch.utils.tensorboard import SummaryWriter
    from tqdm import tqdm

    from eval.table.cells import run_cell
    from eval.table.pages import draw_cell
    from tpcd.shape.ycb import load_ycb

    cells = plan(config)
    scenes = list(dict.fromkeys(cell.key[:3] for cell in cells))
    mine = set(scenes[rank::world])
    done = {tuple(row[name] for name in KEY) for row in read_cells(folder)}
    todo = [cell for cell in cells if cell.key[:3] in mine and cell.key not in done]
    outlines = load_ycb("main")
    size = (config.steps, config.tests, config.test_steps)
    steps, tests, length = (4, 1, 8) if config.quick else size
    path = folder / f"cells-{rank}.jsonl"
    with (
        append_lines(path) as lines,
        SummaryWriter(folder / "tensorboard" / f"objects-{rank}") as writer,
    ):
        for cell in tqdm(todo, unit="cell", disable=rank > 0):
            prior = config.paper_prior if cell.estimator == "paper" else config.prior
            try:
                outcome = run_cell(
                    cell, outlines[cell.object].vertices, prior, steps, tests, length
                )
            except ValueError as error:  # one cell must not cost the others
                write_line(lines, {**vars(cell), "failed": str(error)})
                continue
            write_line(lines, outcome.row)
            if cell.seed == config.seeds[0] and cell.policy in ("active", "grid"):
                draw_cell(outcome, cell, folder / "figures", writer)


def read_cells(folder: Path) -> list[dict[str, Any]]:
    """Finished cells of all processes; failed ones, and a line that was cut off when a run was
    stopped, are left out and tried again when it goes on."""
    cells = {}
    for path in sorted(folder.glob("cells-*.jsonl")):
        for row in read_lines(path):
            if "failed" not in row:
                if "open_mae" not in row:
                    raise FileError(path, "has cells of an earlier version", "start a new folder")
                cells[tuple(row[name] for name in KEY)] = row
    return list(cells.values())


def _report(config: Table, folder: Path) -> None:
    from torch.utils.tensorboard import SummaryWriter

    from eval.table.pages import draw_summary
    from eval.table.summary import compare, curve_rows, printed, summarise
    from tpcd.results import format_table, write_results

    keys = {cell.key for cell in plan(config)}
    cells = [row for row in read_cells(folder) if tuple(row[name] for name in KEY) in keys]
    failed = sorted(keys - {tuple(row[name] for name in KEY) for row in cells})
    if not cells:
        raise ValueError(f"all {len(failed)} cells failed; see the lines of {folder}/cells-*.jsonl")
    table = summarise(cells)
    pairs = [line for other in OTHERS for line in compare(cells, "default / active", other)]
    text = format_table([printed(row) for row in table])
    paired = format_table(pairs, formats=dict.fromkeys(("x, z", "F", "tau"), ".2f"))
    curves = curve_rows(cells)
    learnt = format_table(curves, formats={m: ".3g" for row in curves for m in row if m.isdigit()})
    text += f"\n\nerror of x and z [mm] after so many moves, without the closing draws:\n{learnt}"
    print(f"{text}\n\nratios of mean errors, with 90 % intervals:\n{paired}\n\n{PAPER_NOTE}")
    with SummaryWriter(folder / "tensorboard" / "table") as writer:
        writer.add_text("table", f"```\n{text}\n\n{paired}\n```\n\n{PAPER_NOTE}")
        draw_summary(cells, folder / "figures", writer)
    write_results(folder, table, seeds=config.seeds, comparisons=pairs, curves=curves,
                  note=PAPER_NOTE, cells=len(cells), failed=failed)  # fmt: skip
    for cell in failed:
        print(f"failed: {', '.join(map(str, cell))}", file=sys.stderr)
    print(f"results in {folder}")


if __name__ == "__main__":
    run(make_table, Table, prog="python -m eval.table")
