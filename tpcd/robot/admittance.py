"""The admittance law: how an arm that follows positions is made to behave like a spring.

    D v = K (u - r) + w

r is the reference (x, z, phi) given to the arm's position servo, u the command, w the filtered
wrench that the world exerts on the object, v the velocity of r. At rest w = K (r - u), which is
the impedance of the episodes. All is a pure function of state and readings; SI units, poses and
wrenches in the task's world frame.

The arm follows after a servo delay T, so that in contact with a surface of stiffness k the loop is
the integrator (k / D) exp(-s T): stable for k T / D < pi / 2, without overshoot for k T / D < 1 / e
(K. J. Åström and R. M. Murray, Feedback Systems, chapter 10, phase margin of an integrator with
delay). Damping of 0.04 s times the stiffness keeps the delays of servo, filter and sampling (about
45 ms) inside the first bound. In a corner the yield of one surface and the grip of the other add
up, so twice the stiffness of a surface counts. In the air nothing is stiff and the same damping
would only cost time: there the arm moves with a lighter one, slow enough that the first touch,
which takes one delay to be felt, stays within a stated force.

Along a slide nothing is stiff either: friction has its limit, and the wrench does not change. So
where it has not changed over the last `WAY`, the arm goes on in that direction, and only in that,
as it does in the air, and with the mean wrench of the way in the place of the last reading. What
lies ahead is felt like any first touch. Noise is not felt: light damping would turn it into steps,
and friction lets only those forward pass, so that the arm would come to rest too far.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

DAMPING_TIME = 0.04
"""Damping over surface stiffness [s]."""
SURFACES = 2
"""Surfaces that may be met at once."""
REACTION_TIME = 0.05
"""From touching to the arm being slowed down: servo, filter and sampling [s]."""
LEVER = 0.25
"""Damping of the angle is that of a surface point so far from the end effector [m]. Larger than a
hand-held object, since flat faces are stiffer against turning than single points."""
LEVER_STIFFNESS = 3.2e4
"""Of a surface, beyond which the angle is damped no more [N/m]: how far a flat face yields when it
is turned is a matter of the face, not of the bed below (emulated, 0.2 mm per 10 N)."""
WAY = 0.0015
"""A way on which the wrench has not changed is soft after so much of it [m]. With `SLIGHT`, another
direction is off it by 0.04 rad at most on a surface of 5 kN/m (emulated slides, 0.2 to 3 mm)."""
BEGINNING = 0.3
"""Of a way, in which its direction is not taken [s]: what was pressed is still coming to rest."""
SLIGHT = (0.3, 0.3, 0.03)
"""Change of the slowly filtered wrench that ends a soft way [N, N, N·m]."""
SLOW_TIME = 0.05
"""Time constant of that filter [s]; faster changes end it where they exceed `touch`."""
NOISE_FACTOR = 5.0
"""Standard deviations of filtered noise that end no way."""
MEMORY = 0.5
"""Of the mean wrench of a way, as a share of D / K in contact, over which the heavier damping would
average noise: shorter, and noise takes slides too far (emulated)."""


@dataclass(frozen=True)
class AdmittanceSettings:
    """The spring, and how fast the arm gives way; on the axes x, z, phi."""

    stiffness: tuple[float, float, float]
    """Diagonal of K [N/m, N/m, N·m/rad]."""
    damping: tuple[float, float, float]
    """Diagonal of D in contact [N·s/m, N·s/m, N·m·s/rad]."""
    free_damping: tuple[float, float, float]
    """Diagonal of D in the air, in the same units."""
    speed_limit: tuple[float, float, float]
    """Largest speed of the reference on each axis [m/s, m/s, rad/s]."""
    touch: tuple[float, float, float] = (1.0, 1.0, 0.1)
    """A wrench beyond this is contact [N, N, N·m]."""
    release: float = 0.005
    """Contact is over once nothing was felt for this way [m]; shorter, and a light contact would
    turn the lighter damping on and off."""
    filter_time: float = 0.005
    """Time constant of the filter of the wrench [s]."""
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviation of one reading of the wrench [N, N, N·m]."""

    def __post_init__(self) -> None:
        """Refuse what is no spring."""
        for name in ("stiffness", "damping", "free_damping", "speed_limit", "touch"):
            if not all(value > 0 for value in getattr(self, name)):
                raise ValueError(f"{name} is {getattr(self, name)}, expected positive numbers")


