"""A disk that takes no more is told with the file, with what is left of the run, and how it goes
on."""

from __future__ import annotations

import errno
import os
import resource
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from command_calls import PRIOR, call
from matplotlib.figure import Figure
from short_episode import short_episode

from eval.lines import append_lines, write_line
from tpcd.belief.state import EstimatorState, save_state
from tpcd.cli_messages import system_problem
from tpcd.commands.estimation import EstimationRun
from tpcd.data.files import write_episode
from tpcd.discrepancy.memory import Memory
from tpcd.effects.model import Model, write_model
from tpcd.errors import RunError
from tpcd.figures.sinks import save_figure
from tpcd.files import write_json
from tpcd.results import resumed_run, run_folder
from tpcd.shape.ycb_archive import extract_mesh


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let this process write files of so many bytes at most [B]: a disk that refuses the rest."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@dataclass(frozen=True)
class Fit:
    values: torch.Tensor
    size: int


def fit(folder: Path) -> None:
    Memory(folder).recall("a fit", ("key",), Fit, lambda: Fit(torch.zeros(100), 100))


def estimator_state(folder: Path) -> None:
    state = EstimatorState(1, {"a": torch.zeros(100)}, torch.Generator().get_state())
    save_state(state, folder, short_episode(2), PRIOR)


def mesh(folder: Path) -> None:
    whole = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, whole[1]))
    (folder / "object.obj").write_text("v 0 0 0\n" * 100)
    with tarfile.open(folder / "object.tgz", "w:gz") as archive:
        archive.add(folder / "object.obj", "object.obj")
    (folder / "object.obj").unlink()
    resource.setrlimit(resource.RLIMIT_FSIZE, whole)
    try:
        extract_mesh(folder / "object.tgz", "object.obj", folder / "object.obj")
    finally:
        (folder / "object.tgz").unlink()


def line(folder: Path) -> None:
    with append_lines(folder / "cells.jsonl") as lines:
        write_line(lines, {"a": "b" * 100})


WRITERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "JSON": (lambda folder: write_json(folder / "a.json", list(range(100))), "a.json"),
    "figure": (lambda folder: save_figure(Figure(), folder, "outline"), "outline.png"),
    "episode": (lambda folder: write_episode(short_episode(2), folder / "mug"), "mug.csv"),
    "state": (estimator_state, "state.safetensors"),
    "model": (lambda folder: write_model(Model(), folder / "m.yaml", "n" * 100), "m.yaml"),
    "line of a benchmark": (line, "cells.jsonl"),
    "mesh of an archive": (mesh, "object.obj"),
}


@pytest.mark.parametrize("what", WRITERS)
def test_who_writes_names_the_file_and_leaves_nothing_half_written(
    tmp_path: Path, what: str
) -> None:
    write, name = WRITERS[what]
    with largest_file(40), pytest.raises(OSError) as caught:
        write(tmp_path)
    assert caught.value.errno == errno.EFBIG
    told = f"{tmp_path / name}: File too large; raise the limit on the size of files"
    assert system_problem(caught.value) == told
    assert [path for path in tmp_path.iterdir() if path.name != "cells.jsonl"] == []


def test_a_fit_names_its_file(tmp_path: Path) -> None:
    with largest_file(40), pytest.raises(OSError) as caught:
        fit(tmp_path)
    assert Path(str(caught.value.filename)).parent == tmp_path
    assert str(caught.value.filename).endswith(".safetensors") and not list(tmp_path.iterdir())


def test_an_estimate_on_a_full_disk_says_how_it_goes_on_and_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_episode(short_episode(3), tmp_path / "mug")
    run, add = tmp_path / "run", EstimationRun.add
    words = (str(tmp_path / "mug.csv"), "--prior", PRIOR, "--particles", "50", "--out", str(run))

    def full_from(first: int) -> Callable[..., None]:
        def add_step(self: EstimationRun, step, *rest) -> None:
            with largest_file(1000 if step.index >= first else resource.RLIM_INFINITY):
                add(self, step, *rest)

        return add_step

    goes_on = f"{run} goes on with --resume"
    for first, name, kept in (
        (1, "belief.safetensors", "nothing of the run is kept"),
        (2, "steps.jsonl", goes_on),
    ):
        monkeypatch.setattr(EstimationRun, "add", full_from(first))
        assert call("estimate", *words) == 2
        told = capsys.readouterr().err.splitlines()[-1]
        remedy = "File too large; raise the limit on the size of files"
        assert told == f"estimate: error: {run / name}: {remedy}; {kept}"
        assert run.exists() == (first == 2)
    monkeypatch.setattr(EstimationRun, "add", add)
    assert call("estimate", *words, "--resume") == 0
    assert len((run / "steps.jsonl").read_text().splitlines()) == 3


def test_an_error_without_a_file_names_the_folder_and_what_is_closed_hides_no_name(
    tmp_path: Path,
) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    told = "No space left on device; free some space; "
    run = tmp_path / "run"
    with pytest.raises(RunError) as caught, run_folder(run, "x", {}):
        raise full
    assert str(caught.value) == f"{run}: {told}nothing of the run is kept"
    with pytest.raises(RunError) as caught, run_folder(run, "x", {}, resumable="state") as folder:
        (folder / "state").write_text("")
        try:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(run / "belief"))
        finally:
            raise full  # as TensorBoard does when it is closed
    assert str(caught.value) == f"{run / 'belief'}: {told}{run} goes on with --resume"
    with pytest.raises(RunError) as caught, run_folder(run, "x", {}, overwrite=True):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))
    kept = "Read-only file system; choose a place where you may write; the earlier run is as it was"
    assert str(caught.value) == f"{run}: {kept}" and (run / "state").is_file()
    with pytest.raises(RunError, match="goes on with --resume"), resumed_run(run, {}):
        raise full
    with pytest.raises(FileNotFoundError), resumed_run(run, {}):
        raise FileNotFoundError(errno.ENOENT, "no such file", "input.csv")
