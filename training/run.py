"""One training from configuration to checkpoint: fit, validity, figures for the card."""

from __future__ import annotations

import dataclasses
import logging
import platform
import time
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from torch.utils.tensorboard import SummaryWriter

from tpcd.shape.checkpoint import load_prior, save_prior
from tpcd.shape.deepsdf import DeepSDFNetwork
from tpcd.shape.protocol import Misfit
from training.config import TrainingConfig
from training.data import Prepared, PriorData, prepare
from training.evaluate import measure_prior
from training.module import PriorModule
from training.monitor import ErrorMonitor, log_figures
from training.unseen import measure_unseen, unseen_outlines
from training.validity import fit_mask, fit_truncated_mixture

CHECKPOINT = "last.ckpt"
"""Lightning's, in the run folder, from which a stopped training goes on."""
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
        FileError: the outlines are not there.
        TrainingError: the trained network decodes to nothing.
    """
    torch.set_num_threads(config.optim.threads)
    began, began_cpu = time.perf_counter(), time.process_time()
    prepared = prepare(config)
    module = PriorModule(prepared, config)
    _fit(module, prepared, config, out, out / CHECKPOINT if resume else None)
    seconds = {
        "training_wall_seconds": round(time.perf_counter() - began, 1),
        "training_cpu_seconds": round(time.process_time() - began_cpu, 1),
    }
    export_prior(module.network.eval().requires_grad_(False), prepared, config, export, seconds)
    outlines = dict(zip(prepared.names, prepared.vertices, strict=True))
    return complete_card(export, outlines, config, out)


def export_prior(
    network: DeepSDFNetwork,
    prepared: Prepared,
    config: TrainingConfig,
    folder: Path,
    seconds: dict[str, float],
) -> Path:
    """Find the valid region and write the prior, not measured yet."""
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
        **seconds,
        "threads": config.optim.threads,
        "configuration": dataclasses.asdict(config),
        "versions": {"python": platform.python_version()} | {p: version(p) for p in PACKAGES},
    }
    return save_prior(folder, network, density, prepared.names, Misfit(), card)


def complete_card(
    folder: Path, outlines: dict[str, np.ndarray], config: TrainingConfig, out: Path
) -> Path:
    """Measure a prior as it is loaded from `folder`, write its card and figures again.

    A prior that has seen every object quotes the unseen errors of `config.unseen_from`, the
    same recipe trained with objects left out.
    """
    shape = load_prior(folder)
    card = dict(shape.card) | measure_prior(shape, outlines, config.check.draws)
    misfit = shape.misfit
    strangers = unseen_outlines(shape.names, config.data) if config.check.unseen else {}
    if config.unseen_from:
        other = load_prior(config.unseen_from)
        card["unseen"] = {"measured_with": config.unseen_from, **other.card["unseen"]}
        misfit = other.misfit
    elif strangers:
        report = measure_unseen(shape, strangers, outlines)
        card["unseen"] = report.figures
        misfit = report.misfit
    save_prior(folder, shape.network, shape.density, shape.names, misfit, card)
    by_outline = card["training_errors_by_outline_mean_p95_max"]
    errors = {name: figures["outline"][0] for name, figures in by_outline.items()}
    with SummaryWriter(str(out / "tensorboard")) as writer:
        log_figures(shape, outlines, errors, writer, out, config.optim.steps)
    return folder


def _fit(
    module: PriorModule, prepared: Prepared, config: TrainingConfig, out: Path, resume: Path | None
) -> None:
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    # Lightning warns of our one-process loader and of a folder that a resumed run reuses.
    warnings.filterwarnings("ignore", category=UserWarning, module="lightning")
    warnings.filterwarnings("ignore", category=FutureWarning, module="lightning")
    keep = ModelCheckpoint(
        dirpath=out,
        filename=Path(CHECKPOINT).stem,
        every_n_train_steps=200,
        enable_version_counter=False,
    )
    trainer = Trainer(
        accelerator="cpu",
        max_epochs=1,
        logger=TensorBoardLogger(str(out), name="", version="tensorboard"),
        callbacks=[
            keep,
            TQDMProgressBar(refresh_rate=20),
            ErrorMonitor(prepared, config.optim.steps),
        ],
        enable_model_summary=False,
        log_every_n_steps=20,
    )
    trainer.fit(
        module,
        PriorData(prepared, config),
        ckpt_path=str(resume) if resume else None,
        weights_only=True,
    )
