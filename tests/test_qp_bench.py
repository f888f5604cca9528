"""The benchmark of the contact QPs runs, is quick to help, and checks what it prints."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from eval.bench.contact_problems import ContactRecipe, random_contact_problems
from eval.bench.qp import Benchmark, benchmark
from eval.bench.qp_solvers import available_solvers, reference_forces
from tpcd.errors import RunError
from tpcd.files import read_json
from tpcd.qp import solve

ROOT = Path(__file__).resolve().parent.parent


def test_the_quick_run_prints_and_writes_a_table_without_wrong_answers(tmp_path, capsys):
    config = Benchmark(out=tmp_path / "run", rows=(4,), quick=True)
    benchmark(config)
    printed = capsys.readouterr().out
    results = read_json(tmp_path / "run" / "results.json")
    lines = {line["solver"]: line for line in results["table"]}
    assert "native" in lines
    for name in ("native",):
        assert name in printed
        assert lines[name]["wrong"] == lines[name]["failed"] == 0
        assert lines[name]["solved"] == 1.0
        assert lines[name]["error_n"] < 1e-8
        assert lines[name]["seconds"] > 0
    assert results["seeds"] == [0] and results["config"]["rows"] == [4]
    assert {"hardware", "packages"} <= results["versions"].keys()
    assert (tmp_path / "run" / "figures" / "solver_seconds.png").stat().st_size > 5000
    log = EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()
    logged = log.Scalars("seconds_by_rows/native")
    assert [(event.step, event.value) for event in logged] == [
        (4, pytest.approx(lines["native"]["seconds"]))
    ]
    assert log.Tags()["images"] == ["figures/solver_seconds"]
    assert "table/text_summary" in log.Tags()["tensors"]
    with pytest.raises(RunError, match="--overwrite"):
        benchmark(config)


def test_help_is_light():
    command = [sys.executable, "-X", "importtime", "-m", "eval.bench.qp", "--help"]
    start = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "--problems" in done.stdout
    assert time.perf_counter() - start < 20
    assert " torch\n" not in done.stderr and " numba\n" not in done.stderr


@pytest.mark.parametrize("rows", [(), (7,), (0,)])
def test_sizes_that_are_no_contacts_are_refused(rows):
    with pytest.raises(ValueError, match="two for each contact"):
        Benchmark(rows=rows)


def test_problems_are_reproducible_and_mixed():
    first, second = (random_contact_problems(200, 8, 3) for _ in range(2))
    assert torch.equal(first.rows, second.rows) and torch.equal(first.target, second.target)
    counts = set((first.row_mask.sum(-1)).tolist())
    assert counts == {2, 4, 6, 8}
    rows = first.rows[first.row_mask.all(-1)]
    assert (rows[:, :2] == rows[:, 2:4]).all((-1, -2)).any(), "some contacts are duplicates"
    other = random_contact_problems(200, 8, 4)
    assert not torch.equal(first.rows, other.rows)


def test_a_scaled_stiffness_belongs_to_each_problem():
    problem = random_contact_problems(10, 4, 0, ContactRecipe(stiffness_decades=1.0))
    assert problem.hessian.shape == (10, 3, 3)
    assert problem.hessian[:, 0, 0].unique().numel() == 10


def test_every_solver_of_the_table_answers_the_same_problems():
    problem = random_contact_problems(20, 8, 5)
    forces, _ = reference_forces(problem)
    for solver in available_solvers():
        motions, solved = solver.run(problem)
        found = (motions - problem.target.numpy()) @ problem.hessian.numpy()
        assert motions.shape == (20, 3) and solved.shape == (20,)
        assert np.abs(found - forces)[solved].max() < 0.5, solver.name


def test_without_daqp_the_reference_is_the_native_backend(monkeypatch):
    problem = random_contact_problems(20, 8, 6)
    tight, _ = reference_forces(problem)
    monkeypatch.setattr("eval.bench.qp_solvers.find_spec", lambda name: None)
    forces, source = reference_forces(problem)
    assert "not installed" in source
    np.testing.assert_allclose(forces, tight, rtol=0, atol=1e-10)
    step = solve(problem).motion - problem.target
    np.testing.assert_array_equal(forces, (problem.hessian @ step[..., None])[..., 0].numpy())
