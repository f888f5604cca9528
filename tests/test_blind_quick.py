"""The blind benchmark as a smoke run: three hidden cases, named before the key is opened."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from eval.blind.__main__ import TUNING_SEED
from eval.blind.sealing import key_path

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_three_hidden_cases_are_named_before_their_keys_are_opened(tmp_path: Path) -> None:
    out = tmp_path / "blind"
    command = [sys.executable, "-m", "eval.blind", "--quick", "--prior", "ycb-rich-holdout"]
    done = subprocess.run(
        [*command, "--out", str(out)], cwd=ROOT, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads((out / "results.json").read_text())
    assert results["seeds"] == [TUNING_SEED] and results["failed"] == []
    cases = {tuple(case["truth"]): case for case in results["cases"]}
    assert set(cases) == {(), ("force_bias",), ("floor_compliance",)}
    assert all(case["is_exact"] for case in cases.values()), cases
    lines = [json.loads(line) for line in (out / "verdicts-0.jsonl").read_text().splitlines()]
    assert len(lines) == 3
    for line in lines:
        key = key_path(out, line["case"]).read_bytes()
        assert hashlib.sha256(key).hexdigest() == line["key_sha256"]
    assert (out / "figures").is_dir() and list(out.glob("confusion-*.csv"))
