"""The paper's physical experiment, through an emulated controller instead of an arm.

An object in the hand, an expert's trajectory of 15 moves, and a testing trajectory, on tiles that
yield 1 to 3 mm at 10 N; friction U[0.5, 1.6], wall U[-0.90, -0.80] m along x of the base (arXiv
2409.17470, section V-B). The real ur_rtde client drives the emulator of tpcd.robot, so this is the
whole chain but for the arm: it is emulated and not measured on a robot, and the table says so. The
gap workflow (scripts/diagnose.py) looks at a third recording, which excites what may be missing.

python -m eval.physical --out runs/physical
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eval.opened import opened_run
from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from tpcd.belief import Belief
    from tpcd.data.episode import Episode
    from tpcd.effects.model import Model

PAPER: dict[str, Any] = {
    "object": "paper, Real",
    "estimator": "paper",
    "F_x_N": 0.49,
    "F_z_N": 0.21,
    "x_mm": 5.9,
    "z_mm": 1.9,
}
"""The row `Real` of the paper's table, as it prints it."""
COVARIANCE = (20.0, 20.0, 0.5, 0.1, 0.1, 0.1)
"""R of the paper's filter on the robot."""


@dataclass(frozen=True)
class Physical:
    """Settings of the experiment."""

    out: Path = Path("runs/physical")
    """Folder for episodes, diagnoses and the table."""
    objects: tuple[str, ...] = ("006_mustard_bottle", "025_mug", "014_lemon")
    """Objects, by their YCB names."""
    tiles: tuple[float, ...] = (2.0, 1.0, 3.0)
    """Yield of the tiles for each object [mm per 10 N]."""
    steps: int = 15
    """Moves of the expert."""
    test_steps: int = 30
    """Moves of the testing trajectory."""
    diagnosis_steps: int = 60
    """Moves of the recording that the gap workflow looks at; 0 leaves it out."""
    prior: str = "ycb-rich"
    """Shape prior of ours; the paper's filter has ycb21-z2."""
    address: str = "127.0.7.1"
    """Loopback address of the emulator."""
    seed: int = 0
    """Seed of scenes, noise and motions."""
    resume: bool = False
    """Keep what an earlier run in the folder has recorded."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"steps": 1, "test_steps": 1, "diagnosis_steps": 0})
        if len(self.tiles) != len(self.objects):
            raise ValueError(
                f"tiles has {len(self.tiles)} numbers, expected one for each of the"
                f" {len(self.objects)} objects"
            )


def evaluate_physical(config: Physical) -> None:
    """Run the paper's physical protocol through the emulator and print its table."""
    import torch

    from eval.physical_sessions import recorded
    from tpcd.results import format_table, write_results

    torch.set_num_threads(1)
    with opened_run(config, "python -m eval.physical", ("out",)) as folder:
        rows: list[dict[str, Any]] = [PAPER]
        for index, name in enumerate(config.objects):
            episodes = recorded(config, index, folder / name)
            rows += _rows(config, config.tiles[index], name, episodes, folder / name)
            print(format_table(rows), flush=True)
        ours = dict.fromkeys(row["estimator"] for row in rows[1:])
        for estimator in ours:
            rows.append(
                _mean(estimator, [row for row in rows[1:] if row["estimator"] == estimator])
            )
        print(format_table(rows[-len(ours) :]))
        log_errors(rows, folder)
        write_results(folder, rows, seeds=[config.seed], kind="emulated, not measured on a robot")


def log_errors(rows: Sequence[dict[str, Any]], folder: Path) -> None:
    """The table for TensorBoard, and its errors as a figure."""
    from torch.utils.tensorboard import SummaryWriter

    from tpcd.figures.quality import error_bars
    from tpcd.figures.sinks import save_figure
    from tpcd.results import format_table

    labels = {"x_mm": "error of x [mm]", "z_mm": "error of z [mm]", "F_x_N": "error of F_x [N]"}
    with SummaryWriter(folder / "tensorboard") as writer:
        figure = error_bars(rows, labels, group="estimator")
        save_figure(figure, folder / "figures", "errors", writer)
        for row in rows:
            for key, value in row.items():
                if isinstance(value, float) and key != "tiles":
                    writer.add_scalar(f"{key}/{row['estimator']}/{row['object']}", value)
        writer.add_text("table", f"```\n{format_table(rows)}\n```")


