"""Train a shape prior and export it: `python -m training.train --config FILE.yaml`.

Writes a run folder (Lightning checkpoints for resuming, TensorBoard, the resolved
configuration) and, at the end, the released prior: safetensors and a JSON card.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path

from tpcd.cli import run
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


def train_prior(config: Training) -> None:
    """Train a shape prior, measure it and write it with its card."""
    # torch and Lightning take seconds to import; --help should not wait for them.
    from training.run import train

    settings = {field.name: getattr(config, field.name) for field in fields(TrainingConfig)}
    out = config.out or Path("runs") / config.name
    began, began_cpu = time.perf_counter(), time.process_time()
    folder = train(
        TrainingConfig(**settings), out, config.export or out / config.name, config.resume
    )
    wall, cpu = time.perf_counter() - began, time.process_time() - began_cpu
    print(f"prior written to {folder} (measuring included: {wall:.0f} s, {cpu:.0f} CPU s)")


if __name__ == "__main__":
    run(train_prior, Training)
