"""The house itself: what ships parses, starts fast, and names nobody's machine."""

from __future__ import annotations

import ast
import os
import re
import resource
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
UNTRACKED = {".git", ".venv", "build", "dist", "runs", "lightning_logs"}
TEXT_FILES = {".py", ".md", ".toml", ".txt", ".yaml", ".yml", ".json", ".cfg", ".csv", ".svg", ""}
SUPPORTED = ("3.10", "3.11", "3.12")
HELP_CPU_SECONDS = 1.0
"""The promise is 0.5 s on a quiet machine. Tests run beside others on shared cores, where
the same work has been seen to take twice as long, so the test allows that."""


def shipped(*suffixes: str) -> list[Path]:
    found = []
    for folder, folders, files in os.walk(ROOT):
        folders[:] = [
            name
            for name in folders
            if name not in UNTRACKED
            and not name.endswith((".egg-info", "_cache"))
            and name not in ("__pycache__", ".hypothesis")
        ]
        found += [Path(folder, name) for name in files if Path(name).suffix in suffixes]
    return sorted(found)


def commands() -> list[tuple[str, ...]]:
    """Every program a user can start, as arguments of python."""
    scripts = [("scripts/" + path.name,) for path in sorted((ROOT / "scripts").glob("*.py"))]
    modules = []
    for path in [*shipped(".py")]:
        inside = path.relative_to(ROOT)
        if inside.parts[0] in ("training", "eval") and _is_program(path):
            modules.append(("-m", ".".join(inside.with_suffix("").parts)))
    return scripts + modules


def _is_program(path: Path) -> bool:
    """Whether a module has the line that starts it."""
    tests = [node.test for node in ast.parse(path.read_text()).body if isinstance(node, ast.If)]
    return any("__main__" in ast.unparse(test) for test in tests)


def ask_for_help(command: tuple[str, ...]) -> tuple[str, float]:
    """Help text of a program and the CPU seconds it took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"COLUMNS": "100", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, *command, "--help"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    return done.stdout, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize("command", commands(), ids=" ".join)
def test_help_comes_at_once(command: tuple[str, ...]) -> None:
    text, first = ask_for_help(command)
    assert "usage:" in text.lower()
    # The faster of two runs: the first may still have to compile byte code.
    assert min(first, ask_for_help(command)[1]) < HELP_CPU_SECONDS


help_text = cache(lambda command: ask_for_help(command)[0])


def readme_commands() -> list[list[str]]:
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] for line in words if line and line[0].endswith("python")]


def test_the_readme_shows_commands() -> None:
    assert len(readme_commands()) >= 4


@pytest.mark.parametrize("words", readme_commands(), ids=" ".join)
def test_the_commands_of_the_readme_exist_with_their_options(words: list[str]) -> None:
    if words[:2] == ["-m", "venv"] or words[:2] == ["-m", "pip"]:
        return
    program = tuple(words[:2]) if words[0] == "-m" else (words[0],)
    text = help_text(program).replace("-", "_")
    for option in [word.split("=")[0] for word in words if word.startswith("--")]:
        assert re.search(rf"{option.replace('-', '_')}\b", text), f"{option} not in the help"


def test_every_yaml_file_parses() -> None:
    found = shipped(".yaml", ".yml")
    for path in found:
        assert isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict), path


# Written in pieces so that this file does not match itself.
FORBIDDEN = {
    "a package registry": re.compile("pypi" + r"\.|" + "index" + "-url|find" + "-links", re.I),
    "a path of one machine": re.compile(r"(?<![\w.$}~-])/(work|tmp|root|opt|home|farm)/\w"),
}


@pytest.mark.parametrize("what", FORBIDDEN)
def test_no_file_names(what: str) -> None:
    found = []
    for path in shipped(*TEXT_FILES):
        if path.stat().st_size < 1_000_000:
            for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), 1):
                if FORBIDDEN[what].search(line):
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}")
    assert not found


@pytest.mark.parametrize("module", ["tpcd", "tpcd.cli", "tpcd.results", "tpcd.errors"])
def test_importing_loads_nothing_heavy(module: str) -> None:
    code = (
        f"import sys, {module}; heavy = {{'torch', 'numpy', 'matplotlib'}} & set(sys.modules);"
        "sys.exit(', '.join(heavy) or 0)"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def requirements() -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    return [Requirement(line) for line in [*project["dependencies"], *extras]]


@pytest.mark.parametrize("python", SUPPORTED)
def test_every_dependency_is_pinned_once_and_within_its_range(python: str) -> None:
    pinned: dict[str, str] = {}
    for line in (ROOT / "pins.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            pin = Requirement(line)
            here = {"python_version": python, "python_full_version": f"{python}.9"}
            if pin.marker is None or pin.marker.evaluate(here):
                assert pin.name not in pinned, f"{pin.name} is pinned twice on Python {python}"
                (only,) = pin.specifier
                assert only.operator == "=="
                pinned[pin.name] = only.version
    for needed in requirements():
        assert needed.specifier.contains(pinned[needed.name.lower()]), needed


def test_every_dependency_works_with_the_others() -> None:
    """Some packages need a newer NumPy than they say; they find out when they are used."""
    import numpy as np
    import pyarrow
    import scipy.sparse
    import shapely
    import torch
    from torch.utils.tensorboard import SummaryWriter

    values = np.arange(4.0)
    assert pyarrow.table({"a": values})["a"].to_numpy().sum() == 6
    assert torch.from_numpy(values).numpy() is not values
    assert shapely.linestrings(values, values).length == pytest.approx(3 * 2**0.5)
    assert scipy.sparse.diags(values).sum() == 6
    assert callable(SummaryWriter)
