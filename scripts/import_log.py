"""Turn a recording from elsewhere into an episode: see tpcd/logs/README.md.

python scripts/import_log.py run.csv --map time=t:ms x=X:mm z=Z:mm ... --stiffness 100 100 50 \
    --out runs/imported
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from tpcd.logs.importing import Imported
    from tpcd.logs.log import Log

EPISODE_NAME = "episode"
EXIT_NOT_ACCEPTED = 3
EXIT_DOUBTED = 4
IN_SPITE = "doubts"
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class LogImport:
    """Settings of the command; SI units."""

    log: Path
    """Recording: CSV (any separator), Parquet, ROS 1 bag, ROS 2 bag (folder, .db3) or MCAP."""
    stiffness: Triple
    """Stiffness of the impedance controller along x and z and about the angle's axis [N/m, N/m,
    N·m/rad]."""
    out: Path = Path("runs/imported")
    """Folder for the episode, the figure and what was found."""
    map: tuple[str, ...] = ()
    """Columns of a table, as NAME=COLUMN or NAME=COLUMN:UNIT: time, x y z, rx ry rz or qx qy qz qw
    or e1 e2 e3, F_x F_y F_z, T_x T_y T_z, u_x ... for the set point; or pose, command, wrench for
    columns COLUMN_0, COLUMN_1, ...; Universal Robots' RTDE names are known."""
    topics: tuple[str, ...] = ()
    """Topics of a bag, as pose=TOPIC, wrench=TOPIC, command=TOPIC; needed where several fit."""
    euler: str = "ZYX"
    """Axes of Euler angles e1 e2 e3; capitals for axes that turn along."""
    delay: tuple[str, ...] = ()
    """How late a stream is, as wrench=SECONDS, command=SECONDS or pose=SECONDS, to be taken off;
    or auto, as motion and force tell."""
    rate: float | None = None
    """Samples a second [Hz], for tables without times."""
    start: float | None = None
    """Leave out what comes before [s since the first sample]."""
    end: float | None = None
    """Leave out what comes after [s since the first sample]."""
    plane_x: Triple = (1.0, 0.0, 0.0)
    """Direction of the recording's world that is x."""
    plane_z: Triple = (0.0, 0.0, 1.0)
    """Direction of the recording's world that is z, up."""
    origin: Triple = (0.0, 0.0, 0.0)
    """Point of the recording's world that becomes the origin [m]."""
    tool_x: tuple[float, ...] = ()
    """Direction fixed to the end effector (three numbers) that points along x where the angle is 0;
    without it the angle is 0 at the start."""
    wrench_frame: Literal["world", "tool"] = "world"
    """Axes in which forces and torques are given."""
    wrench_point: Triple = (0.0, 0.0, 0.0)
    """Point about which torques are given, in the frame of the end effector [m]."""
    invert_wrench: bool = False
    """The wrench is what the object exerts on the world."""
    invert_torque: bool = False
    """Torques alone turn the other way: from z to x in the plane."""
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    """Order in which the four numbers come that the map calls qx qy qz qw, or a message x y z w."""
    invert_rotation: bool = False
    """Rotations are from the world to the end effector; a planar angle turns from z to x."""
    tare: bool = False
    """Subtract what the sensor reads in the first settled step."""
    window: float = 0.5
    """Seconds at the end of a hold that make a row."""
    drift: tuple[float, float, float, float] = (3e-4, 1e-3, 0.5, 0.05)
    """Largest change of a settled arm within them: position [m], angle [rad], force [N], torque
    [N·m]."""
    sensor_std: tuple[float, ...] = ()
    """Noise of a row (x, z, phi, F_x, F_z, tau), where it is known better than from the still
    stretches."""
    object: str | None = None
    """Name of the object, for the episode's YAML."""
    keep: tuple[str, ...] = ()
    """Further columns of a table to keep."""
    unusual: bool = False
    """Take springs below 10 N/m and lengths beyond 5 m as they are, and not for other units."""
    accept: bool = False
    """Write the episode without asking, unless there are serious doubts."""
    accept_doubts: bool = False
    """Write it in spite of serious doubts, too; they stand in its YAML."""
    overwrite: bool = False
    """Replace an earlier import in the folder."""

    def __post_init__(self) -> None:
        check_numbers(self, above={"rate": 0.0, "window": 0.0, "stiffness": 0.0, "drift": 0.0},
                      least={"sensor_std": 0.0})  # fmt: skip
        for name, count in (("tool_x", 3), ("sensor_std", 6)):
            found = len(getattr(self, name))
            if found not in (0, count):
                raise ValueError(f"{name} has {found} numbers, expected {count}")


