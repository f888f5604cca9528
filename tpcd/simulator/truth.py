"""The quasi-static model as a source of simulated truth, with a known outline."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.contact import ContactScene
from tpcd.simulator.record import StepSettings, StepStatus
from tpcd.simulator.step import simulate_step
from tpcd.terrain import floor, wall

TRUTH_SETTINGS = StepSettings(
    substeps=10, finest=1 / 1024, largest_turn=0.0125, follow_path=True, rounds=40
)


class QuasistaticTruth:
    """One outline in one scene under the project's own simulator; keeps its pose.

    `outline_vertices_ee` are the outline's vertices, scaled and mounted, in the
    end-effector frame [m]; floor height and wall position are world z and x [m]; stiffness
    is the diagonal of K [N/m, N/m, N·m/rad]. Its state is the pose and the last command.
    """

    def __init__(
        self,
        outline_vertices_ee: Float[Tensor, "p 2"],
        friction: float,
        floor_height: float,
        wall_position: float,
        stiffness: Float[Tensor, " 3"],
        settings: StepSettings = TRUTH_SETTINGS,
    ) -> None:
        one = torch.ones((), dtype=torch.float64)
        self._scene = ContactScene(
            points_ee=outline_vertices_ee.double(),
            terrains=(floor(floor_height * one), wall(wall_position * one)),
            friction=torch.full((2,), friction, dtype=torch.float64),
        )
        self._stiffness = stiffness.double()
        self._settings = settings
        self._pose = torch.zeros(3, dtype=torch.float64)
        self._command = self._pose

    def reset(self, pose: Float[Tensor, " 3"]) -> None:
        """Put the arm at rest at a pose [m, m, rad]."""
        self._pose = pose.double()
        self._command = self._pose

    def step(
        self, command: Float[Tensor, " 3"]
    ) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"], bool]:
        """Move to a command; settled pose, wrench [N, N, N·m] and whether it settled."""
        result = simulate_step(
            self._scene,
            self._pose,
            command.double(),
            self._stiffness,
            self._settings,
            previous=self._command,
        )
        self._pose, self._command = result.pose, command.double()
        settled = bool(result.status == int(StepStatus.CONVERGED))
        return result.pose, result.wrench, settled
