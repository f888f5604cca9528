"""A training that was stopped and resumed is, bit for bit, the training that was not."""

from __future__ import annotations

import errno
import os
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NoReturn

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tpcd.cli import run as run_command
from tpcd.errors import RunError
from tpcd.results import run_folder
from training.config import DataConfig, LayoutConfig, NetworkConfig, OptimConfig
from training.data import Batch, Batches, Prepared, prepare
from training.fitting import fit
from training.kept import CHECKPOINT, ENTRY, Kept, read_kept
from training.module import PriorModule
from training.train import Training, train_prior

STEPS, EVERY = 12, 4
"""Steps of the training, and between two checkpoints."""
CONFIG = Training(
    data=DataConfig("builtin", only=["drink_can", "banana", "juice_carton"]),
    layout=LayoutConfig(points=32, between=50, object_samples=100, attempts=1),
    network=NetworkConfig(width=16, depth=2, frequency=3.0),
    optim=OptimConfig(steps=STEPS, batch=32, latents=8, threads=1),
)


PARTS: list[Path] = []
"""Folders of all parts of trainings that these tests have run."""


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints and points of the loss every few steps."""
    monkeypatch.setattr("training.kept.EVERY", EVERY)
    monkeypatch.setattr("training.monitor.EVERY", 1)
    # TensorBoard reads its files by the second in which they were begun.
    later = SimpleNamespace(time=lambda: 1e9 + 3600 * len(PARTS))
    monkeypatch.setattr("tensorboard.summary.writer.event_file_writer.time", later)


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(CONFIG)


def train(prepared: Prepared, out: Path, resume: bool = False, steps: int = STEPS) -> PriorModule:
    """One part of a training; what it draws from the global generator would differ each time."""
    PARTS.append(out)
    torch.manual_seed(len(PARTS))
    config = replace(CONFIG, optim=replace(CONFIG.optim, steps=steps))
    module = PriorModule(prepared, config)
    kept = fit(module, prepared, config, out, resume)
    assert kept.steps_done == steps
    return module


def stopping_at(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Let the training be interrupted when this step, from 0, is to begin."""
    whole = PriorModule.training_step

    def stopped(module: PriorModule, batch: Batch, index: int) -> None:
        if batch.step == step:
            raise KeyboardInterrupt
        whole(module, batch, index)

    monkeypatch.setattr(PriorModule, "training_step", stopped)


def points(run: Path, name: str = "loss") -> list[tuple[int, float]]:
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars(name)]


