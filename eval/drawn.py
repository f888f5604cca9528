"""Episodes drawn from the model that the default estimator's likelihood assumes.

What is exact: each transition starts at the true pose of the row before and settles against
terrains that are further away by the misfit, of which each run has one field and one size; what
slopes do to the lever is linear. Pose and wrench are measured with noise.
Commands depend on earlier measurements only (tpcd/truth/motions.py), which no posterior
minds, and the start pose is drawn without regard to theta and misfit, as long as the object is
free there, which the likelihood knows, and near the floor, which the first data say. What is
not exact: the filter's linearisation in the start pose and in what is not known of the misfit
yet; a misfit so large that the angle at which it is read does not settle (some centimetres; keep
`--misfit` to millimetres); the robust treatment of outliers and of bad parity, which concerns
about 1 datum in 1000 each.
"""

from __future__ import annotations

import torch

from tpcd.belief.belief import misfit_field
from tpcd.belief.prior import ParameterPrior
from tpcd.belief.settings import EstimatorSettings
from tpcd.contact import scene_from_parameters, terrain_gaps
from tpcd.data.episode import Episode
from tpcd.simulator import simulate_step
from tpcd.truth.motions import History, rich_exploration
from tpcd.truth.recording import DEFAULT_SENSOR_STD
from tpcd.truth.scene import DEFAULT_STIFFNESS

ANGLE_ROUNDS = 30
"""Rounds, each of half a step, in which the angle at which the misfit is read settles."""
LEFTMOST_START = 0.12
HIGHEST_START = 0.20
"""Start poses lie so far left of the origin, and over the lowest floor, at most [m]."""
LARGEST_GAP = 0.02
"""Distance from the floor at the start at most [m]: it is met within two steps."""


def draw_episode(
    prior: ParameterPrior,
    settings: EstimatorSettings,
    steps: int,
    generator: torch.Generator,
) -> tuple[torch.Tensor, Episode]:
    """Theta and the size of the misfit (d + 1) from the prior, and an episode given both."""

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    # A start pose drawn without regard to theta says something about theta all the same: the
    # object is free there. The likelihood knows that, so all of it is drawn until it is.
    start = torch.zeros(3, dtype=torch.float64)
    field = misfit_field(prior.shape, settings)
    low, high = (edge[prior.names.index("floor_height")] for edge in (prior.low, prior.high))
    while True:
        score = prior.sample(1, generator)
        scene = scene_from_parameters(prior.shape, prior.to_parameters(score[0]))
        terrains = len(scene.terrains)
        misfit_sd = field.sd_of(normal(1))[0]
        coefficients = misfit_sd * normal(field.bumps * terrains)
        draw = torch.rand(2, generator=generator, dtype=torch.float64)
        start[0] = -LEFTMOST_START * draw[0]
        start[1] = low + draw[1] * (high - low + HIGHEST_START)
        gaps = terrain_gaps(scene, start)
        left = misfit_sd * field.uncovered(field.basis(start[2])[0]).sqrt() * normal(terrains)
        floor_gap, wall_gap = gaps.amin(-1) + field.gap(coefficients, start[2]) + left
        if 0 < floor_gap < LARGEST_GAP and wall_gap > 0:
            break
    vector = prior.to_vector(score)[0]
    stiffness = torch.tensor(DEFAULT_STIFFNESS, dtype=torch.float64)
    sensor_std = torch.tensor(DEFAULT_SENSOR_STD, dtype=torch.float64)
    # `history_of` adds what any simulator's numerics leave to the noise of the poses.
    pose_std = (sensor_std[:3] ** 2 + 2e-5**2).sqrt()
    wrench_variance = (sensor_std[3:] ** 2 + 2e-5**2) / stiffness**2
    weight = pose_std**2 / (pose_std**2 + wrench_variance)

    motion = rich_exploration(generator)
    settled = start
    commands = settled[None].clone()
    poses = (settled + pose_std * normal(3))[None]
    wrenches = (sensor_std[3:] * normal(3))[None]
    for _ in range(steps):
        command = motion.next_command(History(commands, poses, wrenches, stiffness))
        noise = pose_std * normal(3)
        wrench_noise = sensor_std[3:] * normal(3) / stiffness
        # The likelihood reads the field at the estimated angle, which the field itself moves.
        error = noise + weight * (wrench_noise - noise)
        own, steep = misfit_sd * normal(terrains), misfit_sd * field.roughness * normal(terrains)
        angle = settled[2]
        for _ in range(ANGLE_ROUNDS):
            value, slope = field.basis(angle)
            gap = field.gap(coefficients, angle)
            gap = gap + field.uncovered(value).sqrt() * own
            there = simulate_step(
                scene.further(gap),
                settled,
                command,
                stiffness,
                settings.step,
                previous=commands[-1],
            )
            lever = coefficients.reshape(terrains, -1) @ slope + steep
            pose = there.pose + (there.pose_from_lever * lever[:, None]).sum(0)
            angle = 0.5 * (angle + (pose + error)[2])
        settled = pose
        commands = torch.cat((commands, command[None]))
        poses = torch.cat((poses, (settled + noise)[None]))
        wrench = stiffness * (settled + wrench_noise - command)
        wrenches = torch.cat((wrenches, wrench[None]))
    truth = torch.cat((vector, misfit_sd[None]))
    return truth, Episode(commands, poses, wrenches, stiffness, sensor_std, object="drawn")
