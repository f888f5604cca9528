"""The recordings of the physical protocol: an arm on an emulated controller, session by session."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from eval.physical import Physical
    from tpcd.data.episode import Episode
    from tpcd.robot.emulator import EmulatorSettings
    from tpcd.robot.ur import UniversalRobot
    from tpcd.truth.motions import Motion

ORIGIN = (-0.70, 0.0, 0.1)
"""Of the task in the base frame, x pointing along -x of the base: the wall is at 0.10 to 0.20 m."""
WALL_BASE = (-0.90, -0.80)
FRICTION = (0.5, 1.6)
SESSIONS = ("expert", "test", "diagnosis")


def recorded(config: Physical, index: int, folder: Path) -> dict[str, Episode]:
    """The sessions of an object: read where they are, else driven through the emulator."""
    from tpcd.data.files import read_episode, write_episode
    from tpcd.robot.emulator import EmulatorSettings
    from tpcd.robot.emulator.process import running_emulator

    wall = (ORIGIN[0] - WALL_BASE[1], ORIGIN[0] - WALL_BASE[0])
    settings = EmulatorSettings(
        config.address,
        config.objects[index],
        config.seed + index,
        FRICTION,
        wall,
        config.tiles[index],
        "-x",
        ORIGIN,
        pace="client",
    )
    sessions = [name for name in SESSIONS if name != "diagnosis" or config.diagnosis_steps]
    paths = {name: folder / f"{name}.csv" for name in sessions}
    missing = [name for name in sessions if not paths[name].is_file()]
    if missing:
        with running_emulator(settings):
            for name, episode in _driven(config, settings, sessions, folder / "raw"):
                write_episode(episode, paths[name], overwrite=True)
    return {name: read_episode(path) for name, path in paths.items()}


def _driven(
    config: Physical, settings: EmulatorSettings, sessions: Sequence[str], raw: Path
) -> Iterator[tuple[str, Episode]]:
    """The sessions of the arm, each from the start pose."""
    from tqdm import tqdm

    from tpcd.robot.arm_settings import ArmSettings
    from tpcd.robot.emulator.settings import TOOL_DOWN
    from tpcd.robot.ur import UniversalRobot
    from tpcd.truth.motions import History

    arm = UniversalRobot(
        ArmSettings(
            settings.address,
            x_axis=settings.x_axis,
            origin=settings.origin,
            tool_zero=TOOL_DOWN,
            surface_mm_per_10n=settings.surface_mm_per_10n,
            stale_time=1.0,
            payload=settings.payload,
            priors={"friction": FRICTION, "wall_position": settings.wall},
            object=settings.outline,
            notes=f"emulated, tiles {settings.surface_mm_per_10n:g} mm per 10 N",
        ),
        raw,
        lambda _: True,
    )
    try:
        for count, session in enumerate(sessions):
            rows = arm.restart() if count else arm.start()
            motion, steps = _motion(config, settings, session, rows)
            for _ in tqdm(range(steps), desc=f"{settings.outline} {session}", unit="move"):
                history = History(rows.commands, rows.poses, rows.wrenches, rows.stiffness)
                command = motion.next_command(history)
                reading = arm.settle(command)
                rows = rows.with_row(command, reading.pose, reading.wrench)
            yield session, rows
    finally:
        _leave(arm)


def _leave(arm: UniversalRobot) -> None:
    try:
        arm.stop()
    finally:
        arm.close()


def _motion(
    config: Physical, settings: EmulatorSettings, session: str, start: Episode
) -> tuple[Motion, int]:
    """The motion of a session, and how many moves it has."""
    from tpcd.random import stream
    from tpcd.robot.emulator import emulated_scene
    from tpcd.truth.diagnosis_motion import diagnosis_motion
    from tpcd.truth.motions import expert_motion, planned_test

    scene = emulated_scene(settings)
    generator = stream(settings.seed, SESSIONS.index(session))
    if session == "expert":
        return expert_motion(scene.wall_position), config.steps
    if session == "diagnosis":
        return diagnosis_motion(generator), config.diagnosis_steps
    planned = planned_test(
        scene.vertices_ee,
        scene.floor_height,
        scene.wall_position,
        start.poses[0],
        config.test_steps,
        generator,
        start.stiffness,
    )
    return planned, config.test_steps
