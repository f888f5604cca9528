"""Settings of a real arm: where it is, what it holds, how it gives way, where it must not go."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tpcd.robot.admittance import AdmittanceSettings, settings_for_surface

STEADY_RATES = (125.0, 250.0, 500.0)


@dataclass(frozen=True)
class ArmSettings:
    """Settings of a Universal Robots arm; SI units, poses in the world of the task."""

    address: str
    """Address of the controller."""
    stiffness: tuple[float, float, float] = (100.0, 100.0, 50.0)
    """Of the spring that the arm imitates on x, z, phi [N/m, N/m, N·m/rad]."""
    surface_mm_per_10n: float = 1.0
    """How far the stiffest surface yields under 10 N [mm]; stiffer than stated is unstable."""
    x_axis: str = "+x"
    """Axis of base or tool that is x of the task: `x`, `-y`, `tool_z`, ..."""
    z_axis: str = "+z"
    """Axis that is z of the task, away from the floor."""
    origin: tuple[float, float, float] | None = None
    """Origin of the task in the base frame [m]; None: the TCP at the start."""
    tool_zero: tuple[float, float, float] | None = None
    """Rotation vector of the tool in the base frame at angle zero [rad]; None: as at the start."""
    payload: float | None = None
    """Mass of gripper and object [kg], compared with what the controller was told; None: not."""
    stop_force: float = 20.0
    """Force on an axis at which the arm stops [N]; of the torque a fifth [N·m]."""
    workspace_low: tuple[float, float, float] = (-0.15, -0.15, -0.15)
    """Lower corner of where commands and poses may be [m, m, rad]."""
    workspace_high: tuple[float, float, float] = (0.3, 0.3, 0.15)
    """Upper corner [m, m, rad]."""
    rate: float = 125.0
    """Readings and targets each second [Hz]: 125, 250 or 500."""
    stale_time: float = 0.04
    """Without a new reading for this long the link is lost [s]; more only for an emulator on a busy
    machine."""
    settle_time: float = 60.0
    """Longest time to wait for a steady pose and force once the command has arrived, or for it to
    get on, on top of the way at full speed [s]."""
    still_time: float = 3.0
    """Time in free air from which noise is measured [s]."""
    noise_free: bool = False
    """Whether the readings of the force sensor have no noise, as an emulator's may; otherwise one
    that repeats exactly is of a sensor that has stopped."""
    retreat: float = 0.03
    """How far the arm moves up after a stop, and half as far to the left [m]."""
    resume_tolerance: tuple[float, float] = (1.5e-3, 0.015)
    """How far poses of repeated moves may be from those of an earlier run [m, rad]."""
    priors: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Ranges of friction, floor_height, wall_position, ... that are known of the place."""
    object: str | None = None
    """What is held, for the episode's YAML."""
    notes: str | None = None
    """Remarks for the episode's YAML."""

    def __post_init__(self) -> None:
        """Refuse settings with which no arm should move."""
        positive = (
            "surface_mm_per_10n",
            "stop_force",
            "settle_time",
            "stale_time",
            "still_time",
            "retreat",
        )
        for name in positive:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}, expected a number above 0")
        corners = zip(self.workspace_low, self.workspace_high, strict=True)
        if not all(low < high for low, high in corners):
            raise ValueError(
                f"workspace from {self.workspace_low} to {self.workspace_high}, expected low < high"
            )
        if self.rate not in STEADY_RATES:
            raise ValueError(f"rate is {self.rate:g} Hz, expected 125, 250 or 500")

    @property
    def admittance(self) -> AdmittanceSettings:
        """The admittance whose damping suits the stated surface."""
        return settings_for_surface(self.stiffness, 10.0 / (1e-3 * self.surface_mm_per_10n))

    def sentence(self) -> str:
        """What the user is asked to confirm before the arm moves."""
        (x0, z0, a0), (x1, z1, a1) = self.workspace_low, self.workspace_high
        speed = 1e3 * self.admittance.speed_limit[0]
        place = "the TCP as it is now" if self.origin is None else f"{self.origin} m in the base"
        return (
            f"The arm at {self.address} will move by itself, at up to {speed:.0f} mm/s, with x"
            f" along {self.x_axis} and z along {self.z_axis} from {place}:"
            f" x {1e3 * x0:.0f} to {1e3 * x1:.0f} mm, z {1e3 * z0:.0f} to {1e3 * z1:.0f} mm, angle"
            f" {math.degrees(a0):.0f} to {math.degrees(a1):.0f} degrees. It stops at"
            f" {self.stop_force:g} N. It holds an object in free air, and the emergency stop is at"
            " hand."
        )
