"""Make episodes in simulation: an outline in the hand, a random scene, a motion, noise.

python scripts/simulate.py --outline mug --out runs/mug
python scripts/simulate.py --outline 006_mustard_bottle --policy test --episodes 3 --out runs/m
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from tpcd.cli import check_numbers, run
from tpcd.numerals import NUMBER

SCENE_STREAM, EPISODE_STREAM = 0, 1
"""Independent random streams, so that the scene depends on the seed alone."""

TOUCHING = 2e-4
"""Clearance under which the summary counts a step as touching [m]."""

METRES, RADIANS = (5.0, "m", "millimetres"), (2 * math.pi, "rad", "degrees")
LIMITS = {
    **dict.fromkeys(("mount_x", "mount_z", "floor_height", "wall_position"), METRES),
    **dict.fromkeys(("start x", "start z"), METRES),
    **dict.fromkeys(("mount_phi", "start phi"), RADIANS),
    "noise_position": (0.05, "m", "millimetres"),
    "noise_angle": (0.5, "rad", "degrees"),
}
"""Sizes beyond which a value was meant in another unit, as in episodes."""
PHYSICAL = ("start", "stiffness", "scale", "mount_x", "mount_z", "mount_phi", "friction",
            "floor_height", "wall_position", "effects")  # fmt: skip
NOISE = {
    "noise_position": ("x", "z"),
    "noise_angle": ("phi",),
    "noise_force": ("F_x", "F_z"),
    "noise_torque": ("tau",),
}
"""What can make a row of the episode one that no recording has; noise of its columns only."""
FILE_ENDINGS = (".csv", ".parquet", ".yaml", ".truth.csv", ".truth.yaml")
"""Of the files that an episode here can have."""


@dataclass(frozen=True)
class Simulation:
    """What to simulate; equal seeds give equal scenes, whatever the motion and noise."""

    outline: str
    """Name of a built-in or YCB outline, or a file (.npz, .csv, .svg or a mesh)."""
    out: Path
    """Folder for the episodes NAME.csv, NAME.yaml and their NAME.truth.csv, .truth.yaml."""
    truth: Literal["quasistatic", "mujoco"] = "mujoco"
    """Who decides what happens: the project's own model, or MuJoCo independent of it."""
    policy: Literal["rich", "press_and_slide", "diagnosis", "test"] = "rich"
    """Motion: touch-driven exploration, the paper's basic one, one that excites the effects
    which a diagnosis looks for, or a smooth test trajectory."""
    steps: int = 15
    """Commands after the start pose of each episode."""
    episodes: int = 1
    """Number of episodes, all from the same start pose in the same scene."""
    seed: int = 0
    """Seed of scene, motion and noise."""
    name: str | None = None
    """Name of the episodes (default: the policy); several are numbered."""
    noise_position: float = 2e-4
    """Standard deviation of the measured x and z [m]."""
    noise_angle: float = 5e-4
    """Standard deviation of the measured angle [rad]."""
    noise_force: float = 0.3
    """Standard deviation of the measured forces [N]."""
    noise_torque: float = 0.02
    """Standard deviation of the measured torque [N·m]."""
    stiffness: tuple[float, float, float] = (100.0, 100.0, 50.0)
    """Stiffness of the arm along x, z [N/m] and about y [N·m/rad]."""
    scale: float | None = None
    """Scale of the object instead of a random one."""
    mount_x: float | None = None
    """x of the object in the hand instead of a random one [m]."""
    mount_z: float | None = None
    """z of the object in the hand instead of a random one [m]."""
    mount_phi: float | None = None
    """Angle of the object in the hand instead of a random one [rad]."""
    friction: float | None = None
    """Friction coefficient instead of a random one."""
    floor_height: float | None = None
    """World z of the floor instead of a random one [m]."""
    wall_position: float | None = None
    """World x of the wall instead of a random one [m]."""
    effects: tuple[str, ...] = ()
    """Effects that the truth has besides, as `floor_compliance.compliance=2e-4`, in SI units."""
    start: tuple[float, ...] = ()
    """Start pose x z phi instead of one 10 to 20 mm above the floor [m, m, rad]."""
    unit: Literal["m", "cm", "mm", "in", "pt", "px"] | None = None
    """Unit of the outline file's coordinates instead of metres, or of what an SVG says."""
    format: Literal["csv", "parquet"] = "csv"
    """Format of the episode's table."""
    overwrite: bool = False
    """Replace episodes of the same name."""

    def __post_init__(self) -> None:
        noise = ("noise_position", "noise_angle", "noise_force", "noise_torque")
        check_numbers(
            self,
            least={"steps": 1, "episodes": 1, "friction": 0.0, **dict.fromkeys(noise, 0.0)},
            above={"stiffness": 0.0, "scale": 0.0},
        )
        for name, (largest, unit, likely) in LIMITS.items():
            value = self._value(name)
            if value is not None and abs(value) > largest:
                raise ValueError(f"{name} is {value:g}, expected {unit}; it looks like {likely}")
        if self.name is not None and (not self.name or Path(self.name).name != self.name):
            raise ValueError(f"name is {self.name!r}, expected a file name without a folder")

    @property
    def hidden(self) -> dict[str, dict[str, float]]:
        """The effects with their parameters."""
        found: dict[str, dict[str, float]] = {}
        for text in self.effects:
            path, _, value = text.partition("=")
            effect, _, parameter = path.partition(".")
            if not NUMBER.fullmatch(value) or not parameter:
                raise ValueError(f"effects has {text!r}, expected EFFECT.PARAMETER=NUMBER")
            if parameter in found.setdefault(effect, {}):
                raise ValueError(f"effects has {path} twice, expected one number for it")
            found[effect][parameter] = float(value)
        return found

    def check_units(self, longest: float) -> None:
        """Refuse what looks like another unit, for an object so long at scale 1 [m]; ValueError."""
        import torch

        from tpcd.contract import check_effect, check_stiffness
        from tpcd.effects.catalogue import unit_of
        from tpcd.parameters import DEFAULT_BOUNDS
        from tpcd.shape.outline import LARGEST_SIZE, SMALLEST_SIZE

        check_stiffness(torch.tensor(self.stiffness, dtype=torch.float64), insist="")
        for effect, given in self.hidden.items():
            for parameter, value in given.items():
                check_effect(effect, parameter, value, unit_of(effect, parameter))
        smaller, larger = DEFAULT_BOUNDS["scale"]
        least, most = smaller * SMALLEST_SIZE, larger * LARGEST_SIZE
        if self.scale is not None and not least <= self.scale * longest <= most:
            raise ValueError(
                f"scale is {self.scale:g}, which makes the object {self.scale * longest:.3g} m"
                f" long, expected {least:g} to {most:g} m: give the ratio of its size to the"
                " outline's"
            )

    def blamed(self, problem: str) -> str:
        """What the episode would have wrong, with the options in front that may have done it."""
        columns = set(re.findall(r"\w+", problem.partition(":")[0]))
        noise = [name for name, own in NOISE.items() if columns.intersection(own)]
        usual = {field.name: field.default for field in fields(self)}
        given = [name for name in (*noise, *PHYSICAL) if getattr(self, name) != usual[name]]
        options = " and ".join(f"--{name}" for name in given or ("policy", "seed"))
        verb = "makes" if len(given) == 1 else "make"
        problem = problem.partition("; convert it")[0]
        return f"{options} {verb} an episode that cannot be, {problem}; choose other values"

    def _value(self, name: str) -> float | None:
        """A field, or the entry `start x`, `start z` or `start phi` of the start pose."""
        if not name.startswith("start "):
            return getattr(self, name)
        place = ("start x", "start z", "start phi").index(name)
        return self.start[place] if place < len(self.start) else None


