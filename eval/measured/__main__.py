"""Real recordings through the commands, and what arm and sensor of each are found to be.

The sets are other people's and stay where they are; `TPCD_MEASURED` names their folder. What is
written are figures: `results.json`, and README.md made of it.

TPCD_MEASURED=FOLDER python -m eval.measured --out runs/measured
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tpcd.cli import run

if TYPE_CHECKING:
    from eval.measured.pivoting import Held
    from eval.measured.sets import Recording

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Measurements:
    """Settings of the command."""

    out: Path = Path("runs/measured")
    """Folder for the results."""
    prior: str = "ycb-rich"
    """Shape prior of estimate and diagnosis."""
    seed: int = 0
    """Seed of estimate and diagnosis."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""


def evaluate_measured(config: Measurements) -> None:
    """Check, identify and import every recording; estimate and diagnose the episode in a plane."""
    from eval.measured.page import write_page
    from eval.measured.pivoting import read_held
    from eval.measured.sets import FOLDER_VARIABLE, measured_folder, recordings
    from tpcd.errors import FileError
    from tpcd.results import run_folder, write_results

    folder = measured_folder()
    if folder is None:
        raise FileError(
            Path(FOLDER_VARIABLE), "is not set", "set it to the folder of the measured sets"
        )
    command = "python -m eval.measured"
    with run_folder(config.out, command, config, config.overwrite) as out:
        found: list[dict[str, Any]] = []
        for recording in recordings(folder, out / "tables"):
            print(recording.name, flush=True)
            found.append(_measured(recording, out))
        files = sorted((folder / "pbal_impedance").glob("*Stiffness*.json"))
        print("pbal", flush=True)
        found.append(_pivoted([read_held(path) for path in files], config, out))
        write_results(out, [], recordings=found, seeds=[config.seed])
        write_page(out / "results.json", out / "README.md")
    print(f"page in {config.out / 'README.md'}")


def _measured(recording: Recording, out: Path) -> dict[str, Any]:
    from tpcd.identification.identify import identify

    log = recording.read()
    told = [asdict(each) for each in identify(log)]
    known = [
        {"name": name, "known": value, **_holds(told, name, value)}
        for name, value in recording.known.items()
    ]
    about = {"name": recording.name, "set": recording.set, "samples": len(log)}
    about["notes"] = recording.notes
    checked, imported = _checked(recording, out), _imported(recording, out)
    return {**about, "checked": checked, "told": told, "known": known, "commands": [imported]}


def _holds(told: Sequence[dict[str, Any]], name: str, value: float) -> dict[str, Any]:
    found = next(each for each in told if each["name"] == name)
    interval = found["interval"]
    return {**found, "holds": interval is not None and interval[0] <= value <= interval[1]}


def _checked(recording: Recording, out: Path) -> dict[str, Any]:
    """Verdict, findings and noise of each channel, as check writes them."""
    from tpcd.errors import FileError
    from tpcd.files import read_json

    folder = out / f"check-{recording.table.stem}"
    said = _said("check", [*recording.arguments(), "--out", str(folder)], out)
    if not (folder / "results.json").is_file():
        raise FileError(recording.table, f"check ends with {said['code']}", "\n".join(said["said"]))
    results = read_json(folder / "results.json")
    noise = [
        {key: row[key] for key in ("channel", "unit", "noise of a sample", "noise of a row")}
        for row in results["table"]
    ]
    found = [f"{each['weight']}: {each['sentence']}" for each in results["findings"]]
    return {"code": said["code"], "verdict": results["verdict"], "findings": found, "noise": noise}


def _imported(recording: Recording, out: Path) -> dict[str, Any]:
    folder = str(out / f"import-{recording.table.stem}")
    stiffness = [f"{k:g}" for k in recording.stiffness]
    choices = ["--stiffness", *stiffness, *recording.more, "--out", folder]
    return _said("import_log", [*recording.arguments(), *choices], out)


def _said(script: str, arguments: Sequence[str], out: Path) -> dict[str, Any]:
    """Exit code and lines of a command, without places of this machine."""
    command = [sys.executable, str(ROOT / "scripts" / f"{script}.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    lines = [line.rstrip() for line in f"{done.stdout}\n{done.stderr}".splitlines()]
    # A bar of progress is no line of its own.
    kept = [line for line in lines if line.strip() and "%|" not in line]
    places = [str(out.absolute()), str(out), *(str(Path(a).parent) for a in arguments if "/" in a)]
    return {
        "command": f"scripts/{script}.py",
        "code": done.returncode,
        "said": [placeless(line, places) for line in kept],
    }


def placeless(line: str, places: Sequence[str]) -> str:
    """A line that names files in `places` without saying where those are."""
    for place in sorted(places, key=len, reverse=True):
        line = line.replace(f"{place}/", "")
    return line


def _pivoted(held: Sequence[Held], config: Measurements, out: Path) -> dict[str, Any]:
    from eval.measured.pivoting import NOTES, episode, joined
    from eval.measured.sets import Recording, write_table
    from tpcd.data.files import episode_contents, write_together
    from tpcd.identification.identify import identify

    columns = joined(held)
    table = write_table(out / "tables" / "pbal.csv", columns)
    entries = tuple(f"{name}={name}" for name in columns)
    x, z, phi = held[0].stiffness.tolist()
    recording = Recording("pbal", "pbal_impedance", table, entries, stiffness=(x, z, phi))
    log = recording.read()
    commands = [_imported(recording, out)]
    stem = out / "pbal" / "episode"
    stem.parent.mkdir()
    contents = episode_contents(episode(held), stem)
    write_together({path: data for path, data in contents.items() if data is not None})
    given = [str(stem.parent), "--prior", config.prior, "--seed", str(config.seed)]
    for script in ("estimate", "diagnose"):
        commands.append(_said(script, [*given, "--out", str(out / f"pbal-{script}")], out))
    about = {"name": "pbal", "set": "pbal_impedance", "samples": len(log), "notes": NOTES}
    told = [asdict(each) for each in identify(log)]
    found = {"checked": _checked(recording, out), "told": told, "known": []}
    return {**about, **found, "commands": commands, "balance": balance(held)}


def balance(held: Sequence[Held]) -> dict[str, Any]:
    """What is left of the moments about the pivot [N·m], by the side from which the palm came, with
    the geometry and with its mirror images: friction that the arm stops against is the same from
    hold to hold, a wrong geometry is not."""
    sides = np.array([np.sign(one.contact[0, 2]) for one in held])
    found = {}
    for name, mirror in (
        ("as derived", (1.0, 1.0)),
        ("theta mirrored", (-1.0, 1.0)),
        ("s mirrored", (1.0, -1.0)),
        ("both mirrored", (-1.0, -1.0)),
    ):
        left = np.array([one.moment_left(mirror) for one in held])
        parts = {word: left[sides == side] for word, side in (("below", -1.0), ("above", 1.0))}
        found[name] = {
            "scatter": float(np.sqrt(np.mean([part.var(ddof=1) for part in parts.values()]))),
            **{word: float(part.mean()) for word, part in parts.items()},
            **{f"{word}_holds": len(part) for word, part in parts.items()},
        }
    return found


if __name__ == "__main__":
    run(evaluate_measured, Measurements)
