"""Learn an object by touch and predict its next contacts, on outlines the prior never saw.

For every object and prior: a scene is drawn from the priors of theta, 15 exploration steps
are simulated by MuJoCo with the real outline and sensor noise, theta is estimated, and three
test trajectories of 30 steps are predicted one step ahead from noisy measured poses. Errors
and coverage are against the noise-free truth. Half of the objects are in the training set
of both priors (`ycb21-z2` and `ycb-rich-holdout`), half in neither. The scene of an object
depends on the seed alone. One line of `cells.jsonl` is kept for each cell, so a stopped run
goes on where it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.lines import append_lines, read_lines, write_line
from eval.opened import opened_run
from tpcd.cli import check_numbers, run

SEEN = (
    "003_cracker_box",
    "004_sugar_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "008_pudding_box",
    "010_potted_meat_can",
    "011_banana",
    "019_pitcher_base",
    "025_mug",
    "035_power_drill",
    "061_foam_brick",
)
UNSEEN = (
    "001_chips_can",
    "012_strawberry",
    "013_apple",
    "014_lemon",
    "016_pear",
    "026_sponge",
    "043_phillips_screwdriver",
    "048_hammer",
    "054_softball",
    "065-f_cups",
    "077_rubiks_cube",
)
QUICK = ("006_mustard_bottle", "014_lemon")
TARGETS = {"x_mm": 0.8, "z_mm": 0.8, "F_x_N": 0.08, "F_z_N": 0.08, "tau_Nm": 0.06}


@dataclass(frozen=True)
class Unseen:
    """Settings of the evaluation."""

    out: Path = Path("runs/unseen")
    """Folder for the results; a stopped run in it goes on with --resume."""
    priors: tuple[str, ...] = ("ycb21-z2", "ycb-rich-holdout")
    """Shape priors to compare: folders or shipped names."""
    objects: tuple[str, ...] = ()
    """YCB objects; none named means all 22."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of scene, noise and motion."""
    steps: int = 15
    """Exploration steps."""
    test_steps: int = 30
    """Steps of a test trajectory."""
    tests: int = 3
    """Test trajectories."""
    policy: str = "rich"
    """Exploration motion: rich or press_and_slide."""
    estimator: str = "default"
    """Estimator: default or paper."""
    particles: int = 700
    """Particles of the belief."""
    misfit: float | None = None
    """Median of the outline error's standard deviation [m]; by default the prior's own figure."""
    truth: str = "mujoco"
    """Source of truth: mujoco or quasistatic."""
    quick: bool = False
    """Two objects and one prior, for a smoke run."""
    resume: bool = False
    """Go on with the cells that an earlier run in the folder did not finish."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        counts = ("steps", "test_steps", "tests", "particles")
        check_numbers(self, least=dict.fromkeys(counts, 1), above={"misfit": 0})


def evaluate_unseen(config: Unseen) -> None:
    """Estimate and predict on YCB outlines, half of them unseen, with MuJoCo as truth."""
    import torch
    from torch.utils.tensorboard import SummaryWriter
    from tqdm import tqdm

    from eval.objects import main_outlines
    from tpcd.figures.quality import calibration, error_bars
    from tpcd.figures.sinks import save_figure
    from tpcd.prediction import CHANNELS
    from tpcd.results import format_table, write_results
    from tpcd.shape.checkpoint import find_prior, load_prior

    # Small tensor operations are fastest on one thread; the compiled loops have their own.
    torch.set_num_threads(1)
    outlines = main_outlines(config.objects)
    names = config.objects or (QUICK if config.quick else (*SEEN, *UNSEEN))
    given = config.priors[:1] if config.quick else config.priors
    # By the names of their folders, which name figures too.
    priors = {find_prior(prior).resolve().name: prior for prior in given}
    if len(priors) < len(given):
        raise ValueError(f"priors are {', '.join(given)}, expected priors of different names")
    with opened_run(config, "python -m eval.unseen", ("out",)) as folder:
        path = folder / "cells.jsonl"
        cells = read_lines(path)
        plan = [(n, p, s) for s in config.seeds for n in names for p in priors]
        done = {(c["object"], c["prior"], c["seed"]) for c in cells}
        with append_lines(path) as lines:
            for name, prior, seed in tqdm(plan, unit="cell", initial=0):
                if (name, prior, seed) in done:
                    continue
                shape = load_prior(priors[prior])
                cell = _cell(config, name, outlines[name].vertices, prior, shape, seed)
                write_line(lines, cell)
                cells.append(cell)
        columns = [key for key in cells[0] if key not in ("contact_transform", "theta_score")]
        table = [{key: cell[key] for key in columns} for cell in cells]
        means = _means(table, list(priors))
        print(format_table([*table, *means]))
        transforms = {
            p: [row for c in cells if c["prior"] == p for row in c["contact_transform"]]
            for p in priors
        }
        with SummaryWriter(folder / "tensorboard") as writer:
            for prior, rows in transforms.items():
                figure = calibration(_array(rows), CHANNELS, "rows in contact")
                save_figure(figure, folder / "figures", f"calibration-{prior}", writer)
            labels = {
                "x_mm": "error of x [mm]",
                "z_mm": "error of z [mm]",
                "F_z_N": "error of F_z [N]",
            }
            figure = error_bars(table, labels, group="prior", targets=TARGETS)
            save_figure(figure, folder / "figures", "errors", writer)
            for row in means:
                for key, value in row.items():
                    if isinstance(value, float):
                        label = f"{key}/{row['prior']}/{row['object'].removeprefix('MEAN ')}"
                        writer.add_scalar(label, value)
            writer.add_text("table", "```\n" + format_table([*table, *means]) + "\n```")
        write_results(folder, [*table, *means], seeds=config.seeds, targets=TARGETS)
        print(f"results in {folder}")


def _cell(
    config: Unseen, name: str, vertices: Any, prior: str, shape: Any, seed: int
) -> dict[str, Any]:
    """One object and prior: explore, estimate, predict; returns its row of the table."""
    import time
    import zlib

    import torch

    from eval.scoring import score_tests
    from tpcd.belief import EstimatorSettings, SamplerSettings
    from tpcd.exploration import Estimator
    from tpcd.predict import ContactPredictor
    from tpcd.prediction import CHANNELS
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import make_motion, record
    from tpcd.truth.scene import draw_scene

    generator = torch.Generator().manual_seed(1000 * seed + zlib.crc32(name.encode()) % 1000)
    scene = draw_scene(name, vertices, generator)
    truth = make_truth(scene, config.truth)  # type: ignore[arg-type]

    def recorded(policy: str, steps: int):
        motion = make_motion(policy, scene, steps, generator)  # type: ignore[arg-type]
        return record(truth, scene, motion, steps, generator)

    exploration = recorded(config.policy, config.steps)
    tests = [recorded("test", config.test_steps) for _ in range(config.tests)]
    started = time.perf_counter()
    sampler = torch.Generator().manual_seed(seed)
    settings = EstimatorSettings(
        sampler=SamplerSettings(particles=config.particles), misfit_sd=config.misfit
    )
    estimator = Estimator(shape, config.estimator, settings)  # type: ignore[arg-type]
    *_, last = estimator.steps(exploration.measured, sampler)
    seconds = time.perf_counter() - started
    closing = estimator.closing
    closed = last if closing is None else closing(exploration.measured, last.state)
    belief = closed.belief
    error, transform, touching = score_tests(ContactPredictor(belief), tests)
    inside = ((transform > 0.05) & (transform < 0.95)).double()
    truth_vector = torch.tensor(list(scene.theta.values()), dtype=torch.float64)
    z = belief.prior.shape.latent_dim
    score = (belief.mean()[z:] - truth_vector) / belief.std()[z:]
    row: dict[str, Any] = {
        "object": name,
        "prior": prior,
        "seen": name in SEEN,
        "seed": seed,
    }
    units = ("mm", "mm", "mrad", "N", "N", "Nm")
    factors = (1e3, 1e3, 1e3, 1.0, 1.0, 1.0)
    for i, (channel, unit, factor) in enumerate(zip(CHANNELS, units, factors, strict=True)):
        row[f"{channel}_{unit}"] = float(error[:, i].mean()) * factor
    row["worst_mm"] = float(error[:, :2].max()) * 1e3
    row["coverage_90"] = float(inside.mean())
    row["coverage_contact"] = float(inside[touching].mean())
    row["s_per_step"] = seconds / config.steps
    row["s_closing"] = 0.0 if closing is None else closed.seconds
    row["ess"] = closed.info.effective_sample_size
    row["contact_transform"] = transform[touching].tolist()
    row["theta_score"] = score.tolist()
    return row


def _means(table: list[dict[str, Any]], priors: list[str]) -> list[dict[str, Any]]:
    """Means over objects for each prior, seen and unseen apart and together."""
    means = []
    for prior in priors:
        for label, wanted in (("seen", (True,)), ("unseen", (False,)), ("all", (True, False))):
            rows = [r for r in table if r["prior"] == prior and r["seen"] in wanted]
            if not rows:
                continue
            mean: dict[str, Any] = {"object": f"MEAN {label}", "prior": prior}
            for key, value in rows[0].items():
                if isinstance(value, float):
                    mean[key] = sum(row[key] for row in rows) / len(rows)
            means.append(mean)
    return means


def _array(rows: list[list[float]]) -> Any:
    import numpy as np

    return np.array(rows)


if __name__ == "__main__":
    run(evaluate_unseen, Unseen, prog="python -m eval.unseen")