def simulate(config: Simulation) -> None:
    """Simulate episodes of an object in the hand that touches a floor and a wall."""
    import sys
    from contextlib import ExitStack

    import numpy as np
    import torch

    from tpcd.data.files import write_together
    from tpcd.errors import EpisodeError
    from tpcd.files import to_plain
    from tpcd.ownership import owned
    from tpcd.parameters import SCENE_NAMES
    from tpcd.random import stream
    from tpcd.shape.named import find_outline
    from tpcd.targets import check_target
    from tpcd.truth.make import make_truth
    from tpcd.truth.recording import make_motion, record, recording_contents
    from tpcd.truth.scene import draw_scene
    from tpcd.versions import versions

    torch.set_num_threads(1)
    name = config.name or config.policy
    names = [name] if config.episodes == 1 else [f"{name}_{i}" for i in range(config.episodes)]
    with ExitStack() as held:
        for stem in names:
            held.enter_context(owned(config.out / stem, "scripts/simulate.py"))
        for file in [f"{stem}{ending}" for stem in names for ending in FILE_ENDINGS]:
            check_target(config.out / file, config.overwrite)
        outline = find_outline(config.outline, config.unit)
        config.check_units(float(np.ptp(outline.vertices, axis=0).max()))
        given = {name: getattr(config, name) for name in SCENE_NAMES}
        scene = draw_scene(
            outline.name,
            outline.vertices,
            stream(config.seed, SCENE_STREAM),
            fixed={name: value for name, value in given.items() if value is not None},
            stiffness=config.stiffness,
            start_pose=config.start or None,
        )
        position, angle = config.noise_position, config.noise_angle
        force, torque = config.noise_force, config.noise_torque
        sensor_std = torch.tensor(
            [position, position, angle, force, force, torque], dtype=torch.float64
        )
        truth = make_truth(scene, config.truth, config.hidden, config.steps)
        notes = f"simulated, truth {config.truth}, motion {config.policy}, seed {config.seed}"
        made_by = {"command": "scripts/simulate.py", "config": to_plain(config), **versions()}
        contents, lines = {}, []
        for episode, stem in enumerate(config.out / name for name in names):
            generator = stream(config.seed, EPISODE_STREAM, episode, *config.policy.encode())
            motion = make_motion(config.policy, scene, config.steps, generator)
            try:
                recording = record(
                    truth, scene, motion, config.steps, generator, sensor_std, notes=notes
                )
                contents.update(recording_contents(recording, scene, stem, config.format, made_by))
            except (EpisodeError, ValueError) as error:
                problem = error.problem if isinstance(error, EpisodeError) else str(error)
                raise ValueError(config.blamed(problem)) from error
            reach = [scene.clearances(pose) for pose in recording.true.poses[1:]]
            lines.append(
                f"{stem}.{config.format}: {config.steps} steps,"
                f" {sum(floor < TOUCHING for floor, _ in reach)} touch the floor,"
                f" {sum(wall < TOUCHING for _, wall in reach)} the wall,"
                f" {recording.settled.count(False)} did not settle"
            )
        write_together(contents, config.overwrite)
    if Path(config.outline).suffix and outline.notes:
        print(f"note: {config.outline}: {outline.notes}", file=sys.stderr)
    theta = " · ".join(f"{name} {value:.4g}" for name, value in scene.theta.items())
    print("\n".join((f"{outline.name}: {theta}", *lines)))


if __name__ == "__main__":
    run(simulate, Simulation)
