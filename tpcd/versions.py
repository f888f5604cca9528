"""What the numbers of a run depend on besides its configuration: code and machine, and the folder
that its relative paths start from."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from tpcd import __version__

PACKAGES = (
    "torch",
    "numpy",
    "scipy",
    "lightning",
    "shapely",
    "trimesh",
    "jsonargparse",
    "numba",
    "qpth",
    "mujoco",
    "daqp",
    "osqp",
    "clarabel",
)


def versions() -> dict[str, Any]:
    """What the numbers of a run depend on besides its configuration: code and machine."""
    return {
        "date_utc": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "folder": os.getcwd(),
        "tpcd": __version__,
        "git": _git_state(),
        "python": platform.python_version(),
        "packages": {name: _package_version(name) for name in PACKAGES},
        "hardware": {
            "platform": platform.platform(),
            "cpu": _cpu_name(),
            "cpu_count": os.cpu_count(),
            "torch_threads": _from_torch(lambda torch: torch.get_num_threads()),
            "accelerator": _from_torch(
                lambda torch: torch.cuda.get_device_name() if torch.cuda.is_available() else None
            ),
        },
    }


def differing_parts(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Code and packages of which two `versions` tell different ones, in words."""
    found = []
    for name, old, new in (
        ("tpcd", before.get("tpcd"), now["tpcd"]),
        ("revision", _revision(before), _revision(now)),
        ("python", before.get("python"), now["python"]),
        *((name, (before.get("packages") or {}).get(name), new)
          for name, new in now["packages"].items()),
    ):  # fmt: skip
        if old != new:
            found.append(f"{name} {old or 'unknown'}, now {new or 'none'}")
    return found


def _revision(recorded: Mapping[str, Any]) -> str | None:
    return ((recorded.get("git") or {}).get("revision") or "")[:10] or None


def _git_state() -> dict[str, Any] | None:
    """Revision of the working copy this package lies in; None for an installed copy."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        revision = _git(root, "rev-parse", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return {"revision": revision, "dirty": bool(changed)}


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()


def _package_version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _cpu_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _from_torch(question: Any) -> Any:
    """Ask torch only where the command has loaded it already."""
    torch = sys.modules.get("torch")
    return None if torch is None else question(torch)
