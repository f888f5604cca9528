"""Commands called in the process of the test, and a small world for them to work on."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
PRIOR = str(ROOT / "checkpoints" / "ycb21-z2")


def load_script(name: str) -> ModuleType:
    """A script as a module, without running it."""
    specification = importlib.util.spec_from_file_location(
        f"script_{name}", ROOT / "scripts" / f"{name}.py"
    )
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[module.__name__] = module
    specification.loader.exec_module(module)
    return module


def call(script: str, *arguments: str) -> int:
    """Run a script in this process and return its exit code."""
    from tpcd.cli import run

    module = load_script(script)
    entry = {
        "simulate": ("simulate", "Simulation", ()),
        "diagnose": ("diagnose_episodes", "Diagnose", ("episodes",)),
        "estimate": ("estimate_episode", "Estimate", ("episode",)),
        "explore": ("explore_object", "Exploration", ()),
        "fetch_ycb": ("fetch", "Fetching", ("folder",)),
        "plan_diagnosis": ("plan_diagnosis", "Planning", ()),
        "predict": ("predict_episodes", "Predict", ("run", "episodes")),
    }[script]
    main, config = (getattr(module, name) for name in entry[:2])
    with pytest.raises(SystemExit) as stopped:
        run(main, config, list(arguments), positional=entry[2], prog=script)
    return int(stopped.value.code or 0)


def make_world(folder: Path) -> Path:
    """Put an exploration, a test episode, and the run that learnt from the first in a folder."""
    from tpcd.shape.builtin import builtin_outlines
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import make_motion, record, write_recording
    from tpcd.truth.scene import draw_scene

    generator = torch.Generator().manual_seed(11)
    outline = builtin_outlines()["jam_jar"]
    scene = draw_scene("jam_jar", outline.vertices, generator)
    truth = make_truth(scene, "quasistatic")
    for name, policy, steps in (("explore", "rich", 6), ("test", "test", 8)):
        motion = make_motion(policy, scene, steps, generator)
        write_recording(record(truth, scene, motion, steps, generator), scene, folder / name)
    code = call(
        "estimate",
        str(folder / "explore.csv"),
        *("--prior", PRIOR, "--out", str(folder / "run"), "--particles", "100"),
    )
    assert code == 0
    return folder
