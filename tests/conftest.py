"""Options, tolerances and type checks shared by all tests.

Shapes and types written on tpcd's signatures are checked while the tests run, by
jaxtyping with beartype; this must be set before anything imports tpcd.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jaxtyping
import pytest


def checked_modules() -> list[str]:
    """Names of what the import hook checks: all of tpcd.

    The last jaxtyping for Python 3.10 wraps functions that numba compiles, in spite of their
    `no_type_check`, and numba cannot cache those; there, their modules stay unchecked.
    """
    if sys.version_info >= (3, 11):
        return ["tpcd"]
    root = Path(__file__).resolve().parents[1]
    marks = ("tpcd.loops import",)
    plain = [
        path
        for path in root.glob("tpcd/**/*.py")
        if not any(mark in path.read_text() for mark in marks)
    ]
    modules = [path for path in plain if path.name != "__init__.py"]
    return [".".join(path.relative_to(root).with_suffix("").parts) for path in modules]


jaxtyping.install_import_hook(checked_modules(), "beartype.beartype")

import torch  # noqa: E402
from hypothesis import settings  # noqa: E402

torch.set_num_threads(1)
# How long an example takes says nothing of the code: first calls import and compile.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@dataclass(frozen=True)
class Tolerance:
    """Absolute and relative tolerance, in the form `torch.testing.assert_close` takes."""

    atol: float
    rtol: float


TOLERANCES = {
    torch.float32: Tolerance(atol=1e-5, rtol=1e-5),
    torch.float64: Tolerance(atol=1e-10, rtol=1e-10),
}
"""The one table dtype -> tolerances."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that choose device and dtype."""
    parser.addoption("--device", default="cpu", help="torch device for tests that take one")
    parser.addoption(
        "--dtype", default="float64", choices=("float32", "float64"), help="dtype of such tests"
    )


@pytest.fixture
def device(request: pytest.FixtureRequest) -> torch.device:
    """The device given by --device."""
    return torch.device(request.config.getoption("--device"))


@pytest.fixture
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """The dtype given by --dtype."""
    return getattr(torch, request.config.getoption("--dtype"))


@pytest.fixture
def tolerance(dtype: torch.dtype) -> dict[str, float]:
    """Tolerances for --dtype, as keyword arguments of `torch.testing.assert_close`."""
    return {"atol": TOLERANCES[dtype].atol, "rtol": TOLERANCES[dtype].rtol}


@pytest.fixture
def tolerances() -> dict[torch.dtype, Tolerance]:
    """The whole table dtype -> tolerances, for tests that use several dtypes."""
    return TOLERANCES


@pytest.fixture
def types_unchecked() -> Iterator[None]:
    """Shapes and types are not checked meanwhile: for loops whose thousands of turns a test waits
    for, and whose types others check."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
