"""The motion that a diagnosis needs: made in simulation, planned for a robot, or completed.

python scripts/plan_diagnosis.py --object mug --out runs/mug/diagnosis
python scripts/plan_diagnosis.py --start 0 0.12 0 --floor-height 0.05 --wall-position 0.1 \
    --out commands.csv
python scripts/plan_diagnosis.py --after runs/mug/diagnosis.csv
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tpcd.truth.diagnosis_plan import Planned

ROOM = 0.002
"""What the limits of the arm leave besides [m]."""


@dataclass(frozen=True)
class Planning:
    """Give one of object (simulate the motion, which feels its way), start (plan commands
    beforehand) and after (what episodes lack); SI units."""

    object: str | None = None
    """Outline to simulate the motion with, as in simulate.py --policy diagnosis."""
    start: tuple[float, ...] = ()
    """Free pose x z phi that a planned motion starts from [m, m, rad]."""
    after: tuple[Path, ...] = ()
    """Episodes of one set-up: say which excitations they lack and what would give them."""
    out: Path | None = None
    """Episode NAME to simulate, or CSV file for the plan."""
    floor_height: float | None = None
    """z of the hand when the upright object touches the floor, roughly [m]."""
    wall_position: float | None = None
    """x of the hand when the upright object touches the wall, roughly [m]."""
    error: float = 0.01
    """How far off floor height and wall position may be [m]; forces stay within 8 N even then."""
    stiffness: tuple[float, float, float] = (100.0, 100.0, 50.0)
    """Stiffness of the arm along x, z [N/m] and about y [N·m/rad]."""
    steps: int = 60
    """Commands after the start pose."""
    truth: Literal["quasistatic", "mujoco"] = "mujoco"
    """Who decides what happens in simulation."""
    seed: int = 0
    """Seed of the simulated scene, motion and noise."""
    overwrite: bool = False
    """Replace existing files."""

    def __post_init__(self) -> None:
        check_numbers(self, least={"steps": 1, "error": 0.0}, above={"stiffness": 0.0})
        given = [name for name in ("object", "start", "after") if getattr(self, name)]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"found {found} of --object, --start and --after, expected one")
        if not self.after and self.out is None:
            raise ValueError("out missing; name the file to write with --out")
        if self.start:
            self._check_plan()

    def _check_plan(self) -> None:
        from tpcd.contract import LARGEST_ANGLE, LARGEST_LENGTH
        from tpcd.truth.motions import LARGEST_TILT

        if len(self.start) != 3:
            raise ValueError(f"start has {len(self.start)} numbers, expected x z phi [m, m, rad]")
        places = {"floor_height": self.floor_height, "wall_position": self.wall_position}
        for name, value in {**places, "start x": self.start[0], "start z": self.start[1]}.items():
            if value is None:
                raise ValueError(f"a plan needs --{name}: where the hand is at touch, roughly [m]")
            if abs(value) > LARGEST_LENGTH:
                raise ValueError(f"{name} is {value:g}, expected m; it looks like millimetres")
        if abs(self.start[2]) > LARGEST_ANGLE:
            told = f"start phi is {self.start[2]:g}, expected rad; it looks like degrees"
            raise ValueError(told)
        if abs(self.start[2]) > LARGEST_TILT:
            raise ValueError(
                f"start phi is {self.start[2]:g}, expected at most {LARGEST_TILT:g} either way:"
                " plans hold the object about phi = 0; turn the hand first, or count phi from"
                " where it is"
            )


def plan_diagnosis(config: Planning) -> None:
    """Simulate or plan the motion that a diagnosis needs, or say what episodes lack for one."""
    import torch

    from tpcd.ownership import owned

    torch.set_num_threads(1)
    with nullcontext() if config.out is None else owned(config.out, "scripts/plan_diagnosis.py"):
        if config.object is not None:
            _simulate(config, config.object)
        elif config.start:
            _plan(config)
        else:
            _complete(config)


def _simulate(config: Planning, name: str) -> None:
    from tpcd.random import stream
    from tpcd.shape.named import find_outline
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import make_motion, record, write_recording
    from tpcd.truth.scene import draw_scene

    assert config.out is not None
    outline = find_outline(name)
    # Streams as in simulate.py, so that equal seeds mean equal episodes.
    scene = draw_scene(
        outline.name, outline.vertices, stream(config.seed, 0), stiffness=config.stiffness
    )
    generator = stream(config.seed, 1, 0, *b"diagnosis")
    motion = make_motion("diagnosis", scene, config.steps, generator)
    notes = f"simulated, truth {config.truth}, motion diagnosis, seed {config.seed}"
    recording = record(
        make_truth(scene, config.truth), scene, motion, config.steps, generator, notes=notes
    )
    path = write_recording(recording, scene, config.out, overwrite=config.overwrite)
    print(f"{path}: {config.steps} steps, {recording.settled.count(False)} did not settle")


def _plan(config: Planning) -> None:
    import csv
    import io

    import torch

    from tpcd.files import write_text
    from tpcd.targets import check_target
    from tpcd.truth.diagnosis_plan import diagnosis_plan

    assert config.out is not None
    assert config.floor_height is not None and config.wall_position is not None
    check_target(config.out, config.overwrite)
    plan = diagnosis_plan(
        torch.tensor(config.start, dtype=torch.float64),
        config.floor_height,
        config.wall_position,
        torch.tensor(config.stiffness, dtype=torch.float64),
        config.steps,
        config.error,
    )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["u_x", "u_z", "u_phi", "purpose"])
    for planned in plan:
        writer.writerow([*(f"{value:.6f}" for value in planned.command), planned.purpose])
    write_text(config.out, text.getvalue())
    print(
        f"{config.out}: the start pose and {len(plan) - 1} commands, for an object that touches"
        f" the floor with the hand at z = {config.floor_height:g} m and the wall at x ="
        f" {config.wall_position:g} m, both within {1e3 * config.error:g} mm; try the first ones"
        " with a hand at the stop button"
    )
    print(
        "to run it, with the hand at the start pose and X Y Z where x = z = 0 of the plan is in the"
        f" base frame:\n{_robot_line(config, config.out, plan)}"
    )


def _robot_line(config: Planning, out: Path, plan: Sequence[Planned]) -> str:
    """The command that runs a plan on an arm, with the workspace and steps that it needs, since
    commands beyond them would be drawn back."""
    from shlex import join

    from tpcd.commands.exploring_options import ARM_HIGH, ARM_LOW, ExploringOptions
    from tpcd.truth.motions import FORCE_LIMIT

    usual = {
        "workspace_low": ARM_LOW,
        "workspace_high": ARM_HIGH,
        "step_limit": ExploringOptions.step_limit,
    }
    places = list(zip(*(planned.command for planned in plan), strict=True))
    room = (config.error + ROOM, config.error + ROOM, 0.0)
    needed = {
        "workspace_low": [min(axis) - more for axis, more in zip(places, room, strict=True)],
        "workspace_high": [max(axis) + more for axis, more in zip(places, room, strict=True)],
        "step_limit": [*(FORCE_LIMIT / k + ROOM for k in config.stiffness[:2]), 0.0],
    }
    words = ["python", "scripts/robot.py", "--robot", "ADDRESS", "--origin", "X", "Y", "Z"]
    words += ["--policy", "file", "--commands", str(out), "--steps", str(len(plan) - 1)]
    words += ["--stiffness", *(f"{value:g}" for value in config.stiffness)]
    for name, values in usual.items():
        farther = min if name == "workspace_low" else max
        asked = tuple(map(farther, values, needed[name]))
        if asked != values:
            words += [f"--{name}", *(f"{value:.3f}" for value in asked)]
    return join([*words, "--out", "RUN"])


def _complete(config: Planning) -> None:
    import sys

    from tpcd.discrepancy.checks import read_data
    from tpcd.discrepancy.coverage import coverage_of
    from tpcd.effects import CATALOGUE
    from tpcd.effects.excitations import MOTIONS
    from tpcd.results import format_table

    data = read_data(config.after)
    for warning in (*data.warnings, *data.notes):
        print(f"warning: {warning}", file=sys.stderr)
    if data.answer is not None:
        raise ValueError(data.answer.sentence)
    coverage = coverage_of(data.episodes)
    lacks = {effect.name: coverage.missing(effect.needs) for effect in CATALOGUE}
    rows = []
    for need, motion in MOTIONS.items():
        missing = bool(coverage.missing([need]))
        hidden = [name for name, needs in lacks.items() if need in needs]
        rows.append(
            {
                "excitation": need,
                "found": coverage.counts.get(need, 0.0),
                "enough": "no" if missing else "yes",
                "motion that gives it": motion if missing else "",
                "hardly excited": ", ".join(hidden),
            }
        )
    print(format_table(rows))
    blind = [name for name, needs in lacks.items() if needs]
    if blind:
        print(
            f"\n{len(blind)} of {len(lacks)} effects are hardly excited: {', '.join(blind)}; a"
            " diagnosis tries them all the same, and the motions above would show them"
        )
    else:
        print("\nnothing is missing: every effect of the catalogue would be excited")


if __name__ == "__main__":
    run(plan_diagnosis, Planning)
