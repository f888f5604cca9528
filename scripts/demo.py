"""The main job from end to end: an unknown object, 15 chosen touches, and predictions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from tpcd.data.episode import Episode


@dataclass(frozen=True)
class Demo:
    """Settings of the demonstration."""

    out: Path = Path("runs/demo")
    """Folder for the results; an earlier demo there is replaced."""
    outline: str = "mug"
    """Built-in outline that plays the unknown object."""
    prior: str = "ycb-rich"
    """Shape prior of the estimator; it was trained on other objects."""
    steps: int = 15
    """Exploration steps."""
    tests: int = 3
    """Held-out trajectories."""
    test_steps: int = 30
    """Steps of a held-out trajectory."""
    seed: int = 0
    """Seed of scene, motion, noise and sampler."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"steps": 1, "tests": 1, "test_steps": 1})


def demonstrate(config: Demo) -> None:
    """Explore an unknown object in simulation, learn its contacts, and test the predictions."""
    print("loading ...", flush=True)
    import torch

    from tpcd.results import run_folder

    # Small tensor operations are fastest on one thread; the compiled loops have their own.
    torch.set_num_threads(1)
    with run_folder(config.out, "scripts/demo.py", config, overwrite=True) as folder:
        explore_and_test(config, folder)


def explore_and_test(config: Demo, folder: Path) -> None:
    """The demonstration in an opened run folder."""
    import importlib.util
    import time

    import torch
    from torch.utils.tensorboard import SummaryWriter

    from tpcd.commands.drawing import KnownTruth
    from tpcd.commands.exploration_run import Stopping, run_exploration
    from tpcd.commands.exploring import EPISODE_NAME
    from tpcd.commands.prediction import (
        PredictedRows,
        in_contact,
        measured_rows,
        predict_rows,
        score_rows,
        write_prediction,
    )
    from tpcd.exploration import Estimator, explore
    from tpcd.figures.predictions import prediction as prediction_figure
    from tpcd.figures.quality import calibration
    from tpcd.figures.sinks import save_figure
    from tpcd.policies import ActivePolicy, Limits
    from tpcd.predict import ContactPredictor
    from tpcd.prediction import CHANNELS
    from tpcd.results import format_table, write_results
    from tpcd.robot.simulated import SimulatedRobot
    from tpcd.shape.builtin import builtin_outlines
    from tpcd.shape.checkpoint import load_prior
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import make_motion, record, write_recording
    from tpcd.truth.scene import draw_scene

    outlines = builtin_outlines()
    if config.outline not in outlines:
        raise ValueError(
            f"outline is {config.outline!r}, expected one of {', '.join(sorted(outlines))}"
        )
    kind = "mujoco" if importlib.util.find_spec("mujoco") else "quasistatic"
    generator = torch.Generator().manual_seed(config.seed)
    scene = draw_scene(config.outline, outlines[config.outline].vertices, generator)
    truth = make_truth(scene, kind)
    shape = load_prior(config.prior)
    print(
        f"unknown object: {config.outline}; simulator of the truth: {kind}; prior: {config.prior}"
    )

    robot = SimulatedRobot(truth, scene, config.seed)

    def save(episode: Episode) -> None:
        path = folder / EPISODE_NAME
        write_recording(robot.recording(episode), scene, path, overwrite=True)

    started = time.perf_counter()
    estimator = Estimator(shape)
    steps = explore(robot, ActivePolicy(Limits()), estimator, config.seed, on_row=save)
    belief, *_ = run_exploration(
        steps,
        Stopping(config.steps),
        config.prior,
        folder,
        truth=KnownTruth(scene.vertices_ee, scene.theta),
        closing=estimator.closing,
    )
    seconds = (time.perf_counter() - started) / config.steps

    predictor = ContactPredictor(belief)
    predicted, true_rows, touching = [], [], []
    with SummaryWriter(folder / "tensorboard") as writer:
        for number in range(config.tests):
            motion = make_motion("test", scene, config.test_steps, generator)
            test = record(truth, scene, motion, config.test_steps, generator)
            write_recording(test, scene, folder / f"test_{number}")
            rows = predict_rows(predictor, test.measured, of="true", reference=test.true)
            predicted.append(rows)
            true_rows.append(measured_rows(test.true)[1:])
            touching.append(in_contact(test.true))
            figure = prediction_figure(
                true_rows[-1].numpy(),
                rows.mean.numpy(),
                rows.low.numpy(),
                rows.high.numpy(),
                f"held-out trajectory {number}, predicted one step ahead",
                rows_are="true",
            )
            save_figure(figure, folder / "figures", f"test_{number}", writer)
        everything = PredictedRows(
            *(torch.cat([getattr(p, name) for p in predicted]) for name in vars(predicted[0]))
        )
        transform = everything.transform[torch.cat(touching)]
        if len(transform):
            figure = calibration(transform.numpy(), CHANNELS, "rows in contact")
            save_figure(figure, folder / "figures", "calibration", writer)
        table = score_rows(everything, torch.cat(true_rows))
        text = format_table(table)
        writer.add_text("table", f"```\n{text}\n```")
    write_prediction(predicted, folder / "predictions.csv")
    write_results(folder, table, seeds=[config.seed], seconds_per_step=seconds)
    print(f"\nerror against the truth on {config.tests} x {config.test_steps} held-out steps:")
    print(text)
    print(f"choosing moves, making them and learning from them took {seconds:.2f} s per step")
    print(
        f"\nresults in {folder}; figures in {folder / 'figures'}\n"
        f"next:  tensorboard --logdir {folder}\n"
        f"       python scripts/explore.py --help      explore other objects\n"
        f"       python scripts/estimate.py --help     estimate from your own episode"
    )


if __name__ == "__main__":
    run(demonstrate, Demo)
