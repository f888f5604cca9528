"""Measure a prior again and renew its card: `python -m training.measure FOLDER`.

Trains nothing. The outlines are found by the configuration in the card; it is an error when
they are not the ones that the prior was trained on.
"""

from __future__ import annotations

import sys
from pathlib import Path

from jsonargparse import ArgumentParser

from tpcd.errors import CheckpointError, TpcdError
from training.config import (
    CheckConfig,
    DataConfig,
    LayoutConfig,
    NetworkConfig,
    OptimConfig,
    TrainingConfig,
)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = ArgumentParser(prog="python -m training.measure", description=__doc__)
    parser.add_argument("prior", type=str, help="checkpoint folder or name")
    parser.add_argument("--out", type=str, default="", help="folder for figures")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    options = parser.parse_args(arguments)
    import numpy as np
    import torch

    from tpcd.shape.checkpoint import find_prior, load_prior
    from training.outlines import data_hash, training_outlines
    from training.run import complete_card

    torch.set_num_threads(options.threads)
    try:
        folder = find_prior(options.prior)
        card = load_prior(folder).card
        config = config_of(dict(card["configuration"]))
        outlines = training_outlines(config.data, np.random.default_rng(config.optim.seed))
        if data_hash(outlines) != card["data_sha256"]:
            raise CheckpointError(
                folder, "was trained on other outlines than are here", "train it again"
            )
        out = Path(options.out or Path("runs") / f"measure-{folder.name}")
        out.mkdir(parents=True, exist_ok=True)
        complete_card(folder, outlines, config, out)
    except TpcdError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"card of {folder} renewed; figures in {out}")
    return 0


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
    raise SystemExit(main())
