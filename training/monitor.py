"""What TensorBoard shows while and after a prior is trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from tpcd.shape.deepsdf import UNIT, DeepSDFNetwork, DeepSDFShape
from training.data import Batch, Prepared
from training.evaluate import MM, uniform_points
from training.figures import latent_map, outline_gallery, worst_outline
from training.module import PriorModule

EVERY = 20
"""Steps between two points of the loss."""
ERRORS = 10
"""How often errors of outlines are measured."""


class Monitor(Callback):
    """Logs the loss, and the mean boundary error of every outline [mm], by steps done.

    What it has logged is on disk before a checkpoint is; a resumed training opens its `writer`
    so that points after the checkpoint give way to its own (`purge_step`).
    """

    def __init__(self, prepared: Prepared, steps: int, writer: SummaryWriter) -> None:
        self.names, self.writer = prepared.names, writer
        self.every = max(1, steps // ERRORS)
        sampled = np.stack([uniform_points(v, 100) for v in prepared.vertices]) / UNIT
        self.points = torch.from_numpy(sampled).float()

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: Batch,
        batch_idx: int,
    ) -> None:
        """Log what is due."""
        assert isinstance(pl_module, PriorModule)
        done = batch.step + 1
        if done % EVERY == 0:
            for name, value in pl_module.terms.items():
                self.writer.add_scalar(name, value, done)
            pl_module.log("loss", pl_module.terms["loss"], prog_bar=True)
        if done % self.every == 0:
            network = pl_module.network
            errors = boundary_errors(network, self.points, network.codes.detach()).mean(1)
            for name, error in zip(self.names, errors.tolist(), strict=True):
                self.writer.add_scalar(f"error_mm/{name}", error, done)
            self.writer.add_scalar("error_mm_mean", errors.mean(), done)
            pl_module.log("error_mm", errors.mean(), prog_bar=True)

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """A resumed training does not log again what came before."""
        self.writer.flush()


def boundary_errors(
    network: DeepSDFNetwork, points: Float[Tensor, "n s 2"], codes: Float[Tensor, "n z"]
) -> Float[Tensor, "n s"]:
    """Distance of points of the true outlines (in `UNIT`) from the decoded ones [mm]."""
    with torch.no_grad():
        return network.distance(points, codes).abs() * (UNIT * MM)


def log_figures(
    shape: DeepSDFShape,
    outlines: dict[str, np.ndarray],
    errors_mm: dict[str, float],
    writer: SummaryWriter,
    folder: Path,
    step: int,
) -> None:
    """Write the gallery, the latent map and the worst outline to TensorBoard and as PNG."""
    worst = max(errors_mm, key=lambda name: errors_mm[name])
    figures = {
        "outlines": outline_gallery(shape, outlines, errors_mm),
        "latent_map": latent_map(shape),
        "worst": worst_outline(shape, worst, outlines[worst], errors_mm[worst]),
    }
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=90)
        writer.add_figure(name, figure, step)
    writer.flush()
