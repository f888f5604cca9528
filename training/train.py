"""Train a shape prior and export it: `python -m training.train --config FILE.yaml`.

Writes a run folder (Lightning checkpoints for resuming, TensorBoard, the resolved
configuration) and, at the end, the released prior: safetensors and a JSON card.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path

from tpcd.cli import check_resume, run
from tpcd.errors import RunError
from tpcd.files import read_json
from tpcd.ownership import owned
from tpcd.records import read_entries
from tpcd.results import CONFIG_FILE, RESTORE, resumed_run, run_folder, write_results
from tpcd.targets import check_folder
from training.config import TrainingConfig


@dataclass(frozen=True)
class Training(TrainingConfig):
    """One prior, and where it goes."""

    name: str = "prior"
    """Name of the prior and of its checkpoint folder."""
    unseen_from: str = ""
    """Prior of the same recipe with objects left out, whose unseen errors the card quotes."""
    out: Path | None = None
    """Run folder; by default runs/NAME."""
    export: Path | None = None
    """Checkpoint folder of the finished prior; by default OUT/NAME."""
    resume: bool = False
    """Go on from the last checkpoint in the run folder."""
    overwrite: bool = False
    """Replace an earlier run in the folder, and an earlier prior in that of the export."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_resume(self)


def train_prior(config: Training) -> None:
    """Train a shape prior, measure it and write it with its card."""
    # torch and Lightning take seconds to import; --help should not wait for them.
    from tpcd.shape.checkpoint import CARD
    from training.fitting import check_steps
    from training.kept import CHECKPOINT, read_kept
    from training.run import train

    settings = {field.name: getattr(config, field.name) for field in fields(TrainingConfig)}
    out = config.out or Path("runs") / config.name
    export = config.export or out / config.name
    again = config.overwrite or config.resume or config.export is None
    if export.resolve() == out.resolve():
        raise RunError(export, "is the folder of the run", "name another one with --export")
    check_folder(export, again)
    began, began_cpu = time.perf_counter(), time.process_time()
    if config.resume:
        check_steps(out / CHECKPOINT, read_kept(out / CHECKPOINT)[0], config.optim.steps)
        _check_same_optimiser(out, config)
        may_change = [name for name in vars(config) if name not in ("data", "layout", "network")]
        opened = resumed_run(out, config, may_change)
    else:
        opened = run_folder(
            out, "python -m training.train", config, config.overwrite, resumable=CHECKPOINT
        )
    with opened, owned(export, "python -m training.train"):
        folder = train(TrainingConfig(**settings), out, export, config.resume)
        errors = read_json(folder / CARD)["training_errors_mm"]
        table = [{"error_mm": name, **values} for name, values in errors.items()]
        write_results(out, table, seeds=[config.optim.seed])
    wall, cpu = time.perf_counter() - began, time.process_time() - began_cpu
    print(f"prior written to {folder} (measuring included: {wall:.0f} s, {cpu:.0f} CPU s)")


def _check_same_optimiser(out: Path, config: Training) -> None:
    """Refuse to resume with settings by which the steps ahead would be other ones: only how many
    there are, and on how many threads, may change."""
    path = out / CONFIG_FILE
    saved = read_entries(path, RESTORE) if path.is_file() else {}
    before = saved.get("optim")
    if not isinstance(before, dict):
        raise RunError(out, f"holds no {CONFIG_FILE} of a training", "leave out --resume")
    differing = [
        f"optim.{name}"
        for name, value in vars(config.optim).items()
        if name not in ("steps", "threads") and value != before.get(name)
    ]
    if differing:
        names = " and ".join(differing)
        raise RunError(out, f"holds a run with another {names}", "name a new folder")


if __name__ == "__main__":
    run(train_prior, Training)
