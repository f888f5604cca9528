"""One training from configuration to checkpoint: fit, validity, figures for the card."""

from __future__ import annotations

import dataclasses
import platform
import shutil
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter

from tpcd.errors import CheckpointError
from tpcd.shape.checkpoint import load_prior, save_prior
from tpcd.shape.deepsdf import DeepSDFNetwork
from tpcd.shape.protocol import Misfit
from training.config import TrainingConfig
from training.data import Prepared, prepare
from training.evaluate import measure_prior
from training.fitting import fit
from training.kept import Kept, clocks
from training.module import PriorModule
from training.monitor import log_figures
from training.unseen import measure_unseen, unseen_outlines
from training.validity import fit_mask, fit_truncated_mixture
from training.watch import TrainingError

PACKAGES = ("torch", "lightning", "numpy", "scipy", "shapely", "contourpy", "safetensors")
ATTRIBUTION = (
    "Trained on outlines derived from the YCB Object and Model Set (B. Calli et al., IEEE "
    "Robotics and Automation Magazine 2015; https://www.ycbbenchmarks.com/), licensed under "
    "CC BY 4.0, https://creativecommons.org/licenses/by/4.0/; changed: meshes cut by planes."
)


def train(config: TrainingConfig, out: Path, export: Path, resume: bool = False) -> Path:
    """Train, measure and export a prior; returns the checkpoint folder.

    `out` is an opened run folder; with `resume` it holds a checkpoint to go on from.

    Raises:
        FileError: the outlines, or the checkpoint to go on from, are not there or not usable.
        TrainingError: the loss diverges, or the trained network decodes to nothing.
    """
    began = clocks()
    torch.set_num_threads(config.optim.threads)
    if config.unseen_from:
        quoted_errors(config.unseen_from)
    prepared = prepare(config)
    module = PriorModule(prepared, config)
    kept = fit(module, prepared, config, out, resume, began)
    outlines = dict(zip(prepared.names, prepared.vertices, strict=True))
    network = module.network.eval().requires_grad_(False)
    unmeasured = out / ".unmeasured"
    try:
        export_prior(network, prepared, config, unmeasured, kept)
        return complete_card(unmeasured, outlines, config, out, export)
    except TrainingError as error:
        began_with, ended_with = kept.first_loss, kept.last_loss
        raise TrainingError(
            f"{error} or with other rates: the loss went from {began_with:.3g} to "
            f"{ended_with:.3g} in {kept.steps_done} steps"
        ) from error
    finally:
        shutil.rmtree(unmeasured, ignore_errors=True)


def export_prior(
    network: DeepSDFNetwork,
    prepared: Prepared,
    config: TrainingConfig,
    folder: Path,
    kept: Kept,
) -> Path:
    """Find the valid region and write the prior, not measured yet; `kept` tells the training."""
    density = (
        fit_mask(network, config.check.mask_cells)
        if prepared.mixture is None
        else fit_truncated_mixture(
            network, prepared.mixture, config.optim.seed, config.check.floor_draws
        )
    )
    card: dict[str, object] = {
        "created": time.strftime("%Y-%m-%d"),
        "data_sha256": prepared.data_hash,
        "licence": "MIT; outlines made in code" if config.data.source == "builtin" else ATTRIBUTION,
        "training_wall_seconds": round(kept.wall_seconds, 1),
        "training_cpu_seconds": round(kept.cpu_seconds, 1),
        "threads": config.optim.threads,
        "configuration": dataclasses.asdict(config),
        "versions": {"python": platform.python_version()} | {p: version(p) for p in PACKAGES},
    }
    if len(kept.schedules) > 1:
        card["learning_rates_from_step_of_steps"] = kept.schedules
    return save_prior(folder, network, density, prepared.names, Misfit(), card)


def complete_card(
    folder: Path,
    outlines: dict[str, np.ndarray],
    config: TrainingConfig,
    out: Path,
    export: Path | None = None,
) -> Path:
    """Measure a prior as it is loaded from `folder`, write its card and figures again; the prior
    goes to `export`, where that is given.

    A prior that has seen every object quotes the unseen errors of `config.unseen_from`, the
    same recipe trained with objects left out.
    """
    shape = load_prior(folder)
    card = dict(shape.card) | measure_prior(shape, outlines, config.check.draws)
    misfit = shape.misfit
    strangers = unseen_outlines(shape.names, config.data) if config.check.unseen else {}
    if config.unseen_from:
        card["unseen"], misfit = quoted_errors(config.unseen_from)
    elif strangers:
        report = measure_unseen(shape, strangers, outlines)
        card["unseen"] = report.figures
        misfit = report.misfit
    folder = save_prior(export or folder, shape.network, shape.density, shape.names, misfit, card)
    by_outline = card["training_errors_by_outline_mean_p95_max"]
    errors = {name: figures["outline"][0] for name, figures in by_outline.items()}
    with SummaryWriter(str(out / "tensorboard")) as writer:
        log_figures(shape, outlines, errors, writer, out, config.optim.steps)
    return folder


def quoted_errors(prior: str) -> tuple[dict[str, object], Misfit]:
    """Unseen errors in the card of another prior, as they are quoted, and its misfit."""
    other = load_prior(prior)
    if not isinstance(other.card.get("unseen"), dict):
        raise CheckpointError(
            prior, "has a card without unseen errors", "name another prior in unseen_from"
        )
    return {"measured_with": prior, **other.card["unseen"]}, other.misfit
