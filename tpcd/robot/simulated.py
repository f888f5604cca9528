"""An arm in simulation: a truth, and sensors with noise."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.data.episode import Episode
from tpcd.quality.finding import Finding
from tpcd.random import stream
from tpcd.robot.protocol import Reading
from tpcd.truth.protocol import Truth
from tpcd.truth.recording import DEFAULT_SENSOR_STD, Recording
from tpcd.truth.scene import Scene

_NOISE_STREAM = 4


class SimulatedRobot:
    """A truth with independent normal noise on every reading; row k has a noise of its own, so
    that an exploration that was stopped goes on with the numbers it would have had."""

    def __init__(
        self,
        truth: Truth,
        scene: Scene,
        seed: int,
        sensor_std: Float[Tensor, " 6"] | None = None,
        notes: str | None = None,
    ) -> None:
        self._truth, self._scene, self._seed = truth, scene, seed
        if sensor_std is None:
            sensor_std = torch.tensor(DEFAULT_SENSOR_STD, dtype=torch.float64)
        self._sensor_std, self._notes = sensor_std.double(), notes
        self._true: Episode | None = None
        self._settled = [True]

    def start(self) -> Episode:
        """The scene's start pose, with the command equal to it."""
        scene, zero = self._scene, torch.zeros(3, dtype=torch.float64)
        self._truth.reset(scene.start_pose)
        self._settled = [True]
        self._true = Episode(
            commands=scene.start_pose[None].double(),
            poses=scene.start_pose[None].double(),
            wrenches=zero[None],
            stiffness=scene.stiffness.double(),
            sensor_std=torch.zeros(6, dtype=torch.float64),
            object=scene.outline_name,
            notes=self._notes,
        )
        reading = self._read(0, scene.start_pose, zero, True)
        return Episode(
            commands=self._true.commands,
            poses=reading.pose[None],
            wrenches=reading.wrench[None],
            stiffness=self._true.stiffness,
            sensor_std=self._sensor_std,
            object=scene.outline_name,
            notes=self._notes,
        )

    def settle(self, command: Float[Tensor, " 3"]) -> Reading:
        """Run the truth to the command."""
        assert self._true is not None, "start first"
        pose, wrench, still = self._truth.step(command)
        row = len(self._true)
        self._true = self._true.with_row(command, pose, wrench)
        self._settled.append(still)
        return self._read(row, pose, wrench, still)

    def resume(self, episode: Episode) -> None:
        """Run the commands again; raises ValueError where they bring other readings."""
        again = self.start()
        for command in episode.commands[1:]:
            reading = self.settle(command)
            again = again.with_row(command, reading.pose, reading.wrench)
        if len(again) != len(episode) or not torch.allclose(again.poses, episode.poses, atol=1e-9):
            raise ValueError(
                "the episode was made with another scene, noise or seed; start a new exploration"
            )

    def stop(self) -> None:
        """Nothing moves between commands."""

    def doubts(self) -> tuple[Finding, ...]:
        """None: its sensors are as stated."""
        return ()

    def close(self) -> None:
        """Nothing to let go of."""

    def recording(self, episode: Episode) -> Recording:
        """The rows as measured beside the same without noise."""
        assert self._true is not None, "start first"
        return Recording(measured=episode, true=self._true, settled=tuple(self._settled))

    def _read(self, row: int, pose: Tensor, wrench: Tensor, settled: bool) -> Reading:
        generator = stream(self._seed, _NOISE_STREAM, row)
        noise = self._sensor_std * torch.randn(6, generator=generator, dtype=torch.float64)
        read = (pose.double() + noise[:3], wrench.double() + noise[3:])
        return Reading(*read, settled, self._sensor_std)
