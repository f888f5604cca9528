"""The page of results: every figure in it comes from `results.json`.

python -m eval.measured.page runs/measured puts page and results of a run beside this file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tpcd.cli import run
from tpcd.files import read_json, write_json, write_text
from tpcd.identification.quantity import Quantity

HEAD = """# Real recordings

`TPCD_MEASURED=FOLDER python -m eval.measured --out runs/measured` measures, and
`python -m eval.measured.page runs/measured` writes this page from the `results.json` beside it. The
recordings are other people's (sources below), most of them without a licence: they are read where
they are, and nothing of them is shipped but the figures here. Intervals hold the truth at the level
stated, if the model of arm and sensor (`tpcd/quality`) does.
"""
SOURCES = {
    "ati_static_poses": "ATI Axia80 on an arm, a tool of about 1.1 kg, no contact"
    " (github.com/leledeyuan00/Gravity-Compensation-F-T-sensor)",
    "franka_taskboard": "Franka Panda under Cartesian impedance on a task board, 20 Hz"
    " (github.com/platonics-delft/platonics_dataset)",
    "iiwa_screw_contact": "KUKA iiwa pressing a screw"
    " (github.com/l0g1c-80m8/screw-dynamics-sindy, MIT)",
    "pbal_impedance": "Franka Panda pivoting an object on a table through a flat palm"
    " (github.com/mcubelab/pbal; arXiv 2203.01203)",
}


def write_page(results: Path, page: Path) -> None:
    """Write the page of a run."""
    write_text(page, page_text(read_json(results)))


def publish(source: Path, folder: Path) -> None:
    """Page and results of a run, without places of the machine that it ran on."""
    results = read_json(source / "results.json")
    results["config"].pop("out", None)
    results["versions"].pop("folder", None)
    write_json(folder / "results.json", results)
    write_page(folder / "results.json", folder / "README.md")


def page_text(results: Mapping[str, Any]) -> str:
    """The page as Markdown."""
    parts = [HEAD, _summary(results["recordings"])]
    for each in results["recordings"]:
        parts.append(f"## {each['name']}\n\n{SOURCES[each['set']]}; {each['samples']} samples.\n")
        parts += [" ".join(each["notes"]) + "\n"] if each["notes"] else []
        parts += [_known(each["known"])] if each["known"] else []
        parts += [_balance(each["balance"])] if "balance" in each else []
        parts += [_checked(each["checked"]), _told(each["told"])]
        parts += [_said(command) for command in each["commands"]]
    git = results["versions"]["git"] or {}
    parts.append(f"Revision {git.get('revision')}, {results['versions']['date_utc']}.\n")
    return "\n".join(parts)


def _summary(recordings: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| recording | check | quantities told | known values held | exit codes |",
        "|---|---|---|---|---|",
    ]
    for each in recordings:
        told = sum(row["value"] is not None for row in each["told"])
        held = sum(row["holds"] for row in each["known"])
        known = f"{held} of {len(each['known'])}" if each["known"] else "–"
        codes = ", ".join(f"{Path(row['command']).stem} {row['code']}" for row in each["commands"])
        count = f"{told} of {len(each['told'])}"
        lines.append(
            f"| {each['name']} | {each['checked']['verdict']} | {count} | {known} | {codes} |"
        )
    return "\n".join(lines) + "\n"


def _quantity(row: Mapping[str, Any]) -> Quantity:
    fields = {name: row[name] for name in Quantity.__dataclass_fields__}
    if fields["interval"] is not None:
        fields["interval"] = tuple(fields["interval"])
    return Quantity(**fields)


def _known(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = ["| | by those who recorded it | here | at | holds |", "|---|---|---|---|---|"]
    for row in rows:
        found = _quantity(row)
        told = "not told"
        if found.interval is not None and isinstance(found.value, float):
            low, high = found.interval
            told = f"{found.value:.3f} ({low:.3f} to {high:.3f})"
        name = f"{found.name.replace('_', ' ')} [{found.unit}]"
        word = "yes" if row["holds"] else "**no**"
        lines.append(f"| {name} | {row['known']:.3f} | {told} | {found.level:.0%} | {word} |")
    return "\n".join(lines) + "\n"


def _checked(found: Mapping[str, Any]) -> str:
    lines = [f"`scripts/check.py` ends with {found['code']}: {found['verdict']}.\n"]
    lines += [f"- {each}" for each in found["findings"]]
    columns = ("noise of a sample", "noise of a row")
    noise = [row for row in found["noise"] if any(row[name] is not None for name in columns)]
    if not noise:
        return "\n".join([*lines, "\nIt does not rest, so noise is not told.\n"])
    lines += ["", "| channel | noise of a sample | noise of a row of 0.5 s |", "|---|---|---|"]
    for row in noise:
        told = [f"{row[n]:.2g} {row['unit']}" if row[n] is not None else "–" for n in columns]
        lines.append(f"| {row['channel']} | {' | '.join(told)} |")
    return "\n".join(lines) + "\n"


def _told(rows: Sequence[Mapping[str, Any]]) -> str:
    found = [_quantity(row) for row in rows]
    lines = [f"- {each}" for each in found if each.told]
    reasons: dict[tuple[str, str], list[str]] = {}
    for each in found:
        if not each.told:
            reasons.setdefault((each.reason, each.motion), []).append(each.name.replace("_", " "))
    for (reason, motion), names in reasons.items():
        move = f"; move so: {motion}" if motion else ""
        lines.append(f"- {', '.join(names)}: the data cannot tell, because {reason}{move}")
    return "What arm and sensor are found to be:\n\n" + "\n".join(lines) + "\n"


def _said(command: Mapping[str, Any]) -> str:
    said = "\n".join(command["said"])
    return f"`{command['command']}` ends with {command['code']} and says\n\n```\n{said}\n```\n"


def _balance(found: Mapping[str, Mapping[str, float]]) -> str:
    lines = [
        "What springs and weight leave of the moments about the pivot at rest [N·m], by the side"
        " from which the palm came:\n",
        "| geometry | from below | from above | scatter of holds |",
        "|---|---|---|---|",
    ]
    for name, row in found.items():
        lines.append(f"| {name} | {row['below']:.2f} | {row['above']:.2f} | {row['scatter']:.2f} |")
    right = found["as derived"]
    lines.append(
        f"\nWith the geometry as derived the rest is {right['below']:.2f} N·m in all"
        f" {right['below_holds']} holds that came from below and {right['above']:.2f} in all"
        f" {right['above_holds']} from above: dry friction, of the arm or at the pivot, holds so"
        " much against the last motion, and K (x - u) is not what the object is pressed with by as"
        " much.\n"
    )
    return "\n".join(lines)


@dataclass(frozen=True)
class Page:
    """Settings of the command."""

    run: Path
    """Run folder that python -m eval.measured wrote."""


def write(config: Page) -> None:
    """Put page and results of a run beside this file."""
    publish(config.run, Path(__file__).parent)


if __name__ == "__main__":
    run(write, Page, positional=("run",), prog="python -m eval.measured.page")
