"""The steps of a training, by Lightning: from the beginning, or from what was kept."""

from __future__ import annotations

import logging
import signal
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from torch.utils.tensorboard import SummaryWriter

from tpcd.errors import RunError
from training.config import TrainingConfig
from training.data import Batches, Prepared
from training.kept import CHECKPOINT, Keeper, Kept, OneMove, check_fits, clocks, read_kept
from training.module import PriorModule
from training.monitor import Monitor


def fit(
    module: PriorModule,
    prepared: Prepared,
    config: TrainingConfig,
    out: Path,
    resume: bool = False,
    began: tuple[float, float] | None = None,
) -> Kept:
    """Train the module for `optim.steps`, with `resume` from the checkpoint in `out`; returns how
    it was trained. `began` is when the work on it began, by `clocks`; by default now.

    Raises:
        RunError: the checkpoint cannot be resumed from, or not be written.
        TrainingError: the loss is not finite or has diverged.
    """
    path, before, steps = out / CHECKPOINT, Kept(), config.optim.steps
    if resume:
        before, weights = read_kept(path)
        check_steps(path, before, steps)
        check_fits(path, before, weights, module, prepared.data_hash)
        module.load_state_dict(weights)
        module.first_loss = before.first_loss
    keeper = Keeper(path, prepared.data_hash, config, before, began or clocks())
    last_loss = before.last_loss
    if before.steps_done < steps:
        _go(module, Batches(prepared, config, before.steps_done), keeper, out, resume)
        last_loss = float(module.terms["loss"])
    assert keeper.steps_done == steps, f"{keeper.steps_done} of {steps} steps done"
    wall, cpu = keeper.seconds()
    return replace(
        before,
        data_sha256=prepared.data_hash,
        steps_done=steps,
        first_loss=module.first_loss,
        last_loss=last_loss,
        schedules=before.followed_by(steps),
        wall_seconds=wall,
        cpu_seconds=cpu,
    )


class _Bar(TQDMProgressBar):
    """A progress bar that ends its line where the training ends early."""

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Let what is told of it begin on a line of its own."""
        with suppress(TypeError):  # there is no bar yet
            self.train_progress_bar.close()


def _go(module: PriorModule, batches: Batches, keeper: Keeper, out: Path, resume: bool) -> None:
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    # Lightning asks torch for the leaves of its data in a way that torch is about to change.
    warnings.filterwarnings("ignore", message=".*LeafSpec", category=FutureWarning)
    on_interrupt = signal.getsignal(signal.SIGINT)
    purge = batches.first + 1 if resume else None
    with SummaryWriter(str(out / "tensorboard"), purge_step=purge) as writer:
        trainer = Trainer(
            accelerator="cpu",
            max_epochs=1,
            logger=False,
            enable_checkpointing=False,
            callbacks=[
                Monitor(batches.prepared, batches.config.optim.steps, writer),
                _Bar(refresh_rate=20),
                keeper,
            ],
            plugins=[OneMove()],
            enable_model_summary=False,
        )
        path = str(keeper.path) if resume else None
        try:
            trainer.fit(module, batches, ckpt_path=path, weights_only=True)
        except SystemExit as stop:
            # Lightning's answer to Ctrl-C and SIGTERM.
            raise KeyboardInterrupt(*getattr(stop.__context__, "args", ())) from stop
        finally:
            signal.signal(signal.SIGINT, on_interrupt)


def check_steps(path: Path, before: Kept, steps: int) -> None:
    """Refuse to go on to fewer steps than are done."""
    if before.steps_done > steps:
        raise RunError(
            path,
            f"has seen {before.steps_done} steps, optim.steps is {steps}",
            f"ask for at least {before.steps_done}, or begin anew in a new folder",
        )
