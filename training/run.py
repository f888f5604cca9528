"""One training from configuration to checkpoint: fit, validity, figures for the card."""

from __future__ import annotations

import dataclasses
import platform
import time
from importlib.metadata import version
from pathlib import Path

import torch
import yaml
from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger

from tpcd.errors import RunError
from tpcd.shape.checkpoint import load_prior, save_prior
from training.config import TrainingConfig
from training.data import Prepared, PriorData, prepare
from training.evaluate import measure_prior
from training.module import PriorModule
from training.validity import fit_mask

PACKAGES = ("torch", "lightning", "numpy", "scipy", "shapely", "contourpy", "safetensors")
ATTRIBUTION = (
    "Trained on outlines derived from the YCB Object and Model Set (B. Calli et al., IEEE "
    "Robotics and Automation Magazine 2015; https://www.ycbbenchmarks.com/), licensed under "
    "CC BY 4.0, https://creativecommons.org/licenses/by/4.0/; changed: meshes cut by planes."
)


def train(config: TrainingConfig, out: Path, export: Path, resume: bool = False) -> Path:
    """Train, measure and export a prior; returns the checkpoint folder.

    Raises:
        RunError: `resume` without anything to resume from.
        FileError: the outlines are not there.
    """
    last = out / "last.ckpt"
    if resume and not last.is_file():
        raise RunError(out, "holds no last.ckpt to resume from", "leave out --resume")
    torch.set_num_threads(config.optim.threads)
    torch.manual_seed(config.optim.seed)
    began = time.process_time()
    prepared = prepare(config)
    out.mkdir(parents=True, exist_ok=True)
    resolved = yaml.safe_dump(dataclasses.asdict(config), sort_keys=False)
    (out / "config.yaml").write_text(resolved, encoding="utf-8")
    module = PriorModule(prepared, config)
    trainer = Trainer(
        accelerator="cpu",
        max_epochs=1,
        logger=TensorBoardLogger(str(out), name="", version="tensorboard"),
        callbacks=[
            ModelCheckpoint(
                dirpath=out, filename="last", every_n_train_steps=500, enable_version_counter=False
            )
        ],
        enable_model_summary=False,
        log_every_n_steps=20,
    )
    data = PriorData(prepared, config)
    # The checkpoint was written by this program into its own run folder.
    trainer.fit(module, data, ckpt_path=str(last) if resume else None, weights_only=False)
    training_seconds = time.process_time() - began
    return export_prior(module.network, prepared, config, export, training_seconds)


def export_prior(
    network: torch.nn.Module,
    prepared: Prepared,
    config: TrainingConfig,
    folder: Path,
    training_seconds: float,
    misfit_sd: float = 0.0,
) -> Path:
    """Find the valid region, write the prior, measure it as loaded, complete its card."""
    network = network.eval().requires_grad_(False)
    density = fit_mask(network)
    card: dict[str, object] = {
        "created": time.strftime("%Y-%m-%d"),
        "data_sha256": prepared.data_hash,
        "licence": ATTRIBUTION if config.data.source != "builtin" else "made in code",
        "training_cpu_seconds": round(training_seconds, 1),
        "threads": config.optim.threads,
        "configuration": dataclasses.asdict(config),
        "versions": {"python": platform.python_version()} | {p: version(p) for p in PACKAGES},
    }
    save_prior(folder, network, density, prepared.names, misfit_sd, card)
    outlines = dict(zip(prepared.names, prepared.vertices, strict=True))
    card |= measure_prior(load_prior(folder), outlines)
    return save_prior(folder, network, density, prepared.names, misfit_sd, card)
