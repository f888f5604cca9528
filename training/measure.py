"""Measure a prior again and renew its card: `python -m training.measure FOLDER`.

Trains nothing. The outlines are found by the configuration in the card; it is an error when
they are not the ones that the prior was trained on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tpcd.cli import run
from tpcd.errors import CheckpointError
from tpcd.ownership import owned
from training.config import (
    CheckConfig,
    DataConfig,
    LayoutConfig,
    NetworkConfig,
    OptimConfig,
    TrainingConfig,
)

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class Measuring:
    """Settings of the command."""

    prior: str
    """Checkpoint folder, or the name of a shipped prior."""
    out: Path | None = None
    """Folder for figures and TensorBoard; by default runs/measure-NAME."""
    threads: int = 1
    """Torch threads."""

    def __post_init__(self) -> None:
        if self.threads < 1:
            raise ValueError(f"threads is {self.threads}, expected at least 1")


def measure(config: Measuring) -> None:
    """Measure a prior again and renew its card."""
    import torch

    from tpcd.shape.checkpoint import find_prior
    from training.run import complete_card

    torch.set_num_threads(config.threads)
    folder = find_prior(config.prior)
    trained, outlines = training_of(folder)
    out = config.out or Path("runs") / f"measure-{folder.name}"
    with owned(folder, "python -m training.measure"), owned(out, "python -m training.measure"):
        out.mkdir(parents=True, exist_ok=True)
        complete_card(folder, outlines, trained, out)
    print(f"card of {folder} renewed; figures in {out}")


def training_of(folder: Path) -> tuple[TrainingConfig, dict[str, np.ndarray]]:
    """Configuration and outlines [m] that a prior was trained with.

    Raises CheckpointError where its card does not say so, or the outlines here are others.
    """
    import numpy as np

    from tpcd.shape.checkpoint import load_prior
    from training.outlines import data_hash, training_outlines

    card = load_prior(folder).card
    if "configuration" not in card or "data_sha256" not in card:
        raise CheckpointError(folder, "has a card without its training", "train it again")
    try:
        trained = config_of(dict(card["configuration"]))
    except (TypeError, ValueError) as error:
        raise CheckpointError(
            folder, f"has a card whose configuration is not understood ({error})", "train it again"
        ) from error
    outlines = training_outlines(trained.data, np.random.default_rng(trained.optim.seed))
    if data_hash(outlines) != card["data_sha256"]:
        raise CheckpointError(
            folder, "was trained on other outlines than are here", "train it again"
        )
    return trained, outlines


def config_of(saved: dict) -> TrainingConfig:
    """The configuration that a card saved; fields it lacks take their defaults."""
    parts = {
        "data": DataConfig,
        "layout": LayoutConfig,
        "network": NetworkConfig,
        "optim": OptimConfig,
        "check": CheckConfig,
    }
    return TrainingConfig(**{k: parts[k](**v) if k in parts else v for k, v in saved.items()})


if __name__ == "__main__":
    run(measure, Measuring, positional=("prior",))
