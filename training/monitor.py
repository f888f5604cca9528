"""What TensorBoard shows while and after a prior is trained."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from tpcd.shape.deepsdf import UNIT, DeepSDFNetwork, DeepSDFShape
from training.data import Prepared
from training.evaluate import MM, uniform_points
from training.figures import latent_map, outline_gallery, worst_outline


class ErrorMonitor(Callback):
    """Logs the mean boundary error of every outline [mm], ten times during the training."""

    def __init__(self, prepared: Prepared, steps: int) -> None:
        self.names = prepared.names
        self.every = max(1, steps // 10)
        sampled = np.stack([uniform_points(v, 100) for v in prepared.vertices]) / UNIT
        self.points = torch.from_numpy(sampled).float()

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: object,
        batch_idx: int,
    ) -> None:
        """Measure at every tenth of the training."""
        if (batch_idx + 1) % self.every or not isinstance(trainer.logger, TensorBoardLogger):
            return
        network = pl_module.network
        errors = boundary_errors(network, self.points, network.codes.detach()).mean(1)
        writer = trainer.logger.experiment
        for name, error in zip(self.names, errors.tolist(), strict=True):
            writer.add_scalar(f"error_mm/{name}", error, batch_idx + 1)
        writer.add_scalar("error_mm_mean", errors.mean(), batch_idx + 1)
        self.log("error_mm", errors.mean(), prog_bar=True)


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
