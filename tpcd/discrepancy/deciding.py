"""The motion that would decide between two models which explain the data about as well.

Both foresee the moves of the diagnosis motion, each in turn as if it were true. How far apart they
are, in units of what they leave open and of the sensor's noise, is the evidence that a move would
bring (half the squared distance: the Kullback-Leibler divergence of two normal distributions).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.contact import place_points
from tpcd.data.episode import Episode
from tpcd.discrepancy.fit import Fit, Question, posterior
from tpcd.planar import wrap_angle
from tpcd.predict import ContactPredictor
from tpcd.random import stream
from tpcd.truth.diagnosis_motion import CLEARANCE, PLACES
from tpcd.truth.diagnosis_plan import diagnosis_plan

STEPS = 110
"""Commands that hold every move of the diagnosis motion at least once."""
PARTICLES = 60
RUNS = 4
"""Courses that the motion may take under a model."""
LEAST_NATS = 0.5
"""Evidence below which a move is not said to decide anything."""
ON_THE_WAY = "on the way to: "


def deciding_motion(question: Question, fit: Fit, other: Fit, episode: Episode) -> str:
    """The move of the diagnosis motion that tells two models apart best, and by how much where it
    does so most, in words."""
    beliefs = [posterior(question, one) for one in (fit, other)]
    start, floor, wall = _stage(beliefs[0])
    plan = diagnosis_plan(start, floor, wall, episode.stiffness, STEPS, 0.0)
    commands = torch.tensor([one.command for one in plan], dtype=torch.float64)
    nats = _evidence_of_moves(beliefs, commands, episode.sensor_std, question.seed)
    moves: dict[str, float] = {}
    for planned, gained in zip(plan[1:], nats.tolist(), strict=True):
        name = planned.purpose.removeprefix(ON_THE_WAY)
        moves[name] = max(moves.get(name, 0.0), gained)
    best = max(moves, key=lambda name: moves[name])
    if moves[best] < LEAST_NATS:
        return "no move of the diagnosis motion tells them apart"
    digits = 0 if moves[best] >= 10 else 1
    return f"{best} (up to {moves[best]:.{digits}f} nats each time)"


def _stage(belief: Belief) -> tuple[Float[Tensor, " 3"], float, float]:
    """A free pose, and where the hand is when the upright object touches floor and wall [m]."""
    theta = belief.parameters
    best = belief.weights.argmax()
    points = belief.prior.shape.boundary_points(theta.latent[best][None])
    points = place_points(points, theta.scale[best][None], theta.mount[best][None])[0]
    floor = float(theta.floor_height[best] - points[:, 1].min())
    wall = float(theta.wall_position[best] - points[:, 0].max())
    start = torch.tensor([wall - PLACES[1], floor + CLEARANCE, 0.0], dtype=torch.float64)
    return start, floor, wall


def _evidence_of_moves(
    beliefs: list[Belief],
    commands: Float[Tensor, "n 3"],
    sensor_std: Float[Tensor, " 6"],
    seed: int,
) -> Float[Tensor, " m"]:
    """What each of the n - 1 moves would say for the true one of two models [nats], as the mean
    over which of them is true and over courses of the motion; the first command is the start."""
    predictors = [ContactPredictor(belief, PARTICLES) for belief in beliefs]
    nats = []
    for k, true in enumerate(predictors):
        courses = true.rollout(commands[0], commands[1:], stream(seed, 80, k), samples=RUNS)
        for course in courses[..., :3]:
            poses = torch.cat((commands[:1], course[:-1]))
            arguments = (poses, commands[1:], commands[:-1], sensor_std[:3], sensor_std)
            one, two = (predictor.predict(*arguments) for predictor in predictors)
            away = one.mean - two.mean
            away = torch.cat((away[:, :2], wrap_angle(away[:, 2:3]), away[:, 3:]), dim=-1)
            variance = 0.5 * (one.std**2 + two.std**2)
            nats.append(0.5 * (away**2 / variance).sum(-1))
    return torch.stack(nats).nan_to_num(0.0).mean(0)