def import_recording(config: LogImport) -> int:
    """Find settled steps, plane, signs and noise of a recording; draw them, and write an episode.

    Returns 0 once the episode is written, 3 where it was not accepted, and 4 where it was written
    in spite of serious doubts. Doubts of every weight stand in the episode's YAML.
    """
    import sys

    from tpcd.data.files import write_together
    from tpcd.figures.imported_log import imported_log
    from tpcd.figures.sinks import save_figure
    from tpcd.logs.conventions import RotationReading
    from tpcd.logs.importing import Importing, import_log
    from tpcd.logs.plane import Plane, WrenchReading
    from tpcd.logs.settled import Stillness
    from tpcd.quality.finding import Weight
    from tpcd.results import run_folder, write_results

    choices = Importing(
        stiffness=config.stiffness,
        plane=Plane(config.plane_x, config.plane_z, config.origin, config.tool_x or None),
        wrench=WrenchReading(
            config.wrench_frame,
            -1.0 if config.invert_wrench else 1.0,
            config.wrench_point,
            torque_sign=-1.0 if config.invert_torque else 1.0,
        ),
        rotation=RotationReading(config.quaternion, config.invert_rotation),
        stillness=Stillness(config.window, config.drift),
        tare=config.tare,
        sensor_std=config.sensor_std or None,
        object=config.object,
        unusual=config.unusual,
    )
    log = _read(config)
    if config.start is not None or config.end is not None:
        log = log.during(config.start, config.end)
    found = import_log(log, choices)
    with run_folder(config.out, "scripts/import_log.py", config, config.overwrite) as folder:
        contents = found.files(folder / EPISODE_NAME)
        planar, settled = found.planar, found.settled
        figure = imported_log(
            planar.times,
            _joined(planar.poses, planar.wrenches),
            planar.commands,
            planar.times[settled.stretches - [[0, 1]]],
            settled.rows,
            found.spring,
            planar.motion_left_out,
            planar.wrench_left_out,
            f"{config.log.name}: {len(settled.rows)} rows",
            [
                (each.start, each.end)
                for each in log.findings
                if each.weight is Weight.LEFT_OUT
                and each.start is not None
                and each.end is not None
            ],
        )
        picture = save_figure(figure, folder, "imported")
        for line in found.account.findings:
            print(line)
        print(_noise_line(found))
        serious = found.account.serious
        for doubt in found.account.doubts:
            print(f"{doubt.weight.value}: {doubt}", file=sys.stderr)
        shown = config.out / picture.name
        accepted = (
            config.accept_doubts or (config.accept and not serious) or _ask(shown, len(serious))
        )
        if accepted:
            write_together(dict(contents))
        write_results(
            folder,
            [],
            findings=found.account.findings,
            doubts=[f"{doubt.weight.value}: {doubt}" for doubt in found.account.doubts],
            accepted=accepted,
        )
    if not accepted:
        word = "--accept_doubts" if serious else "--accept"
        grave = f"{len(serious)} serious doubt{'s' * (len(serious) > 1)}; " if serious else ""
        print(f"no episode written: {grave}look at {shown}, then add {word} --overwrite")
        return EXIT_NOT_ACCEPTED
    print(f"episode in {config.out / EPISODE_NAME}.csv, drawn in {shown}")
    if serious:
        print("written in spite of serious doubts; its YAML keeps them", file=sys.stderr)
        return EXIT_DOUBTED
    return 0


def _read(config: LogImport) -> Log:
    """The recording, by what kind of file it is."""
    from tpcd.logs.bags import is_bag, read_bag
    from tpcd.logs.columns import log_from_columns
    from tpcd.logs.joining import parse_delays
    from tpcd.logs.table import read_columns

    delays = parse_delays(config.delay)
    if is_bag(config.log):
        if config.map:
            raise ValueError("map is for tables; name a bag's topics with --topics")
        return read_bag(config.log, config.topics, delays)
    if config.topics:
        raise ValueError("topics are for bags; name a table's columns with --map")
    columns = read_columns(config.log)
    return log_from_columns(
        columns, config.map, config.log, config.euler, config.rate, config.keep, delays
    )


def _joined(poses, wrenches):
    import numpy as np

    return np.column_stack((poses, wrenches))


def _noise_line(found: Imported) -> str:
    from tpcd.contract import SENSOR_NAMES

    if found.header.sensor_std is None:
        return "noise of a row: unknown"
    values = zip(SENSOR_NAMES, found.header.sensor_std, strict=True)
    return "noise of a row: " + ", ".join(f"{name} {value:.2g}" for name, value in values)


def _ask(picture: Path, serious: int) -> bool:
    """Whether the user takes the import, with a word of its own in spite of serious doubts; no
    where nobody can be asked."""
    import sys

    if not sys.stdin.isatty():
        return False
    words = (IN_SPITE,) if serious else ("y", "yes")
    asked = f"in spite of serious doubts? [N, or {IN_SPITE}]" if serious else "? [y/N]"
    try:
        answer = input(f"drawn in {picture}; write the episode{' ' * bool(serious)}{asked} ")
    except EOFError:
        return False
    return answer.strip().lower() in words


if __name__ == "__main__":
    run(import_recording, LogImport, positional=("log",))
