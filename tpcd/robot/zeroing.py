"""Zero means free: the sensor is zeroed in the air, away from floor and wall.

What a sensor carries when it is zeroed is missing from all that it says afterwards. So it is zeroed
lifted: above where the arm starts and to the left, since the world has a floor below and a wall on
the right, and along a wall a way straight up rubs. What lifting changes, beyond noise and drift, is
contact: gravity, the sensor's offset and a wrong payload stay as they are where the tool does not
turn. After zeroing the arm goes back to the start, which must read zero there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tpcd.errors import RobotError
from tpcd.robot import preflight
from tpcd.robot.admittance import at_rest
from tpcd.robot.free_space import lifted
from tpcd.robot.preflight import FreeAir
from tpcd.robot.servo import RETREAT_FORCE, Servo


@dataclass(frozen=True)
class Lifted:
    """What lifting an arm from a place has told."""

    start: Float[np.ndarray, " 3"]
    """The place [m, m, rad]."""
    touch: preflight.Touch
    """What is felt there."""


def lift(servo: Servo) -> Lifted:
    """Lift an arm from where it stands, with its sensor as it is, and compare.

    Also measures the noise of single readings. Raises RobotError for a sensor that drifts.
    """
    here = servo.stand(servo.settling.window)
    preflight.check_before_zeroing(here)
    start = here.poses.mean(0)
    above = lifted(servo.settings, start)
    servo.state = at_rest(start, np.zeros(3))
    servo.ramp_to(above, RETREAT_FORCE)
    air = servo.stand(servo.settings.still_time)
    preflight.check_drift(air)
    servo.noise = preflight.reading_noise(air)
    servo.longest_repeat = preflight.longest_repeat(air)
    return Lifted(start, preflight.touch(here, air))


def turning_force(servo: Servo) -> float:
    """Zero in the air, tilt the tool both ways and back: the force that turns with it, each way
    [N]; raises RobotError for a wrong payload."""
    assert servo.state is not None, "lift first"
    settings, here, tilted = servo.settings, servo.state.reference, []
    servo.link.zero_sensor()
    for limit, angle in zip(
        (settings.workspace_low, settings.workspace_high), (-1, 1), strict=True
    ):
        servo.ramp_to(np.array([here[0], here[1], angle * min(abs(limit[2]), preflight.TILT)]))
        tilted.append(servo.stand(servo.settling.window))
    servo.ramp_to(here)
    return preflight.check_tilted(*tilted)


def zeroed_at(servo: Servo, start: Float[np.ndarray, " 3"]) -> tuple[FreeAir, FreeAir]:
    """Zero in the air above a start pose, at its angle, and go down to it; the readings there,
    above and at the start. Raises RobotError where the start then does not read zero."""
    servo.ramp_to(lifted(servo.settings, start))
    servo.link.zero_sensor()
    air = servo.stand(servo.settings.still_time)
    preflight.check_drift(air)
    preflight.check_zeroed(air)
    servo.ramp_to(start)
    there = servo.stand(servo.settling.window)
    touch = preflight.touch(there, air)
    if touch.felt:
        raise RobotError(
            f"the start pose is not free: zeroed in the air, the sensor reads {touch} there; start"
            " anew from a pose in free air"
        )
    return air, there
