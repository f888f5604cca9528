"""Recording: run a motion on a truth, add sensor noise, and keep what was true.

The motion sees only noisy measurements, as a robot would. An episode is written as usual;
beside it NAME.truth.csv holds the noise-free rows in the same columns and NAME.truth.yaml
theta, the outline and which steps settled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contract import SENSOR_NAMES
from tpcd.data.checks import NOISE_FACTOR, ROUNDING
from tpcd.data.episode import Episode
from tpcd.data.files import episode_contents, read_rows, write_together
from tpcd.data.header import Header
from tpcd.data.table import row_name
from tpcd.errors import EpisodeError
from tpcd.plain_yaml import read_yaml, to_yaml
from tpcd.planar import wrap_angle
from tpcd.truth.diagnosis_motion import diagnosis_motion
from tpcd.truth.motions import (
    History,
    Motion,
    planned_test,
    press_and_slide,
    rich_exploration,
)
from tpcd.truth.protocol import Truth
from tpcd.truth.scene import Scene

DEFAULT_SENSOR_STD = (2e-4, 2e-4, 5e-4, 0.3, 0.3, 0.02)
"""Noise of x, z [m], phi [rad], F_x, F_z [N], tau [N·m]."""

Policy = Literal["rich", "press_and_slide", "diagnosis", "test"]


@dataclass(frozen=True)
class Recording:
    """One simulated episode: as measured, as it truly was, and which steps settled."""

    measured: Episode
    true: Episode
    """The same rows without noise; its `sensor_std` is zero."""
    settled: tuple[bool, ...]


def make_motion(policy: Policy, scene: Scene, steps: int, generator: torch.Generator) -> Motion:
    """The motion a policy's name stands for; only 'test' looks at the scene."""
    if policy == "rich":
        return rich_exploration(generator)
    if policy == "press_and_slide":
        return press_and_slide(generator)
    if policy == "diagnosis":
        return diagnosis_motion(generator)
    if policy == "test":
        return planned_test(
            scene.vertices_ee,
            scene.floor_height,
            scene.wall_position,
            scene.start_pose,
            steps,
            generator,
            scene.stiffness,
        )
    expected = "'rich', 'press_and_slide', 'diagnosis' or 'test'"
    raise ValueError(f"policy is {policy!r}, expected {expected}")


