"""Where an arm is free: above and to the left, since the world has a floor below and a wall right.

So an arm that is lifted leaves what it touches, and what is free at a pose is free above it and to
its left. Both hold whatever the force sensor says.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from tpcd.errors import RobotError
from tpcd.robot.admittance import LEVER
from tpcd.robot.arm_settings import ArmSettings

SPARE = 0.002
"""Way beyond what a surface yields, after which an arm that was lifted is free [m]."""
LARGEST_BEFORE_ZEROING = 10.0
"""Force in free air that only a wrong payload or a contact explains [N]."""


def lifted(settings: ArmSettings, place: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The pose above a place and to its left where nothing is touched [m, m, rad], as far as the
    workspace allows. To the left since along a wall a way straight up rubs."""
    low, high = np.array(settings.workspace_low), np.array(settings.workspace_high)
    least = _least_way(settings)
    way = np.array([-max(0.5 * settings.retreat, least), max(settings.retreat, least), 0.0])
    return np.clip(place + way, np.minimum(low, place), np.maximum(high, place))


def check_room(settings: ArmSettings, start: Float[np.ndarray, " 3"]) -> None:
    """Raises RobotError where the workspace leaves too little way to leave a surface that yields as
    stated under the largest force before zeroing."""
    room, least = np.abs(lifted(settings, start) - start)[:2], _least_way(settings)
    if float(room.min()) < least - 1e-9:
        shown = ", ".join(f"{value:.3f}" for value in start)
        raise RobotError(
            f"the start pose is at ({shown}) [m, m, rad], where the workspace leaves"
            f" {1e3 * room[0]:.0f} mm to the left and {1e3 * room[1]:.0f} mm above, expected"
            f" {1e3 * least:.0f} mm of both, to zero the sensor free of contact; start elsewhere,"
            " or widen the workspace"
        )


def is_lifted(
    settings: ArmSettings, place: Float[np.ndarray, " 3"], pose: Float[np.ndarray, " 3"]
) -> bool:
    """Whether an arm that was no further into a surface at a place than its force limit allows is
    free at a pose of the same angle, above and to the left."""
    way, least = pose - place, _least_way(settings, settings.stop_force) - 0.5 * SPARE
    return bool(-way[0] > least and way[1] > least)


def is_free(pose: Float[np.ndarray, " 3"], free: Iterable[Float[np.ndarray, " 3"]]) -> bool:
    """Whether a pose [m, m, rad] is above and to the left of one that is known to be free; turned
    from it, by as much more as what is held reaches."""
    for known in free:
        reach = LEVER * abs(float(pose[2] - known[2]))
        if pose[0] <= known[0] - reach and pose[1] >= known[1] + reach:
            return True
    return False


def _least_way(settings: ArmSettings, force: float = LARGEST_BEFORE_ZEROING) -> float:
    return 1e-4 * settings.surface_mm_per_10n * force + SPARE
