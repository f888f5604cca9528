"""Independent truth: a rigid outline under an impedance controller, by MuJoCo.

MuJoCo integrates second-order dynamics with its own contact solver; nothing here comes
from the quasi-static model it is compared with. The object is a body with two slides and
a hinge, its hull vertices are spheres of 1 µm, floor and wall are planes set back by that
radius, and three position actuators are the impedance K. Each command is approached on a
straight ramp and held until the arm stands still; then K (pose - command) is the wrench.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.errors import SolverError
from tpcd.truth.hull import hull_vertices
from tpcd.truth.mujoco_scene import MujocoSettings, scene_xml

Transition = tuple[Float[Tensor, " 3"], Float[Tensor, " 3"], bool]


class MujocoTruth:
    """One outline in one scene, simulated by MuJoCo; keeps its state between steps.

    `outline_vertices_ee` are the outline's vertices, scaled and mounted, in the
    end-effector frame [m]; floor height and wall position are world z and x [m]; stiffness
    is the diagonal of K [N/m, N/m, N·m/rad]. Raises `SolverError` where mujoco is not
    installed and `ValueError` for values without meaning.
    """

    def __init__(
        self,
        outline_vertices_ee: Float[Tensor, "p 2"],
        friction: float,
        floor_height: float,
        wall_position: float,
        stiffness: Float[Tensor, " 3"],
        settings: MujocoSettings | None = None,
    ) -> None:
        if friction < 0:
            raise ValueError(f"friction is {friction}, expected >= 0")
        if not bool((stiffness > 0).all()):
            raise ValueError(f"stiffness is {stiffness.tolist()}, expected > 0 on every axis")
        self.settings = settings or MujocoSettings()
        self._mujoco = load_mujoco()
        self._stiffness = stiffness.detach().numpy().astype(np.float64)
        hull = hull_vertices(outline_vertices_ee.detach().numpy().astype(np.float64))
        xml = scene_xml(hull, friction, floor_height, wall_position, self._stiffness, self.settings)
        self._model = self._mujoco.MjModel.from_xml_string(xml)
        self._data = self._mujoco.MjData(self._model)
        self._command = np.zeros(3)

    def reset(self, pose: Float[Tensor, " 3"]) -> None:
        """Put the arm at rest at a pose with the command equal to it [m, m, rad]."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = pose.numpy()
        self._command = self._data.qpos.copy()

    def step(self, command: Float[Tensor, " 3"]) -> Transition:
        """Ramp from the last command to this one and hold until the arm stands still.

        Returns pose [m, m, rad], wrench K (pose - command) [N, N, N·m] and whether the arm
        settled within `hold_time`.
        """
        start, end = self._command, command.numpy().astype(np.float64)
        if not np.isfinite((start, end)).all():
            raise ValueError(f"command goes from {start} to {end}, expected finite numbers")
        self._command = end
        with stability_check(self._mujoco, self._data):
            settled = ramp_and_hold(
                lambda steps: self._mujoco.mj_step(self._model, self._data, steps),
                self._data, start, end, self._stiffness, self.settings,
            )  # fmt: skip
        pose = self._data.qpos.copy()
        wrench = self._stiffness * (pose - end)
        return torch.from_numpy(pose), torch.from_numpy(wrench), settled

    def contact_wrench(self) -> Float[Tensor, " 3"]:
        """Wrench summed from the contact forces after the last `step`, which gives K (x' - u)."""
        self._mujoco.mj_forward(self._model, self._data)
        return torch.from_numpy(self._data.qfrc_constraint.copy())


def ramp_and_hold(
    advance: Callable[[int], None],
    data: Any,
    start: np.ndarray,
    end: np.ndarray,
    stiffness: np.ndarray,
    settings: MujocoSettings,
) -> bool:
    """Move the command, then advance until the arm stands still; whether it did.

    `advance` integrates so many time steps of `data`, whose first three coordinates and
    controls are the arm's.
    """
    way, turn = np.hypot(*(end - start)[:2]), abs(end[2] - start[2])
    speed = settings.ramp_speed
    ramp_time = max(settings.ramp_time, way / speed[0], turn / speed[1])
    ramp_steps = max(1, round(min(ramp_time, settings.longest_ramp) / settings.time_step))
    for fraction in np.arange(1, ramp_steps + 1) / ramp_steps:
        data.ctrl[:3] = start + fraction * (end - start)
        advance(1)
    damping = stiffness * settings.damping_time
    block = max(1, round(0.05 / settings.time_step))
    for _ in range(max(1, round(settings.hold_time / settings.time_step / block))):
        before = data.qpos[:3].copy()
        advance(block)
        # The mean speed over the block, so that a chattering contact counts as at rest.
        speed = np.abs(data.qpos[:3] - before) / (block * settings.time_step)
        if (damping * speed).max() < settings.settled_force:
            return True
    return False


@contextmanager
def stability_check(mujoco: ModuleType, data: Any) -> Iterator[None]:
    """Raise `SolverError` if `data` became unstable inside the block."""
    complaints: list[str] = []
    with _warnings_to(mujoco, complaints.append):
        yield
    kinds = mujoco.mjtWarning
    # On these MuJoCo restarts from zero by itself, which must not pass for an answer.
    fatal = (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
    if any(data.warning[kind].number for kind in fatal):
        raise SolverError(
            f"MuJoCo became unstable: {complaints[-1]} Check the command or lower the time step"
        )


@contextmanager
def _warnings_to(mujoco: ModuleType, receive: Callable[[str], None]) -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to a log file in the working folder."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(receive)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def load_mujoco() -> ModuleType:
    """The mujoco package; raises `SolverError` where it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise SolverError(
            "mujoco is not installed, needed for the independent truth;"
            " pip install 'tpcd[dev]' or use --truth quasistatic"
        ) from error
    return mujoco