def _rows(
    config: Physical, tiles: float, name: str, recorded: dict[str, Episode], folder: Path
) -> list[dict[str, Any]]:
    """A row of the table for each estimator: mean errors of the test's next poses and wrenches."""
    from tpcd.belief import EstimatorSettings
    from tpcd.belief.paper import PaperSettings
    from tpcd.exploration import Estimator
    from tpcd.random import stream
    from tpcd.shape.checkpoint import load_prior

    expert, test = recorded["expert"], recorded["test"]
    paper = Estimator(
        load_prior("ycb21-z2"), "paper", paper=PaperSettings(covariance=COVARIANCE)
    ).learn(expert, stream(config.seed, 7))
    shape = load_prior(config.prior)
    ours = Estimator(shape).learn(expert, stream(config.seed, 8))
    rows = [
        _row(name, tiles, "paper's filter", paper.belief, test),
        _row(name, tiles, "ours, rigid tiles", ours.belief, test),
    ]
    model, found = _found(config, recorded, folder)
    if model is not None and model.effects:
        settings = EstimatorSettings(step=model.step, effects=model.informed, shape=model.shape)
        added = Estimator(shape, settings=settings).learn(expert, stream(config.seed, 8))
        row = _row(name, tiles, "ours, gap found", added.belief, test)
        rows.append({**row, "found": found})
    elif found:
        rows[-1]["found"] = found
    return rows


def _found(
    config: Physical, recorded: dict[str, Episode], folder: Path
) -> tuple[Model | None, str | None]:
    """What the gap workflow adds to the model, and how it says so."""
    import json
    import subprocess
    import sys

    from tpcd.effects.model import load_model

    if "diagnosis" not in recorded:
        return None, None
    out = folder / "diagnosis"
    if not (out / "verdict.json").is_file():
        arguments = [str(folder / "diagnosis.csv"), "--fresh", str(folder / "test.csv")]
        script = Path(__file__).parents[1] / "scripts" / "diagnose.py"
        subprocess.run(
            [sys.executable, str(script), *arguments, "--prior", config.prior]
            + ["--out", str(out), "--seed", str(config.seed), "--overwrite"],
            check=False,
        )
    if not (out / "verdict.json").is_file():
        return None, "the diagnosis failed"
    verdict = json.loads((out / "verdict.json").read_text(encoding="utf-8"))
    path = out / "model.yaml"
    return (load_model(path) if path.is_file() else None), verdict["verdict"]


def _row(name: str, tiles: float, estimator: str, belief: Belief, test: Episode) -> dict[str, Any]:
    from tpcd.commands.prediction import measured_rows, one_step, prediction_error
    from tpcd.predict import ContactPredictor

    predicted = one_step(ContactPredictor(belief), test, "measured")
    rows = measured_rows(test)[1:]
    x, z, angle, force_x, force_z, torque = (
        prediction_error(rows, predicted.mean).abs().mean(0).tolist()
    )
    return {
        "object": f"{name}, emulated",
        "tiles": tiles,
        "estimator": estimator,
        "F_x_N": force_x,
        "F_z_N": force_z,
        "tau_Nm": torque,
        "x_mm": 1e3 * x,
        "z_mm": 1e3 * z,
        "phi_mrad": 1e3 * angle,
    }


def _mean(estimator: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    numbers = ("F_x_N", "F_z_N", "tau_Nm", "x_mm", "z_mm", "phi_mrad")
    means = {key: sum(row[key] for row in rows) / len(rows) for key in numbers}
    return {"object": f"MEAN of {len(rows)}, emulated", "estimator": estimator, **means}


if __name__ == "__main__":
    run(evaluate_physical, Physical)
