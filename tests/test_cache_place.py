"""Compiled loops have a place, wherever neither the package nor the user's cache can be written."""

from __future__ import annotations

import ctypes
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_calls import ROOT

from tpcd import loops

CAP_DAC_OVERRIDE, PR_CAPBSET_DROP = 1, 24
SOLVE = """
import torch
from tpcd.qp import ContactQP, solve
one = torch.ones(1, 3, dtype=torch.float64)
found = solve(ContactQP(torch.eye(3).double(), one, one[:, None], -6 * one[:, :1]))
from tpcd.qp import batch
stats = [batch._solve_batch_3.stats, batch._solve_batch_n.stats]
print([sum(s.cache_hits.values()) for s in stats], [sum(s.cache_misses.values()) for s in stats])
print(found.motion.tolist())
"""


def as_anybody() -> None:
    """Take from a superuser the right to write everything, before it becomes another program."""
    ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A copy of the package with compiled loops that nobody can write, and a home like it."""
    folder = tmp_path_factory.mktemp("installed")
    caches = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "tpcd", folder / "tpcd", ignore=caches)
    (folder / "home").mkdir()
    assert solved(folder, folder).stderr == ""
    for place in (folder, *folder.rglob("*")):
        place.chmod(place.stat().st_mode & ~0o222)
    yield folder
    for place in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
        place.chmod(0o755)


def solved(package: Path, temporary: Path, code: str = SOLVE) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if "CACHE" not in name}
    environment |= {"HOME": str(package / "home"), "PYTHONPATH": str(package)}
    return subprocess.run(
        [sys.executable, "-c", code],
        env=environment | {"TMPDIR": str(temporary)},
        cwd=package,
        preexec_fn=as_anybody,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_they_go_to_a_folder_of_the_user_alone_with_what_was_compiled_before(
    package: Path, tmp_path: Path
) -> None:
    place = tmp_path / f"tpcd-{loops.__version__}-{os.getuid()}"
    note = f"note: neither {package / 'tpcd'} nor a cache of the user can be written"
    for _ in range(2):
        found = solved(package, tmp_path)
        assert found.stderr == f"{note}; compiled loops are kept in {place}\n"
        assert found.stdout.splitlines()[:1] == ["[1, 0] [0, 0]"]
        assert stat.S_IMODE(place.stat().st_mode) == 0o700
        assert list(place.glob("qp_*/batch._solve_batch_3*.nbc"))


def test_without_a_temporary_folder_each_process_compiles_them(
    package: Path, tmp_path: Path
) -> None:
    nowhere = 'import tempfile\ndef none(): raise FileNotFoundError("none")\n'
    nowhere += "tempfile.gettempdir = none\n"
    found = solved(package, tmp_path, nowhere + SOLVE)
    note = f"note: neither {package / 'tpcd'} nor a cache of the user can be written"
    assert found.stderr == f"{note}, so that each process compiles its loops\n"
    assert found.stdout.splitlines()[:1] == ["[0, 0] [1, 0]"]
    assert solved(package, tmp_path).stdout.splitlines()[1] == found.stdout.splitlines()[1]


def test_a_cache_of_the_user_gets_what_is_compiled_beside_the_sources(
    package: Path, tmp_path: Path
) -> None:
    code = f"import os\nos.environ['XDG_CACHE_HOME'] = {str(tmp_path)!r}\n" + SOLVE
    found = solved(package, tmp_path, code)
    assert found.stderr == "" and found.stdout.splitlines()[0] == "[1, 0] [0, 0]"
    assert list(tmp_path.glob("numba/qp_*/batch._solve_batch_3*.nbc"))


@pytest.mark.parametrize("trap", ["open to others", "a link", "a file"])
def test_a_folder_that_others_could_write_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trap: str
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    place = loops._own_folder()
    assert place is not None and place.parent == tmp_path and place == loops._own_folder()
    place.rmdir()
    if trap == "open to others":
        place.mkdir()
        place.chmod(0o777)
    elif trap == "a link":
        (tmp_path / "theirs").mkdir(mode=0o700)
        place.symlink_to("theirs")
    else:
        place.write_text("")
    other = loops._own_folder()
    assert other is not None and other.parent == tmp_path
    assert other.name not in (place.name, "theirs")
    assert stat.S_IMODE(other.stat().st_mode) == 0o700
