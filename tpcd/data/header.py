"""The YAML beside an episode: stiffness, sensor noise and what else is known of the scene.

Keys: `stiffness` [N/m, N/m, N·m/rad] is required, and so is `sensor_std` (x, z [m], phi [rad],
F_x, F_z [N], tau [N·m]) but for a diagnosis, which can estimate it; `object`, `notes`,
`time_step_s` [s], `priors` (name of a scene parameter to [low, high], SI) and `doubts` (see
`doubts`) are optional, and `commands: unknown` marks a recording without set points (see
`measured`); anything else is refused with a hint.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from tpcd.contract import check_noise, check_prior, check_stiffness
from tpcd.data.doubts import encode_doubts, parse_doubts
from tpcd.errors import EpisodeError
from tpcd.numerals import NUMBER
from tpcd.parameters import SCENE_NAMES, SCENE_UNITS
from tpcd.plain_yaml import read_yaml, to_yaml
from tpcd.quality.finding import Finding

KEYS = (
    *("stiffness", "sensor_std", "object", "notes", "time_step_s", "priors", "commands"),
    *("unusual", "doubts"),
)
ESTIMATE_NOISE = (
    "hold the arm still without contact, record for about 10 s and give the standard deviation"
    " of x, z [m], phi [rad], F_x, F_z [N], tau [N·m], e.g."
    " sensor_std: [0.0002, 0.0002, 0.0005, 0.3, 0.3, 0.02]"
)


@dataclass(frozen=True)
class Header:
    """What the YAML of an episode says, in SI units."""

    stiffness: tuple[float, ...]
    sensor_std: tuple[float, ...] | None
    """None where the YAML does not say."""
    object: str | None
    notes: str | None
    time_step_s: float | None
    priors: dict[str, tuple[float, float]]
    commands_known: bool = True
    """False where the set points were not recorded."""
    unusual: bool = False
    """Whether numbers that look like another unit are meant so."""
    doubts: tuple[Finding, ...] = ()
    """What it was accepted in spite of."""


def read_header(path: Path) -> Header:
    """Read and check NAME.yaml; raises `EpisodeError` naming the key."""
    if not path.is_file():
        raise EpisodeError(
            path,
            "no such file: every episode has a YAML beside its table",
            "write one with the keys stiffness and sensor_std",
        )
    return parse_header(read_yaml(path, EpisodeError), path)


def parse_header(content: Any, path: Path) -> Header:
    """Check the parsed YAML of an episode; `path` only names the file in errors."""
    if not isinstance(content, dict):
        found = "an empty file" if content is None else type(content).__name__
        raise EpisodeError(path, f"found {found}, expected keys", "give stiffness and sensor_std")
    for key in content:
        _check_known(path, "key", str(key), KEYS)
    if "stiffness" not in content:
        raise EpisodeError(path, "key stiffness is missing", "e.g. stiffness: [100, 100, 50]")
    stiffness = _numbers(path, "stiffness", content["stiffness"], 3, "[N/m, N/m, N·m/rad]")
    for axis, value in zip(("x", "z", "phi"), stiffness, strict=True):
        if value <= 0:
            raise EpisodeError(
                path, f"stiffness of {axis} is {value:g}, expected > 0", "give the controller's K"
            )
    unusual = content.get("unusual", False)
    if not isinstance(unusual, bool):
        raise EpisodeError(path, f"unusual is {unusual!r}, expected true or false", "leave it out")
    try:
        check_stiffness(
            torch.tensor(stiffness, dtype=torch.float64),
            unusual,
            ", or insist with unusual: true",
        )
    except ValueError as error:
        fault, _, remedy = str(error).partition("; ")
        raise EpisodeError(path, fault, remedy) from error
    sensor_std = None
    if "sensor_std" in content:
        sensor_std = _sensor_std(path, content["sensor_std"], unusual)
    time_step = content.get("time_step_s")
    if time_step is not None:
        time_step = _number(path, "time_step_s", time_step)
        if time_step <= 0:
            raise EpisodeError(path, f"time_step_s is {time_step:g}, expected > 0", "give seconds")
    commands = content.get("commands", "known")
    if commands not in ("known", "unknown"):
        raise EpisodeError(
            path, f"commands is {commands!r}, expected known or unknown", "they stand in the table"
        )
    return Header(
        stiffness=tuple(stiffness),
        sensor_std=sensor_std,
        object=_text(path, "object", content.get("object")),
        notes=_text(path, "notes", content.get("notes")),
        time_step_s=time_step,
        priors=_priors(path, content.get("priors"), unusual),
        commands_known=commands == "known",
        unusual=unusual,
        doubts=parse_doubts(path, content.get("doubts")),
    )


def encode_header(header: Header) -> bytes:
    """Content of NAME.yaml; floats keep every bit, keys that say nothing are left out."""
    content: dict[str, Any] = {"stiffness": list(header.stiffness)}
    if header.sensor_std is not None:
        content["sensor_std"] = list(header.sensor_std)
    if not header.commands_known:
        content["commands"] = "unknown"
    if header.unusual:
        content["unusual"] = True
    for key in ("object", "notes", "time_step_s"):
        if getattr(header, key) is not None:
            content[key] = getattr(header, key)
    if header.priors:
        content["priors"] = {
            name: [float(low), float(high)] for name, (low, high) in header.priors.items()
        }
    if header.doubts:
        content["doubts"] = encode_doubts(header.doubts)
    return to_yaml(content, flow=True).encode("utf-8")


def _sensor_std(path: Path, value: Any, unusual: bool) -> tuple[float, ...]:
    sensor_std = _numbers(
        path, "sensor_std", value, 6, "[x, z, phi, F_x, F_z, tau]", ESTIMATE_NOISE
    )
    try:
        check_noise("sensor_std", torch.tensor(sensor_std, dtype=torch.float64), unusual)
    except ValueError as error:
        fault, _, remedy = str(error).partition(": ")
        raise EpisodeError(path, fault, remedy or ESTIMATE_NOISE) from error
    return tuple(sensor_std)


def _priors(path: Path, content: Any, unusual: bool) -> dict[str, tuple[float, float]]:
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise EpisodeError(
            path,
            f"priors is {content!r}, expected name: [low, high]",
            f"names are {', '.join(SCENE_NAMES)}",
        )
    priors: dict[str, tuple[float, float]] = {}
    for name, value in content.items():
        _check_known(path, "prior", str(name), SCENE_NAMES)
        unit = SCENE_UNITS[SCENE_NAMES.index(name)]
        low, high = _numbers(path, f"priors: {name}", value, 2, f"[low, high] [{unit}]")
        try:
            check_prior(name, (low, high), unit, unusual)
        except ValueError as error:
            raise EpisodeError(path, *str(error).split("; ", 1)) from None
        priors[name] = (low, high)
    return priors


def _check_known(path: Path, kind: str, name: str, known: tuple[str, ...]) -> None:
    if name in known:
        return
    close = difflib.get_close_matches(name, known, 1, 0.6)
    remedy = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
    if kind == "key" and not close:
        remedy += "; put remarks under notes"
    raise EpisodeError(path, f"unknown {kind} {name!r}", remedy)


def _numbers(
    path: Path, key: str, value: Any, count: int, meaning: str, remedy: str = ""
) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        found = f"{len(value)} entries" if isinstance(value, list) else repr(value)
        raise EpisodeError(
            path, f"{key}: found {found}, expected {count} numbers {meaning}", remedy or "complete"
            " the list",
        )  # fmt: skip
    return [_number(path, key, entry) for entry in value]


def _number(path: Path, key: str, value: Any) -> float:
    """A finite number, in quotes or not."""
    text = value if isinstance(value, str) and NUMBER.fullmatch(value) else "nan"
    number = float(value if type(value) in (int, float) else text)
    if not math.isfinite(number):
        raise EpisodeError(
            path, f"{key}: found {value!r}, expected a finite number", "write a plain number"
        )
    return number


def _text(path: Path, key: str, value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    if type(value) is int:
        return str(value)
    raise EpisodeError(path, f"{key}: found {value!r}, expected text", "put it in quotes")