def same(first: PriorModule, second: PriorModule) -> bool:
    pairs = zip(first.state_dict().values(), second.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


@pytest.fixture(scope="module")
def whole(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory):
    """The training that is not stopped: its folder and what it trained."""
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("training.kept.EVERY", EVERY)
        patch.setattr("training.monitor.EVERY", 1)
        return out, train(prepared, out)


@pytest.mark.parametrize("stops", [(4,), (5,), (7,), (11,), (5, 10), (6, 7, 9)], ids=str)
def test_resumed_is_unbroken_bit_for_bit(
    prepared: Prepared, whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stops
) -> None:
    folder, unbroken = whole
    for number, stop in enumerate(stops):
        with monkeypatch.context() as patch:
            stopping_at(patch, stop)
            with pytest.raises(KeyboardInterrupt):
                train(prepared, tmp_path, resume=number > 0)
        assert read_kept(tmp_path / CHECKPOINT)[0].steps_done == stop // EVERY * EVERY
    resumed = train(prepared, tmp_path, resume=True)
    assert same(resumed, unbroken)
    assert resumed.first_loss == unbroken.first_loss
    for name in ("loss", "loss/distance", "error_mm_mean", "error_mm/banana"):
        assert points(tmp_path, name) == points(folder, name)
    assert [step for step, _ in points(tmp_path)] == list(range(1, STEPS + 1))


def test_a_finished_training_resumes_to_itself(prepared: Prepared, whole, tmp_path: Path) -> None:
    train(prepared, tmp_path)
    before = (tmp_path / CHECKPOINT).read_bytes()
    assert same(train(prepared, tmp_path, resume=True), whole[1])
    assert (tmp_path / CHECKPOINT).read_bytes() == before


def test_a_finished_training_goes_on_to_more_steps_and_says_so(
    prepared: Prepared, whole, tmp_path: Path
) -> None:
    train(prepared, tmp_path)
    longer = train(prepared, tmp_path, resume=True, steps=STEPS + 3)
    assert not same(longer, whole[1])
    kept, _ = read_kept(tmp_path / CHECKPOINT)
    assert kept.steps_done == STEPS + 3
    assert [tuple(part) for part in kept.schedules] == [(0, STEPS), (STEPS, STEPS + 3)]
    with pytest.raises(RunError, match=f"has seen {STEPS + 3} steps, optim.steps is {STEPS}"):
        train(prepared, tmp_path, resume=True)


def test_a_batch_follows_from_its_step(prepared: Prepared) -> None:
    every = list(Batches(prepared, CONFIG))
    for first in (1, 5, STEPS - 1, STEPS):
        rest = list(Batches(prepared, CONFIG, first))
        assert len(rest) == len(Batches(prepared, CONFIG, first)) == STEPS - first
        for batch, other in zip(rest, every[first:], strict=True):
            assert batch.step == other.step
            assert all(torch.equal(a, b) for a, b in zip(batch[1:], other[1:], strict=True))


def test_time_of_all_parts_is_told(
    prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        stopping_at(patch, 5)
        with pytest.raises(KeyboardInterrupt):
            train(prepared, tmp_path)
    first, _ = read_kept(tmp_path / CHECKPOINT)
    train(prepared, tmp_path, resume=True)
    both, _ = read_kept(tmp_path / CHECKPOINT)
    assert 0 < first.wall_seconds < both.wall_seconds
    assert 0 < first.cpu_seconds < both.cpu_seconds


def _no_room(*_: object) -> NoReturn:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(
    prepared: Prepared, whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        stopping_at(patch, 5)
        with pytest.raises(KeyboardInterrupt):
            train(prepared, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("training.kept.os.fsync", _no_room)
        with pytest.raises(RunError, match=r"last.ckpt: cannot be written \(No space left"):
            train(prepared, tmp_path, resume=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [CHECKPOINT, "tensorboard"]
    assert read_kept(tmp_path / CHECKPOINT)[0].steps_done == EVERY
    assert same(train(prepared, tmp_path, resume=True), whole[1])


def test_a_training_asked_to_end_keeps_the_step_it_was_at(
    prepared: Prepared, whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    every_step = PriorModule.training_step

    def asked(module: PriorModule, batch: Batch, index: int) -> None:
        every_step(module, batch, index)
        if batch.step == 5:
            os.kill(os.getpid(), signal.SIGTERM)

    on_interrupt = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        patch.setattr(PriorModule, "training_step", asked)
        with pytest.raises(KeyboardInterrupt, match="asked to end"):
            train(prepared, tmp_path)
    assert signal.getsignal(signal.SIGINT) is on_interrupt
    assert read_kept(tmp_path / CHECKPOINT)[0].steps_done == 6
    assert same(train(prepared, tmp_path, resume=True), whole[1])


def _edited(path: Path, change) -> None:
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)


DEFECTS = {
    "is cut off or no checkpoint": lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]),
    "is cut off or no checkpoint (": lambda p: p.write_bytes(b""),
    "is no checkpoint of this program's version": lambda p: _edited(p, lambda c: c.pop(ENTRY)),
    "has format version 99": lambda p: _edited(p, lambda c: c[ENTRY].update(format_version=99)),
    "lacks or garbles an entry": lambda p: _edited(p, lambda c: c[ENTRY].update(later=1)),
    "was trained on other outlines": lambda p: _edited(p, lambda c: c[ENTRY].pop("data_sha256")),
    "lacks the tensor 'network.codes'": lambda p: _edited(
        p, lambda c: c["state_dict"].pop("network.codes")
    ),
    "has too much of the tensor 'a'": lambda p: _edited(
        p, lambda c: c["state_dict"].update(a=torch.zeros(1))
    ),
    "'network.codes' has shape (3, 5), expected (3, 2)": lambda p: _edited(
        p, lambda c: c["state_dict"].update({"network.codes": torch.zeros(3, 5)})
    ),
    "'network.codes' holds NaN": lambda p: _edited(
        p, lambda c: c["state_dict"]["network.codes"].fill_(torch.nan)
    ),
}


@pytest.mark.parametrize("message", DEFECTS)
def test_what_cannot_be_resumed_from_gets_one_line(
    prepared: Prepared, whole, tmp_path: Path, message: str
) -> None:
    (tmp_path / CHECKPOINT).write_bytes((whole[0] / CHECKPOINT).read_bytes())
    DEFECTS[message](tmp_path / CHECKPOINT)
    with pytest.raises(RunError) as caught:
        train(prepared, tmp_path, resume=True)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert str(tmp_path / CHECKPOINT) in str(caught.value)


@pytest.mark.parametrize("change", ["seed=3", "batch=31", "muon_rate=0.02", "support_weight=2"])
def test_other_steps_ahead_are_no_resuming(
    prepared: Prepared, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: str
) -> None:
    out = tmp_path / "run"
    with run_folder(out, "train", replace(CONFIG, out=out)):
        pass
    (out / CHECKPOINT).write_bytes(b"")
    torch.save({ENTRY: {"format_version": 1, **vars(Kept())}, "state_dict": {}}, out / CHECKPOINT)
    before = (out / "config.yaml").read_text()
    arguments = [f"--config={out / 'config.yaml'}", "--resume", f"--optim.{change}"]
    with pytest.raises(SystemExit) as stopped:
        run_command(train_prior, Training, arguments, prog="train")
    assert stopped.value.code == 2
    message = capsys.readouterr().err.strip()
    assert f"holds a run with another optim.{change.partition('=')[0]}" in message
    assert "\n" not in message and (out / "config.yaml").read_text() == before
