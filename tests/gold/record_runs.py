"""Record ten runs: `python tests/gold/record_runs.py CHECKOUT [NAME ...]`, into runs and episodes.

CHECKOUT is a clone of the revision whose answers are the gold ones, 1747f21. Commands are run as a
user would, since their options and files stay while the code behind them changes. Of a run its
figures are kept: every number of `steps.jsonl` and `verdict.json` but times, moments of the belief,
predictions and the rows that were measured.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file

HERE = Path(__file__).resolve().parent
EPISODES = HERE / "episodes"
TIMES = ("seconds", "choosing_seconds")

MUG = ("--outline", "mug", "--truth", "quasistatic", "--seed", "5")
BANANA = ("--outline", "banana", "--truth", "mujoco", "--seed", "6")
CAN = ("--outline", "soup_can", "--truth", "quasistatic", "--seed", "7", "--policy", "diagnosis")
SIMULATED = {
    "mug": (*MUG, "--policy", "rich", "--steps", "8"),
    "mug_test": (*MUG, "--policy", "test", "--steps", "20"),
    "banana": (*BANANA, "--policy", "rich", "--steps", "6"),
    "banana_test": (*BANANA, "--policy", "test", "--steps", "20"),
    "can": (*CAN, "--steps", "40"),
    "can_tilted": (*CAN, "--steps", "40", "--effects", "floor_tilt.angle=0.03"),
}
SMALL, RICH = ("--prior", "ycb21-z2"), ("--prior", "ycb-rich")
RUNS: dict[str, tuple[str, ...]] = {
    "estimate": ("estimate", "mug", *SMALL),
    "estimate_rich": ("estimate", "banana", *RICH, "--particles", "300"),
    "estimate_paper": ("estimate", "mug", *SMALL, "--estimator", "paper"),
    "predict": ("predict", "estimate", "mug_test"),
    "predict_rollout": ("predict", "estimate_rich", "banana_test", "--rollout", "--of", "true"),
    "predict_paper": ("predict", "estimate_paper", "mug_test"),
    "explore_active": ("explore", *MUG, *SMALL, "--policy", "active", "--steps", "5"),
    "explore_grid": ("explore", *BANANA, *SMALL, "--policy", "grid", "--steps", "4"),
    "diagnose": ("diagnose", "can", *RICH),
    "diagnose_tilted": ("diagnose", "can_tilted", *RICH),
}


def main(checkout: Path, names: list[str]) -> None:
    """Simulate the episodes that are not there, then run and keep figures."""
    with tempfile.TemporaryDirectory() as folder:
        for name, options in SIMULATED.items():
            if not (EPISODES / f"{name}.csv").is_file():
                command(checkout, "simulate", *options, "--name", name, "--out", EPISODES.name)
        for name in names or RUNS:
            figures = figures_of(checkout, name, Path(folder))
            (HERE / "runs").mkdir(exist_ok=True)
            text = json.dumps(figures, separators=(",", ":"), sort_keys=True)
            (HERE / "runs" / f"{name}.json").write_text(text + "\n", encoding="utf-8")


def figures_of(checkout: Path, name: str, folder: Path) -> dict[str, Any]:
    """Run one command into the folder and read its figures."""
    script, *options = RUNS[name]
    out = folder / name
    if script == "predict":
        run, episode, *options = options
        if not (folder / run).is_dir():
            figures_of(checkout, run, folder)
        out = out.with_suffix(".csv")
        options = [str(folder / run), str(EPISODES / f"{episode}.csv"), *options]
    elif script != "explore":
        options = [str(EPISODES / f"{options[0]}.csv"), *options[1:]]
    code = command(checkout, script, *options, "--out", str(out))
    return {"code": code, **(rows_of(out) if script == "predict" else run_of(out))}


def command(checkout: Path, script: str, *options: str) -> int:
    """Run a script of the checkout on one thread; verdicts have codes from 10 on."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, str(checkout / "scripts" / f"{script}.py"), *options]
    code = subprocess.run(line, env=environment, cwd=HERE, check=False).returncode
    if code not in (0, *range(10, 15)):
        raise SystemExit(f"{script} ended with {code}: {' '.join(line)}")
    return code


def run_of(folder: Path) -> dict[str, Any]:
    """The figures of a run folder."""
    found: dict[str, Any] = {}
    if (folder / "steps.jsonl").is_file():
        lines = (folder / "steps.jsonl").read_text(encoding="utf-8").splitlines()
        found["steps"] = [timeless(json.loads(line)) for line in lines]
    if (folder / "verdict.json").is_file():
        found["verdict"] = timeless(json.loads((folder / "verdict.json").read_text("utf-8")))
    if (folder / "belief.safetensors").is_file():
        found["belief"] = moments(folder)
    episode = folder / "episode.csv"
    return found | ({"episode": rows_of(episode)["rows"]} if episode.is_file() else {})


def moments(folder: Path) -> dict[str, Any]:
    """Evidence, means, standard deviations and skewness of theta and of the misfit's size."""
    tensors = load_file(folder / "belief.safetensors")
    weights = tensors["weights"] / tensors["weights"].sum()
    found: dict[str, Any] = {"effective": float(1 / (weights**2).sum())}
    for name in ("vectors", "misfit_sd"):
        value = tensors[name].reshape(len(weights), -1)
        mean = weights @ value
        sd = (weights @ (value - mean) ** 2) ** 0.5
        third = weights @ ((value - mean) / sd) ** 3
        found[name] = {"mean": mean.tolist(), "sd": sd.tolist(), "skewness": third.tolist()}
    card = json.loads((folder / "belief.json").read_text(encoding="utf-8"))
    return found | {name: card[name] for name in ("names", "log_evidence", "log_evidence_std")}


def rows_of(path: Path) -> dict[str, Any]:
    """A table of numbers."""
    with path.open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    return {"header": header, "rows": [[float(entry) for entry in row] for row in rows]}


def timeless(value: Any) -> Any:
    """Without times."""
    if isinstance(value, dict):
        return {name: timeless(each) for name, each in value.items() if name not in TIMES}
    return [timeless(each) for each in value] if isinstance(value, list) else value


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])