def settings_for_surface(
    stiffness: tuple[float, float, float],
    surface_stiffness: float,
    impact_force: float = 4.0,
    largest_speed: float = 0.05,
    damping_time: float = DAMPING_TIME,
    free_time: float = 0.2,
) -> AdmittanceSettings:
    """Settings for surfaces up to a stiffness [N/m]; raises ValueError unless it is positive.

    `impact_force` [N] is what the first touch may add at full speed, `largest_speed` [m/s] a bound
    whatever the surface, `free_time` [s] the time constant D / K in the air.
    """
    if not surface_stiffness > 0:
        raise ValueError(f"surface_stiffness is {surface_stiffness}, expected N/m above 0")
    linear = damping_time * SURFACES * surface_stiffness
    turning = linear * min(1.0, LEVER_STIFFNESS / surface_stiffness)
    damping = np.array([linear, linear, turning * LEVER**2])
    free = np.minimum(damping, free_time * np.array(stiffness))
    speed = min(largest_speed, impact_force / (surface_stiffness * REACTION_TIME))
    return AdmittanceSettings(
        stiffness=stiffness,
        damping=_three(damping),
        free_damping=_three(free),
        speed_limit=(speed, speed, speed / (LEVER / 2)),
    )


def turning_slower(settings: AdmittanceSettings) -> AdmittanceSettings:
    """The same with twice the damping of the angle in contact: how far the object reaches, and so
    how stiff its flat faces are against turning, is not known beforehand."""
    x, z, angle = settings.damping
    return replace(settings, damping=(x, z, 2.0 * angle))


@dataclass(frozen=True)
class Mark:
    """The way on which the wrench has not changed."""

    reference: Float[np.ndarray, " 3"]
    """A place on it, from which its direction is taken [m, m, rad]."""
    wrench: Float[np.ndarray, " 3"]
    """Mean since it last changed [N, N, N·m]."""
    age: float
    """Time since then [s]."""


@dataclass(frozen=True)
class AdmittanceState:
    """Where the law stands between two readings."""

    reference: Float[np.ndarray, " 3"]
    """Target of the position servo [m, m, rad]."""
    velocity: Float[np.ndarray, " 3"]
    """Of the reference [m/s, m/s, rad/s]."""
    wrench: Float[np.ndarray, " 3"]
    """Filtered [N, N, N·m]."""
    slow: Float[np.ndarray, " 3"]
    """Filtered more slowly [N, N, N·m]."""
    mark: Mark
    """The way on which it has not changed."""
    soft: Float[np.ndarray, " 3"] | None = None
    """Direction of that way in x, z [m] and phi [rad], of any length; None: it is too short."""
    touched_at: Float[np.ndarray, " 3"] | None = None
    """The last reference at which a contact was felt, while it counts."""

    @property
    def in_contact(self) -> bool:
        """Whether the damping is that of contact."""
        return self.touched_at is not None


def at_rest(pose: Float[np.ndarray, " 3"], wrench: Float[np.ndarray, " 3"]) -> AdmittanceState:
    """The state of an arm that stands at a pose [m, m, rad] with a wrench [N, N, N·m]."""
    pose, wrench = pose.astype(float), wrench.astype(float)
    return AdmittanceState(pose, np.zeros(3), wrench, wrench, Mark(pose, wrench, SLOW_TIME))


def for_new_command(state: AdmittanceState) -> AdmittanceState:
    """The same state with a way that begins here: what was soft may not be so on the next."""
    return replace(state, mark=Mark(state.reference, state.slow, SLOW_TIME), soft=None)


def residual(
    settings: AdmittanceSettings, state: AdmittanceState, command: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " 3"]:
    """K (u - r) + w [N, N, N·m]: what still moves the arm, zero once it has settled."""
    offset = command - state.reference
    offset[2] = np.remainder(offset[2] + np.pi, 2 * np.pi) - np.pi
    return np.array(settings.stiffness) * offset + state.wrench


