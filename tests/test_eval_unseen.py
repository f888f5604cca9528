"""The evaluation on unseen outlines: a small run, its table, and going on after a stop."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from eval.unseen import SEEN, UNSEEN, Unseen, evaluate_unseen
from tpcd.errors import CheckpointError, FileError
from tpcd.shape.ycb import GRASPABLE_21, ycb_folder

PRIOR = Path(__file__).parents[1] / "checkpoints" / "ycb21-z2"
SMALL = Unseen(
    priors=(str(PRIOR),),
    objects=("006_mustard_bottle",),
    steps=5,
    tests=1,
    test_steps=6,
    particles=100,
    truth="quasistatic",
)


def test_seen_and_unseen_objects_are_told_apart() -> None:
    assert len(set(SEEN) | set(UNSEEN)) == len(SEEN) + len(UNSEEN) == 22
    assert set(SEEN) <= set(GRASPABLE_21)
    assert not set(UNSEEN) & set(GRASPABLE_21)


def test_a_run_scores_every_cell_and_goes_on_after_a_stop(tmp_path: Path) -> None:
    out = tmp_path / "run"
    if ycb_folder() is None:
        with pytest.raises(FileError, match="fetch_ycb"):
            evaluate_unseen(replace(SMALL, out=out))
        return
    evaluate_unseen(replace(SMALL, out=out))
    results = json.loads((out / "results.json").read_text())
    cell = results["table"][0]
    assert cell["object"] == "006_mustard_bottle" and cell["seen"] is True
    assert 0 < cell["x_mm"] < 10 and 0 < cell["F_z_N"] < 1
    assert 0 <= cell["coverage_90"] <= 1
    assert results["table"][-1]["object"].startswith("MEAN")
    assert cell["prior"] == "ycb21-z2"
    assert (out / "figures" / "errors.png").is_file()
    assert (out / "figures" / "calibration-ycb21-z2.png").is_file()
    first = (out / "cells.jsonl").read_text()
    (out / "cells.jsonl").write_text(first + '{"object": "cut off')
    evaluate_unseen(replace(SMALL, out=out, resume=True))
    again = json.loads((out / "results.json").read_text())
    assert again["table"] == results["table"]


@pytest.mark.parametrize(
    ("asked", "error", "told"),
    [
        ({"objects": ("teapot",)}, ValueError, "object is 'teapot', expected one of 001_chips_can"),
        ({"priors": ("teapots",)}, CheckpointError, "teapots: holds no prior"),
        ({"priors": ("ycb21-z2", str(PRIOR))}, ValueError, "expected priors of different names"),
    ],
)
def test_what_is_not_there_is_refused_before_anything_is_written(
    asked: dict[str, tuple[str, ...]], error: type[Exception], told: str, tmp_path: Path
) -> None:
    if ycb_folder() is None:
        error, told = FileError, "fetch_ycb"
    with pytest.raises(error, match=told):
        evaluate_unseen(replace(SMALL, out=tmp_path / "run", **asked))
    assert not (tmp_path / "run").exists()
