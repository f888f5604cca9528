"""What a training keeps while it runs: one file, from which a stopped one goes on.

A training that was stopped and resumed ends with the same weights, bit for bit, as one that was
not (on one machine, with as many threads). So the file holds all that a later step depends on
but its batch, which follows from the step (`data.Batches`): weights, both optimisers and their
schedules (Lightning's part), how many steps are done, and what a card says of all (`Kept`).
Nothing draws from a global generator. The file is written in one move, never with weights that
are not finite, and read without unpickling anything but tensors and plain values.
"""

from __future__ import annotations

import io
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.plugins.io import TorchCheckpointIO

from tpcd.errors import RunError
from training.config import TrainingConfig
from training.data import Batch
from training.module import PriorModule
from training.watch import check_weights

CHECKPOINT = "last.ckpt"
"""Lightning's, in the run folder, from which a stopped training goes on."""
EVERY = 100
"""Steps between two checkpoints: a few seconds of work."""
ENTRY = "tpcd-training"
"""Where `Kept` lies in the file."""
FORMAT_VERSION = 1
_ANEW = "begin anew without --resume, with --overwrite or in a new folder"


@dataclass(frozen=True)
class Kept:
    """What a checkpoint holds besides Lightning's own; by default as a training begins."""

    data_sha256: str = ""
    """Of the outlines that were trained on."""
    steps_done: int = 0
    """Steps that the weights have seen."""
    first_loss: float | None = None
    """Loss of the first step."""
    last_loss: float | None = None
    """Loss of the last of them."""
    schedules: tuple[tuple[int, int], ...] = ()
    """From which step on the learning rates were those of a training of how many steps; more than
    one where a training was resumed with another number."""
    wall_seconds: float = 0.0
    """Time spent until here, in all parts."""
    cpu_seconds: float = 0.0

    def followed_by(self, steps: int) -> tuple[tuple[int, int], ...]:
        """The schedules where a training of so many steps goes on from here."""
        same = bool(self.schedules) and self.schedules[-1][1] == steps
        return self.schedules if same else (*self.schedules, (self.steps_done, steps))


class Keeper(Callback):
    """Writes the checkpoint every `EVERY` steps, after the last, and where the process is asked
    to end (SIGTERM)."""

    def __init__(
        self,
        path: Path,
        data_sha256: str,
        config: TrainingConfig,
        before: Kept,
        began: tuple[float, float],
    ) -> None:
        self.path, self.data_sha256, self.config = path, data_sha256, config
        self.before, self.began = before, began
        self.steps_done = before.steps_done

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: Batch,
        batch_idx: int,
    ) -> None:
        """Keep what is due."""
        self.steps_done = batch.step + 1
        optim = self.config.optim
        last = self.steps_done == optim.steps
        if last or self.steps_done % EVERY == 0 or trainer.received_sigterm:
            check_weights(pl_module, self.steps_done, optim)
            trainer.save_checkpoint(self.path)
        if trainer.received_sigterm and not last:
            raise KeyboardInterrupt("asked to end")

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add what Lightning does not keep."""
        assert isinstance(pl_module, PriorModule)
        wall, cpu = self.seconds()
        kept = Kept(
            self.data_sha256,
            self.steps_done,
            pl_module.first_loss,
            float(pl_module.terms["loss"]),
            self.before.followed_by(self.config.optim.steps),
            wall,
            cpu,
        )
        checkpoint[ENTRY] = {"format_version": FORMAT_VERSION, **asdict(kept)}

    def on_load_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Drop how far Lightning's loops were: what is left to do is all that `Batches` serves,
        and every batch knows its step."""
        del checkpoint["loops"]

    def seconds(self) -> tuple[float, float]:
        """Wall and processor time until now, with that of the parts before [s]."""
        (wall, cpu), (began_wall, began_cpu) = clocks(), self.began
        return (
            self.before.wall_seconds + wall - began_wall,
            self.before.cpu_seconds + cpu - began_cpu,
        )


class OneMove(TorchCheckpointIO):
    """Writes beside the earlier file and then moves.

    Lightning's own goes through the temporary folder; where that is on another disk, its move is
    a copy, and a process killed in it leaves a cut file and no earlier one.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """Write the checkpoint; RunError where there is no room, the earlier one is kept."""
        path = Path(path)
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        part = path.with_name(f".{path.name}.part")
        try:
            with part.open("wb") as file:
                file.write(buffer.getbuffer())
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, path)
        except OSError as error:
            part.unlink(missing_ok=True)
            remedy = "the one before is kept; make room and go on with --resume"
            remedy = remedy if path.exists() else "make room"
            raise RunError(path, f"cannot be written ({error.strerror})", remedy) from error


def clocks() -> tuple[float, float]:
    """Wall and processor time [s]."""
    return time.perf_counter(), time.process_time()


def read_kept(path: Path) -> tuple[Kept, dict[str, Any]]:
    """What a checkpoint holds, and its weights by name; nothing is unpickled but plain values.

    Raises RunError where it is missing, cut off, or none that this program wrote.
    """
    if not path.is_file():
        raise RunError(path.parent, f"holds no {path.name} to resume from", "leave out --resume")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what a garbled file raises depends on where it is garbled
        line = (str(error).splitlines() or [""])[0][:100] or type(error).__name__
        raise RunError(path, f"is cut off or no checkpoint ({line})", _ANEW) from error
    entry = content.get(ENTRY) if isinstance(content, dict) else None
    if not isinstance(entry, dict) or "state_dict" not in content:
        raise RunError(
            path,
            "is no checkpoint of this program's version (earlier ones do not tell which batches "
            "they had seen)",
            _ANEW,
        )
    if (version := entry.pop("format_version", None)) != FORMAT_VERSION:
        problem = f"has format version {version}, this program reads {FORMAT_VERSION}"
        raise RunError(path, problem, _ANEW)
    try:
        kept = Kept(**entry)
    except TypeError as error:
        raise RunError(path, f"lacks or garbles an entry ({error})", _ANEW) from error
    return kept, content["state_dict"]


def check_fits(
    path: Path, kept: Kept, weights: dict[str, Any], module: PriorModule, data_sha256: str
) -> None:
    """Refuse a checkpoint of other outlines or another network, or with weights that are not
    finite."""
    if kept.data_sha256 != data_sha256:
        raise RunError(path, "was trained on other outlines than are here", _ANEW)
    wanted = module.state_dict()
    if names := sorted(set(wanted) ^ set(weights)):
        where = "lacks" if names[0] in wanted else "has too much of"
        raise RunError(path, f"{where} the tensor '{names[0]}'", _ANEW)
    for name, value in weights.items():
        found, expected = tuple(value.shape), tuple(wanted[name].shape)
        if found != expected:
            raise RunError(path, f"'{name}' has shape {found}, expected {expected}", _ANEW)
        if not torch.isfinite(value).all():
            raise RunError(path, f"'{name}' holds NaN or infinity", _ANEW)