def travel_time(
    settings: AdmittanceSettings, state: AdmittanceState, command: Float[np.ndarray, " 3"]
) -> float:
    """Time of the way to a command at full speed [s]."""
    way = (residual(settings, state, command) - state.wrench) / np.array(settings.stiffness)
    return float((np.abs(way) / np.array(settings.speed_limit)).max())


def advance(
    settings: AdmittanceSettings,
    state: AdmittanceState,
    command: Float[np.ndarray, " 3"],
    wrench: Float[np.ndarray, " 3"],
    step: float,
) -> AdmittanceState:
    """The state after a reading of the wrench, `step` seconds after the last one.

    The step is implicit in the spring, so that a late reading makes the arm slow and never
    throws it past the command.
    """
    state = _felt(settings, state, wrench, step)
    spring = step * np.array(settings.stiffness)
    free, heavy = np.array(settings.free_damping) + spring, np.array(settings.damping) + spring
    force = residual(settings, state, command)
    limit = np.array(settings.speed_limit)
    if state.touched_at is None:
        velocity = _within(limit, np.zeros(3), force / free)
    else:
        velocity = _within(limit, np.zeros(3), force / heavy)
        if state.soft is not None:
            # D = H^1/2 (1 - (1 - d) n n') H^1/2, with d the lighter damping along n.
            root = np.sqrt(heavy)
            n = root * state.soft / np.linalg.norm(root * state.soft)
            lighter = float(n @ (free / heavy * n))
            mean = force - state.wrench + state.mark.wrench
            along = (1 / lighter - 1) * float(n @ (mean / root)) * n / root
            velocity = _within(limit, velocity, along)
    return replace(state, reference=state.reference + step * velocity, velocity=velocity)


def _felt(
    settings: AdmittanceSettings,
    state: AdmittanceState,
    wrench: Float[np.ndarray, " 3"],
    step: float,
) -> AdmittanceState:
    """The state with a reading filtered, and what it says of contact and of the way."""
    fast, gentle = (step / (time + step) for time in (settings.filter_time, SLOW_TIME))
    filtered = state.wrench + fast * (wrench - state.wrench)
    slow = state.slow + gentle * (wrench - state.slow)
    touched_at = state.touched_at
    if bool((np.abs(filtered) > settings.touch).any()):
        touched_at = state.reference
    elif touched_at is not None:
        way = state.reference - touched_at
        if float(np.hypot(way[0], way[1])) > settings.release:
            touched_at = None
    mark, soft = state.mark, state.soft
    noise = NOISE_FACTOR * np.array(settings.noise)
    ends = (
        (slow, np.maximum(SLIGHT, noise * np.sqrt(gentle / (2 - gentle)))),
        (filtered, np.maximum(settings.touch, noise * np.sqrt(fast / (2 - fast)))),
    )
    if any(bool((np.abs(value - mark.wrench) > most).any()) for value, most in ends):
        mark, soft = Mark(state.reference, slow, SLOW_TIME), None
    else:
        age = mark.age + step
        memory = MEMORY * settings.damping[0] / settings.stiffness[0]
        mean = mark.wrench + step / min(age, memory) * (wrench - mark.wrench)
        mark = replace(mark, wrench=mean, age=age)
        if age < BEGINNING:
            mark = replace(mark, reference=state.reference)
        way = state.reference - mark.reference
        if float(np.hypot(np.hypot(way[0], way[1]), LEVER * way[2])) > WAY:
            mark, soft = replace(mark, reference=state.reference), way
    return replace(state, wrench=filtered, slow=slow, mark=mark, soft=soft, touched_at=touched_at)


def _within(
    limit: Float[np.ndarray, " 3"], base: Float[np.ndarray, " 3"], more: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " 3"]:
    """`base` and as much of `more` as keeps each axis within its limit."""
    moves = np.abs(more) > 1e-9 * limit
    room = np.maximum(limit - np.sign(more) * base, 0.0)
    share = float(np.where(moves, room / np.where(moves, np.abs(more), 1.0), 1.0).min())
    return base + min(1.0, share) * more


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, z, angle = values.tolist()
    return x, z, angle
