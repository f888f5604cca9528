"""Policies by their names, as commands and experiments ask for them."""

from __future__ import annotations

from typing import Literal, get_args

from tpcd.policies.active import ActivePolicy, ActiveSettings, Task
from tpcd.policies.basic import GridPolicy, MotionPolicy
from tpcd.policies.limits import Limits
from tpcd.policies.protocol import Policy
from tpcd.random import stream
from tpcd.truth.motions import expert_motion, press_and_slide, rich_exploration
from tpcd.truth.scene import Scene

PolicyName = Literal["active", "lookahead", "grid", "random", "expert", "rich"]
_MOTION_STREAM = 3


def make_policy(
    name: PolicyName, limits: Limits, scene: Scene | None, seed: int, task: Task | None = None
) -> Policy:
    """The policy of a name; only the expert looks at the scene, and there only at the wall.

    Raises ValueError for an expert without a scene, and for another name.
    """
    if name == "active":
        return ActivePolicy(limits, task=task)
    if name == "lookahead":
        return ActivePolicy(limits, ActiveSettings(look_ahead=True), task)
    if name == "grid":
        return GridPolicy(MotionPolicy(lambda: press_and_slide(None)), limits)
    if name == "random":
        return MotionPolicy(lambda: press_and_slide(stream(seed, _MOTION_STREAM)), limits)
    if name == "expert":
        if scene is None:
            raise ValueError("the expert needs to see the wall, and there is no scene")
        return MotionPolicy(lambda: expert_motion(scene.wall_position), limits)
    if name == "rich":
        return MotionPolicy(lambda: rich_exploration(stream(seed, _MOTION_STREAM)), limits)
    raise ValueError(f"policy is {name!r}, expected one of {', '.join(get_args(PolicyName))}")
