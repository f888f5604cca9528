"""A MuJoCo truth into which physical effects are injected, to test who must find them.

The effects are changes of the MuJoCo model, of its forces or of its friction while it
integrates; nothing comes from the quasi-static model. Without effects the answers are those
of `MujocoTruth`. Row k of an episode is the answer to command k after `reset`, and its
share is k / steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.truth.hull import hull_vertices
from tpcd.truth.injected_effects import WORLD_EFFECTS, Hidden, active_effects, sensor_effects
from tpcd.truth.injected_friction import (
    FRICTION_EFFECTS,
    FrictionLaw,
    SurfaceLoads,
    nominal_friction,
    surface_loads,
)
from tpcd.truth.injected_world import (
    BOX,
    SURFACES,
    floor_points,
    floor_shape,
    world_xml,
)
from tpcd.truth.mujoco_scene import POINT_RADIUS, MujocoSettings, scene_xml
from tpcd.truth.mujoco_truth import Transition, load_mujoco, ramp_and_hold, stability_check
from tpcd.truth.scene import Scene

__all__ = ["InjectedMujocoTruth", "sensor_effects"]

MOVING_TIME = 0.25
"""Time in which a floor drifts or an object slips, before the command moves [s]; what then
would penetrate is pushed out at a few mm/s."""
DRY_HOLD_TIME = 60.0
"""Longest hold of an arm with dry friction [s]: where contact blocks an axis that friction
holds as well, the load moves slowly from one to the other."""
UPDATE_STEPS = 4
"""Time steps between updates of what depends on the state (friction, load, curved floor)."""


class InjectedMujocoTruth:
    """One scene with hidden effects, simulated by MuJoCo; satisfies `Truth`.

    `hidden` maps effects to parameters in SI units (tpcd.truth.injected_effects). `steps` is
    the length of the episode, for effects that depend on time. Raises `SolverError` where
    mujoco is not installed and `ValueError` for effects and values without meaning.
    """

    def __init__(
        self, scene: Scene, hidden: Hidden, steps: int, settings: MujocoSettings | None = None
    ) -> None:
        if steps < 1:
            raise ValueError(f"steps is {steps}, expected at least 1")
        self.settings = settings or MujocoSettings()
        self._mujoco = load_mujoco()
        self._hidden, self._steps, self._scene = hidden, steps, scene
        self._effects = active_effects(hidden)
        if "arm_friction" in self._effects:
            hold = max(self.settings.hold_time, DRY_HOLD_TIME)
            self.settings = replace(self.settings, hold_time=hold)
        self._stiffness = scene.stiffness.detach().numpy().astype(np.float64) * np.exp(
            [
                self._effects.get("stiffness_error", "log_ratio_x"),
                self._effects.get("stiffness_error", "log_ratio_z"),
                0.0,
            ]
        )
        self._hooks: list[Callable[[], None]] = []
        self._build()
        self._law = FrictionLaw(
            self._effects,
            nominal_friction(scene.friction, self._effects),
            self.settings.time_step * UPDATE_STEPS,
        )
        self.reset(scene.start_pose)

    def reset(self, pose: Float[Tensor, " 3"]) -> None:
        """Put the arm at rest at a pose with the command equal to it [m, m, rad]; row 0."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:3] = pose.numpy()
        self._asked = self._pursued = self._data.qpos[:3].copy()
        self._row = self._until_update = 0
        self._moved = np.zeros(3)
        if self._is_changed:
            self._place(self._moved)
            self._data.ctrl[3:] = self._effects.get("adhesion", "force")
            self._mujoco.mj_kinematics(self._model, self._data)
            self._law.reset()

    def step(self, command: Float[Tensor, " 3"]) -> Transition:
        """Ramp from the last command to this one and hold until the arm stands still.

        Returns pose [m, m, rad], wrench of contact and load on hand and object about the
        end-effector origin [N, N, N·m] as the sensor reports it, without noise, and whether
        the arm settled.
        """
        asked = command.numpy().astype(np.float64)
        if not np.isfinite(asked).all():
            raise ValueError(f"command is {asked}, expected finite numbers")
        self._row += 1
        share = min(self._row / self._steps, 1.0)
        start = self._pursued
        lag = self._effects.get("command_lag", "share")
        self._asked, self._pursued = asked, asked - lag * (asked - self._asked)
        with stability_check(self._mujoco, self._data):
            self._law.rest()
            self._move_world(share)
            settled = ramp_and_hold(
                self._advance, self._data, start, self._pursued, self._stiffness, self.settings
            )
        pose = torch.from_numpy(self._data.qpos[:3].copy())
        if "arm_friction" in self._effects:
            wrench = self.external_wrench()
        else:
            wrench = torch.from_numpy(self._stiffness * (pose.numpy() - self._pursued))
        return *sensor_effects(self._hidden, pose, wrench, share), settled

    def external_wrench(self) -> Float[Tensor, " 3"]:
        """Contact, adhesion and load summed after the last `step`, before the sensor."""
        self._mujoco.mj_forward(self._model, self._data)
        data = self._data
        wrench = data.qfrc_constraint[:3] + data.qfrc_applied[:3]
        wrench += data.qfrc_actuator[:3] - data.actuator_force[:3]
        # Dry friction of the arm is a constraint as well, but not of the world.
        held = data.efc_type[: data.nefc] == self._mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
        np.subtract.at(wrench, data.efc_id[: data.nefc][held], data.efc_force[: data.nefc][held])
        return torch.from_numpy(wrench)

    def loads(self) -> SurfaceLoads:
        """Forces between the object and each surface at the last integration step."""
        return surface_loads(self._data, self._surface_of_geom)

    def _build(self) -> None:
        scene, effects = self._scene, self._effects
        outline = scene.vertices_ee.detach().numpy().astype(np.float64)
        hull = hull_vertices(outline)
        self._is_changed = any(name in effects for name in WORLD_EFFECTS)
        self._shape = floor_shape(effects)
        angle = float(scene.start_pose[2])
        touching = floor_points(outline, hull, self._shape, angle)
        places = (scene.friction, scene.floor_height, scene.wall_position, self._stiffness)
        if self._is_changed:
            xml = world_xml(hull, touching, *places, effects, self.settings)
        else:
            xml = scene_xml(hull, *places, self.settings)
        self._model = self._mujoco.MjModel.from_xml_string(xml)
        self._data = self._mujoco.MjData(self._model)
        if not self._is_changed:
            return
        model = self._model
        # Frames that coincide when the model is made need not do so once they are moved.
        model.geom_sameframe[:] = 0
        names = [model.geom(i).name for i in range(model.ngeom)]
        self._surface_of_geom = np.array([_surface_of(name) for name in names])
        # MuJoCo orders the geoms of a pair as it likes; points have no surface, so -1.
        pairs = np.stack((model.pair_geom1, model.pair_geom2))
        self._surface_of_pair = self._surface_of_geom[pairs].max(axis=0)
        self._point_of_pair = np.where(self._surface_of_geom[pairs[0]] < 0, *pairs)
        count = 1 if self._shape.is_flat else len(touching)
        self._floors = np.array([names.index(f"floor_{i}") for i in range(count)])
        self._floor_body = model.body("floor")
        self._floor_depth = POINT_RADIUS + BOX * bool(
            model.geom_type[self._floors[0]] == self._mujoco.mjtGeom.mjGEOM_BOX
        )
        # The pivot belongs to the body that carries the floor's own.
        self._pivot = int(model.body_parentid[self._floor_body.id])
        if not self._shape.is_flat:
            self._hooks.append(self._lay_floor)
        if "payload" in effects:
            self._hooks.append(self._apply_load)
        if any(name in effects for name in FRICTION_EFFECTS):
            self._hooks.append(self._apply_friction)

    def _advance(self, steps: int) -> None:
        if not self._hooks:
            self._mujoco.mj_step(self._model, self._data, steps)
            return
        while steps > 0:
            if self._until_update == 0:
                self._before_step()
                self._until_update = UPDATE_STEPS
            chunk = min(steps, self._until_update)
            self._mujoco.mj_step(self._model, self._data, chunk)
            self._until_update -= chunk
            steps -= chunk

    def _before_step(self) -> None:
        for hook in self._hooks:
            hook()

    def _move_world(self, share: float) -> None:
        """Move the floor, and the object in the hand, to where they are at a share."""
        slipped = "grasp_slip" in self._effects and share >= self._effects.get("grasp_slip", "at")
        target = np.array(
            [
                share * self._effects.get("floor_drift", "drift"),
                slipped * self._effects.get("grasp_slip", "angle"),
                slipped * self._effects.get("grasp_slip", "shift"),
            ]
        )
        before, self._moved = self._moved, target
        if np.array_equal(before, target):
            return
        moves = max(1, round(MOVING_TIME / self.settings.time_step))
        for move in np.arange(1, moves + 1) / moves:
            self._place(before + move * (target - before))
            self._advance(1)

    def _place(self, moved: np.ndarray) -> None:
        """Raise the floor [m], turn the object in the hand [rad] and shift it [m]."""
        drift, angle, shift = moved.tolist()
        self._model.body_pos[self._pivot, 2] = self._scene.floor_height + drift
        held = self._model.body("object").id
        self._model.body_pos[held] = (shift, 0.0, 0.0)
        self._model.body_quat[held] = _turn(np.array(angle))

    def _lay_floor(self) -> None:
        """Lay each plane of a curved floor tangent to it below its point."""
        data, shape = self._data, self._shape
        points = self._point_of_pair[self._surface_of_pair == 0]
        x = data.geom_xpos[points, 0] - data.xpos[self._floor_body.id, 0]
        rise = shape.rise(x)
        depth = self._floor_depth
        self._model.geom_pos[self._floors, 0] = x + depth * np.sin(rise)
        self._model.geom_pos[self._floors, 2] = shape.height(x) - depth * np.cos(rise)
        self._model.geom_quat[self._floors] = _turn(rise)

    def _apply_load(self) -> None:
        weight, lever = (self._effects.get("payload", name) for name in ("weight", "lever"))
        self._data.qfrc_applied[1] = -weight
        self._data.qfrc_applied[2] = -weight * lever * math.cos(self._data.qpos[2])

    def _apply_friction(self) -> None:
        friction = self._law.coefficients(self.loads())[self._surface_of_pair]
        if slope := self._effects.get("friction_field", "slope"):
            x = self._data.geom_xpos[self._point_of_pair, 0]
            friction = friction * np.maximum(0.0, 1.0 + slope * x)
        self._model.pair_friction[:, :2] = friction[:, None]


def _surface_of(geom: str) -> int:
    name, kind = geom.split("_")[:2]
    return -1 if kind == "point" else SURFACES.index(name)


def _turn(angle: Float[np.ndarray, "*p"]) -> Float[np.ndarray, "*p 4"]:
    """Quaternion of a turn from x towards z, about MuJoCo's -y."""
    zero = np.zeros_like(angle)
    return np.stack((np.cos(angle / 2), zero, -np.sin(angle / 2), zero), axis=-1)
