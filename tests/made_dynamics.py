"""A mass that springs pull over a floor, as three streams with clocks of their own."""

from __future__ import annotations

import numpy as np

from tpcd.quality.stream import Stream

POSE, WRENCH, COMMAND = ("x", "y", "z"), ("F_x", "F_y", "F_z"), ("u_x", "u_y", "u_z")


def an_arm(stiffness: float, mass: float, seed: int, holds: int = 40) -> dict[str, np.ndarray]:
    """A mass on spring and damper over a floor with friction, sampled at 200 Hz with noise."""
    random = np.random.default_rng(seed)
    damping, step, rate = 2.0 * np.sqrt(stiffness * mass), 5e-4, 10
    times = np.arange(holds * 3800) * step
    goals = random.uniform((-0.1, -0.04), (0.1, 0.05), (holds, 2))
    goals[0] = 0.0, 0.05
    since = times % 1.9
    old, new = (
        goals[np.maximum(np.arange(len(times)) // 3800 - 1, 0)],
        goals[np.arange(len(times)) // 3800],
    )
    commands = old + (new - old) * np.minimum(since / 0.3, 1.0)[:, None]
    place, speed, path, force = commands[0].copy(), np.zeros(2), [], []
    for command in commands:
        deep = max(-place[1], 0.0)
        press = max(2e4 * deep - (200.0 * speed[1] if deep else 0.0), 0.0)
        pushed = np.array([-0.4 * press * np.tanh(speed[0] / 1e-3), press])
        speed = speed + step * (stiffness * (command - place) - damping * speed + pushed) / mass
        place = place + step * speed
        path.append(place)
        force.append(pushed)
    wide = [np.stack((v[:, 0], 0 * v[:, 0], v[:, 1]), axis=1)[::rate]
            for v in map(np.asarray, (path, force, commands))]  # fmt: skip
    noise = random.standard_normal((2, len(wide[0]), 3))
    return {
        "time": times[::rate],
        "pose": wide[0] + 1e-4 * noise[0],
        "wrench": wide[1] + 0.1 * noise[1],
        "command": wide[2],
    }


def parts_of(arm: dict[str, np.ndarray], wrench: float = 0.0, command: float = 0.0) -> list[Stream]:
    return [
        Stream("/pose", POSE, arm["time"], arm["pose"]),
        Stream("/ft", WRENCH, arm["time"] + wrench, arm["wrench"]),
        Stream("/to", COMMAND, arm["time"] + command, arm["command"]),
    ]
