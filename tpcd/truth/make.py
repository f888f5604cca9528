"""The truth of a scene: MuJoCo or the project's own simulator, with what is hidden in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from tpcd.truth.protocol import Truth
from tpcd.truth.scene import Scene


def make_truth(
    scene: Scene,
    kind: Literal["mujoco", "quasistatic"],
    hidden: Mapping[str, Mapping[str, float]] | None = None,
    steps: int = 1,
) -> Truth:
    """The truth of a scene at its start pose; raises `SolverError` where mujoco is missing.

    `hidden` are effects with their parameters in SI units, for a run of so many steps; readings
    then include what they do to the sensors. Raises ValueError for unknown ones.
    """
    if hidden:
        return _with_effects(scene, kind, hidden, steps)
    if kind == "mujoco":
        from tpcd.truth.mujoco_truth import MujocoTruth as TruthKind
    elif kind == "quasistatic":
        from tpcd.simulator import QuasistaticTruth as TruthKind
    else:
        raise ValueError(f"truth is {kind!r}, expected 'mujoco' or 'quasistatic'")
    truth = TruthKind(
        scene.vertices_ee, scene.friction, scene.floor_height, scene.wall_position, scene.stiffness
    )
    truth.reset(scene.start_pose)
    return truth


def _with_effects(
    scene: Scene, kind: str, hidden: Mapping[str, Mapping[str, float]], steps: int
) -> Truth:
    if kind == "mujoco":
        from tpcd.truth.injected import InjectedMujocoTruth

        truth: Truth = InjectedMujocoTruth(scene, hidden, steps)
    else:
        from tpcd.effects.truth import EffectTruth, added_effects

        truth = EffectTruth(
            scene.vertices_ee,
            scene.friction,
            scene.floor_height,
            scene.wall_position,
            scene.stiffness,
            added_effects(hidden),
            steps,
        )
    truth.reset(scene.start_pose)
    return truth
