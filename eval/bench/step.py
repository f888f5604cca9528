"""Time one filter step of the paper's size and the quasi-static model f_theta by parts.

python -m eval.bench.step --out runs/bench_step
python -m eval.bench.step --device cuda --out runs/bench_step_cuda

A filter step decodes M latents, simulates the N transitions in memory for each particle and
weighs them. f_theta is timed with and without gradients, and its QP alone. On the CPU these are CPU
seconds of all threads, so that a busy machine matters less; `wall_s` is what a clock showed.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from collections.abc import Callable

COMMAND = "python -m eval.bench.step"
TARGET = (5000, 0.15)
"""Particles, and the wall seconds that a step of memory 5 should stay below on 2 cores."""
FORMATS = {"cpu_s": ".4f", "wall_s": ".4f", "us_each": ".2f", "solved": ".2%"}


@dataclass(frozen=True)
class Benchmark:
    """What to time, at which size."""

    out: Path = Path("runs/bench_step")
    """Folder for results.json, figures and the TensorBoard log."""
    prior: str = "ycb21-z2"
    """Shape prior, by name or folder."""
    particles: int = 5000
    """Particles M of the filter."""
    memory: int = 5
    """Transitions N each particle explains."""
    curve_particles: tuple[int, ...] = (500, 1000, 2000, 5000, 10000, 20000)
    """Numbers of particles of the curve."""
    curve_points: tuple[int, ...] = (16, 32, 64, 128, 256)
    """Numbers of outline points of the curve."""
    repeats: int = 5
    """Each part is run this often; the fastest run counts."""
    threads: int = 2
    """Threads of torch and of the compiled loops."""
    device: str = "cpu"
    """Where the shape decodes (cpu or cuda); contact is solved on the CPU."""
    seed: int = 0
    """Seed of particles and commands."""
    quick: bool = False
    """Few particles, to see that everything works."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        """Refuse numbers that no benchmark can be made of."""
        names = ("particles", "memory", "repeats", "threads", "curve_particles", "curve_points")
        check_numbers(self, least=dict.fromkeys(names, 1))
        if not self.curve_particles or not self.curve_points:
            raise ValueError(
                "a curve is empty, expected at least one number of particles or points"
            )


def benchmark(config: Benchmark) -> None:
    """Print the seconds of each part of a filter step, and the curves."""
    import torch

    from tpcd.errors import SolverError
    from tpcd.results import run_folder

    torch.set_num_threads(config.threads)
    device = torch.device(config.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise SolverError(f"device is {config.device}, but no CUDA device is here; use cpu")
    with run_folder(config.out, COMMAND, config, config.overwrite) as folder:
        time_parts(config, folder)


def time_parts(config: Benchmark, folder: Path) -> None:
    """The benchmark in an opened run folder."""
    import torch
    from torch.utils.tensorboard import SummaryWriter

    from eval.bench.figures import part_seconds, step_seconds
    from eval.bench.filter_step import filter_step_parts, model_rows, outline_rows
    from tpcd.figures.sinks import save_figure
    from tpcd.results import format_table, write_results
    from tpcd.shape.checkpoint import load_prior

    device = torch.device(config.device)
    shape = load_prior(config.prior)
    particles = 200 if config.quick else config.particles
    sizes = (100, 200) if config.quick else config.curve_particles
    points = (16, 64) if config.quick else config.curve_points

    def timed(work: Callable[[], Any]) -> dict[str, float]:
        return fastest(work, 1 if config.quick else config.repeats, device.type == "cuda")

    step = filter_step_parts(shape, particles, config.memory, config.seed, device, timed)
    models = model_rows(shape, particles, config.memory, config.seed, device, timed)
    curve = []
    for size in sizes:
        parts = filter_step_parts(shape, size, config.memory, config.seed, device, timed)
        curve += [{**row, "curve": "particles"} for row in parts if row["part"] == "filter step"]
    outlines = outline_rows(particles, config.memory, points, config.seed, device, timed)
    table = [*step, *models, *curve, *outlines]
    columns = ("part", "particles", "transitions", "points", "cpu_s", "wall_s", "us_each", "solved")
    text = format_table(table, columns, FORMATS)
    print(text)
    figures = folder / "figures"
    with SummaryWriter(folder / "tensorboard") as writer:
        target = TARGET if config.memory == 5 else None
        save_figure(step_seconds(curve, target), figures, "step_seconds", writer)
        save_figure(part_seconds([*step, *models]), figures, "part_seconds", writer)
        for clock in ("wall_s", "cpu_s"):
            for row in curve:
                writer.add_scalar(f"filter_step_by_particles/{clock}", row[clock], row["particles"])
            for row in outlines:
                writer.add_scalar(f"f_theta_by_outline_points/{clock}", row[clock], row["points"])
        writer.add_text("table", f"```\n{text}\n```")
    path = write_results(folder, table, seeds=[config.seed])
    count, seconds = TARGET
    print(
        f"\nTarget: a filter step of M = {count}, N = 5 within {seconds} s on 2 cores. Wrote {path}"
    )


def fastest(work: Callable[[], Any], repeats: int, synchronise: bool) -> dict[str, float]:
    """CPU seconds of the process and wall seconds of the fastest of some runs after one more."""
    import torch

    best = {"cpu_s": float("inf"), "wall_s": float("inf")}
    for count in range(repeats + 1):
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        if synchronise:
            torch.cuda.synchronize()
        found = {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}
        if count > 0:
            best = {name: min(best[name], found[name]) for name in best}
    return best


if __name__ == "__main__":
    run(benchmark, Benchmark)
