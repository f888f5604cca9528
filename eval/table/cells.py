"""One cell of the table: one object, one truth, one seed, one estimator with one policy.

The scene and the test trajectories depend on the truth, the object and the seed alone (decoded
outlines also on the prior they are decoded with), so that rows of the table can be compared in
pairs; they are made once for all rows of such a group.
"""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from eval.scoring import score_tests
from tpcd.belief.belief import Belief, EstimationStep
from tpcd.exploration import Estimator, explore
from tpcd.policies import Limits, make_policy
from tpcd.predict import ContactPredictor
from tpcd.random import stream
from tpcd.robot.simulated import SimulatedRobot
from tpcd.shape.checkpoint import load_prior
from tpcd.shape.protocol import Shape
from tpcd.truth.make import make_truth
from tpcd.truth.protocol import Truth
from tpcd.truth.recording import Recording, make_motion, record
from tpcd.truth.scene import Scene, draw_scene

CHECKPOINTS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30)
"""Numbers of moves after which the predictions are tested."""
TOP = 100
"""Particles of the largest weights that the paper's predictions are the mean of."""
_SCENE, _TEST, _FIT = 0, 1, 2


@dataclass(frozen=True)
class Cell:
    """What to run."""

    truth: str
    """mujoco or quasistatic with the true outline, or decoded: quasistatic with the outline that
    the estimator's own shape prior fits to it."""
    object: str
    seed: int
    estimator: str
    policy: str

    @property
    def key(self) -> tuple[str, str, int, str, str]:
        """What tells cells apart."""
        return (self.truth, self.object, self.seed, self.estimator, self.policy)


@dataclass(frozen=True)
class Outcome:
    """A row for the results, and what figures are drawn from."""

    row: dict[str, Any]
    scene: Scene
    steps: list[EstimationStep]
    exploration: Recording
    test: Recording


def run_cell(
    cell: Cell, vertices: Any, prior: str, steps: int, tests: int, test_steps: int
) -> Outcome:
    """Explore, learn, and test the predictions after several numbers of moves."""
    shape = _shape(prior)
    scene, recordings = _world(
        cell.truth, cell.object, cell.seed, prior, tests, test_steps, vertices
    )
    seed = zlib.crc32(cell.object.encode()) * 1000 + cell.seed
    robot = SimulatedRobot(_truth(cell.truth, scene), scene, seed)
    policy = make_policy(cell.policy, Limits(), scene, seed)  # type: ignore[arg-type]
    estimator = Estimator(shape, cell.estimator)  # type: ignore[arg-type]
    row: dict[str, Any] = {**vars(cell), "prior": prior, "moves": [], "mae": [], "sd": []}
    row.update({"open_mae": [], "closing_s": 0.0})
    row.update({"coverage_50": [], "coverage_90": [], "contact_90": []})
    learnt, choosing, learning = [], 0.0, 0.0
    started = time.perf_counter()
    for step in explore(robot, policy, estimator, seed):
        learnt.append(step.estimation)
        choosing += step.choosing_seconds
        learning += step.estimation.seconds
        moves = len(step.episode) - 1
        if moves in CHECKPOINTS or moves == steps:
            belief = step.estimation.belief
            found = _test(top_particles(belief, TOP) if cell.estimator == "paper" else belief,
                          recordings)  # fmt: skip
            row["moves"].append(moves)
            row["open_mae"].append(found["mae"])
            if moves == steps and estimator.closing is not None:
                learnt[-1] = estimator.closing(step.episode, step.estimation.state)
                row["closing_s"] = learnt[-1].seconds
                found = _test(learnt[-1].belief, recordings)
            for name, value in found.items():
                row[name] = value if name == "contact_transform" else [*row[name], value]
        if moves == steps:
            break
    true = torch.cat([test.true.wrenches[1:] for test in recordings])
    row["peak_wrench"] = true.abs().amax(0).tolist()
    row["largest_force"] = float(step.episode.wrenches[:, :2].abs().max())
    row["choosing_s"] = choosing / steps
    row["learning_s"] = learning / steps
    row["seconds"] = time.perf_counter() - started
    return Outcome(row, scene, learnt, robot.recording(step.episode), recordings[0])


def top_particles(belief: Belief, count: int) -> Belief:
    """The particles of the largest weights alone, as the paper predicts with."""
    kept = belief.weights.argsort(descending=True, stable=True)[:count]
    weights = belief.weights[kept]
    fields = ("vectors", "misfit_sd", "misfit_mean", "misfit_covariance")
    chosen = {name: getattr(belief, name)[kept] for name in fields}
    return replace(belief, weights=weights / weights.sum(), **chosen)


def _test(belief: Belief, recordings: tuple[Recording, ...]) -> dict[str, Any]:
    """Errors and coverage against the noise-free truth, from noisy measured poses."""
    error, transform, touching = score_tests(ContactPredictor(belief), recordings)
    return {
        "mae": error.mean(0).tolist(),
        "sd": error.std(0, correction=0).tolist(),
        "coverage_50": _covered(transform, 0.5),
        "coverage_90": _covered(transform, 0.9),
        "contact_90": _covered(transform[touching], 0.9),
        "contact_transform": [[round(v, 4) for v in one] for one in transform[touching].tolist()],
    }


def _covered(transform: Tensor, level: float) -> float:
    return float(((transform - 0.5).abs() <= level / 2).double().mean())


@lru_cache(maxsize=4)
def _shape(prior: str) -> Shape:
    return load_prior(prior)


_WORLDS: dict[tuple, tuple[Scene, tuple[Recording, ...]]] = {}


def _world(
    truth: str, name: str, seed: int, prior: str, tests: int, test_steps: int, vertices: Any
) -> tuple[Scene, tuple[Recording, ...]]:
    """Scene and test trajectories, kept until another group is asked for."""
    # Only the decoded outline depends on the prior.
    key = (truth, name, seed, prior if truth == "decoded" else "", tests, test_steps)
    if key not in _WORLDS:
        number = zlib.crc32(name.encode())
        if truth == "decoded":
            vertices = _decoded(prior, vertices)
        scene = draw_scene(name, vertices, stream(_SCENE, seed, number))
        made = []
        for test in range(tests):
            generator = stream(_TEST, seed, number, test)
            motion = make_motion("test", scene, test_steps, generator)
            made.append(record(_truth(truth, scene), scene, motion, test_steps, generator))
        if len(_WORLDS) > 3:
            _WORLDS.clear()
        _WORLDS[key] = (scene, tuple(made))
    return _WORLDS[key]


def _truth(kind: str, scene: Scene) -> Truth:
    return make_truth(scene, "mujoco" if kind == "mujoco" else "quasistatic")


def _decoded(prior: str, vertices: Any) -> Any:
    """The outline of the prior that comes nearest to a true one."""
    from training.fit import best_fit

    shape = _shape(prior)
    fit = best_fit(shape, vertices, stream(_FIT), scene=False)  # type: ignore[arg-type]
    with torch.no_grad():
        return shape.boundary_points(fit.latent[None].float())[0].double().numpy()