def record(
    truth: Truth,
    scene: Scene,
    motion: Motion,
    steps: int,
    generator: torch.Generator,
    sensor_std: Float[Tensor, " 6"] | None = None,
    on_step: Callable[[int], None] | None = None,
    notes: str | None = None,
) -> Recording:
    """Run `steps` commands from the scene's start pose; noise is independent and normal.

    `on_step` is called with the number of steps done. Raises `ValueError` for fewer than
    one step or a negative standard deviation.
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}, expected at least 1")
    if sensor_std is None:
        sensor_std = torch.tensor(DEFAULT_SENSOR_STD, dtype=torch.float64)
    if bool((sensor_std < 0).any()):
        raise ValueError(f"sensor_std is {sensor_std.tolist()}, expected >= 0")
    rows = torch.zeros(steps + 1, 6, dtype=torch.float64)
    noise = sensor_std * torch.randn(steps + 1, 6, generator=generator, dtype=torch.float64)
    commands = torch.zeros(steps + 1, 3, dtype=torch.float64)
    commands[0] = rows[0, :3] = scene.start_pose
    truth.reset(scene.start_pose)
    settled = [True]
    for step in range(1, steps + 1):
        seen = (rows + noise)[:step]
        history = History(commands[:step].clone(), seen[:, :3], seen[:, 3:], scene.stiffness)
        commands[step] = motion.next_command(history)
        pose, wrench, still = truth.step(commands[step])
        rows[step] = torch.cat((pose, wrench))
        settled.append(still)
        if on_step:
            on_step(step)
    measured = rows + noise
    episode = Episode(
        commands=commands,
        poses=measured[:, :3].clone(),
        wrenches=measured[:, 3:].clone(),
        stiffness=scene.stiffness,
        sensor_std=sensor_std,
        object=scene.outline_name,
        notes=notes,
    )
    true = replace(
        episode,
        poses=rows[:, :3].clone(),
        wrenches=rows[:, 3:].clone(),
        sensor_std=torch.zeros(6, dtype=torch.float64),
    )
    return Recording(measured=episode, true=true, settled=tuple(settled))


def write_recording(
    recording: Recording,
    scene: Scene,
    path: str | Path,
    format: Literal["csv", "parquet"] = "csv",
    overwrite: bool = False,
) -> Path:
    """Write the episode NAME and its truth, all files or none; returns the episode's table.

    Raises `EpisodeError` if one of the files exists and `overwrite` is false.
    """
    contents = recording_contents(recording, scene, path, format)
    write_together(contents, overwrite)
    return next(iter(contents))


def recording_contents(
    recording: Recording,
    scene: Scene,
    path: str | Path,
    format: Literal["csv", "parquet"] = "csv",
    made_by: Mapping[str, Any] | None = None,
) -> dict[Path, bytes | None]:
    """What the files of an episode and of its truth hold, for `write_together`.

    `made_by` says how they came about (configuration, versions) in plain values and goes
    into NAME.truth.yaml.
    """
    contents = episode_contents(recording.measured, path, format)
    header_path = list(contents)[1]
    stem = str(header_path).removesuffix(".yaml")
    true_contents = episode_contents(recording.true, f"{stem}.truth.csv")
    true_table_path = next(iter(true_contents))
    contents[true_table_path] = true_contents[true_table_path]
    content: dict[str, Any] = {
        "theta": scene.theta,
        "outline": {
            "name": scene.outline_name,
            "vertices": scene.outline_vertices.tolist(),
        },
        "start_pose": scene.start_pose.tolist(),
        "stiffness": scene.stiffness.tolist(),
        "not_settled": [step for step, still in enumerate(recording.settled) if not still],
    }
    if made_by:
        content["made_by"] = dict(made_by)
    text = to_yaml(content, flow=True)
    contents[Path(f"{stem}.truth.yaml")] = text.encode("utf-8")
    return contents


def has_truth(path: str | Path) -> bool:
    """Whether the truth of an episode lies beside it, by the path of the episode."""
    return _truth_path(Path(path), "yaml").is_file()


def _truth_path(path: Path, suffix: str) -> Path:
    name = path.stem if path.suffix in (".csv", ".parquet", ".yaml") else path.name
    return path.with_name(f"{name}.truth.{suffix}")


def read_truth(path: str | Path) -> tuple[Episode, Scene]:
    """The noise-free rows and the scene of an episode made here, by the path of the episode.

    `path` is NAME.csv, NAME.parquet or NAME. Raises `EpisodeError` where NAME.truth.yaml or
    NAME.truth.csv is missing or not what `write_recording` wrote.
    """
    path = Path(path)
    scene_path = _truth_path(path, "yaml")
    content = read_yaml(scene_path, EpisodeError, "only simulated episodes have a truth")
    try:
        theta = content["theta"]
        scene = Scene(
            outline_name=content["outline"]["name"],
            outline_vertices=_tensor(content["outline"]["vertices"]),
            scale=float(theta["scale"]),
            mount=_tensor([theta[f"mount_{axis}"] for axis in ("x", "z", "phi")]),
            friction=float(theta["friction"]),
            floor_height=float(theta["floor_height"]),
            wall_position=float(theta["wall_position"]),
            start_pose=_tensor(content["start_pose"]),
            stiffness=_tensor(content["stiffness"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise EpisodeError(scene_path, f"not a truth file ({reason})", "simulate again") from error
    header = Header(
        stiffness=tuple(scene.stiffness.tolist()),
        sensor_std=(0.0,) * 6,
        object=scene.outline_name,
        notes=None,
        time_step_s=None,
        priors={},
    )
    return read_rows(_truth_path(path, "csv"), header), scene


def check_truth(episode: Episode, true: Episode) -> None:
    """Refuse a recording whose rows are not the true ones but for its noise; `EpisodeError`."""
    where, remedy = episode.path or "episode", "remove that .truth.yaml, or restore the recording"
    if not torch.equal(true.commands, episode.commands):
        raise EpisodeError(where, "has other commands than the truth beside it", remedy)
    off = torch.cat((episode.poses - true.poses, episode.wrenches - true.wrenches), dim=-1)
    off[:, 2] = wrap_angle(off[:, 2])
    excess = off.abs() - NOISE_FACTOR * episode.sensor_std - ROUNDING
    row, channel = divmod(int(excess.argmax()), 6)
    if excess[row, channel] > 0:
        raise EpisodeError(
            where,
            f"{row_name(row, Path(where))}, column {SENSOR_NAMES[channel]}: differs by"
            f" {float(off[row, channel]):.3g} from the truth beside it, and its noise is"
            f" {float(episode.sensor_std[channel]):.2g}",
            remedy,
        )


def _tensor(values: list) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)
