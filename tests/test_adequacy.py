"""The absolute test of a model: what it finds left by a model that is true, and by others."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from tpcd.belief.cloud import start_cloud
from tpcd.belief.history import history_of
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.contact import scene_from_parameters
from tpcd.data.episode import Episode
from tpcd.discrepancy.adequacy import Adequacy, check_adequacy
from tpcd.discrepancy.diagnosis import CHANNELS, Cell
from tpcd.discrepancy.fit import Fit, Question
from tpcd.effects import find_effect
from tpcd.parameters import Parameters
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import ContactMode, StepSettings, rollout

STIFF = torch.tensor([1000.0, 1000.0, 50.0], dtype=torch.float64)
SOFT = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
NOISE = torch.tensor([2e-4, 2e-4, 5e-4, 0.2, 0.2, 0.02], dtype=torch.float64)
PRIOR = make_prior(PolygonShape(builtin_outlines()["mug"]))
#: scale, mount (x, z, phi), friction, floor, wall
TRUTH = torch.tensor([1.0, 0.0, 0.0, 0.05, 0.5, -0.01, 0.12], dtype=torch.float64)
COUNT = 40
LEVEL = 1e-3
POSE, WRENCH = CHANNELS[:3], CHANNELS[3:]


def held(stiffness: Tensor = STIFF) -> tuple[Tensor, Tensor]:
    """Commands and true poses of a mug that is pushed against the wall, which holds it."""
    scene = scene_from_parameters(PRIOR.shape, Parameters.from_vector(TRUTH[None]))
    start = torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
    force = torch.linspace(0.0, 3.0, COUNT - 1, dtype=torch.float64).sin().abs()
    commands = start.repeat(COUNT, 1)
    commands[1:, 0] = 0.11 + 0.002 * force
    steps = rollout(scene, start[None], commands[1:, None], stiffness, previous=start[None])
    stuck = [int(step.mode[0, 1]) == int(ContactMode.STICK) for step in steps]
    assert sum(stuck) > 0.8 * len(stuck)
    return commands, torch.cat((start[None], *(step.pose for step in steps)))


def read(
    commands: Tensor, poses: Tensor, wrenches: Tensor, seed: int, stiffness: Tensor = STIFF
) -> Episode:
    generator = torch.Generator().manual_seed(seed)
    noise = NOISE * torch.randn(COUNT, 6, generator=generator, dtype=torch.float64)
    return Episode(commands, poses + noise[:, :3], wrenches + noise[:, 3:], stiffness, NOISE)


def left_by_the_truth(episode: Episode, parity: bool = True, effects: tuple = ()) -> Adequacy:
    """What the true scene leaves of an episode; effects at the values that are given with them."""
    prior = PRIOR.with_effects(tuple(effect for effect, _ in effects))
    vector = torch.cat((TRUTH, *(torch.tensor([value]).double() for _, value in effects)))
    score = torch.cat((prior.to_score(vector), torch.zeros(1).double()))[None]
    fit = Fit(prior.effects, StepSettings(), prior, (0.0,), (start_cloud(score),))
    history = replace(history_of(episode), parity_counts=parity)
    question = Question(history, PRIOR, MisfitField(0.0), StepSettings())
    return check_adequacy(question, fit, torch.Generator().manual_seed(1000))


def largest(found: Adequacy, channels: tuple[str, ...]) -> float:
    return max(abs(cell.score) for cell in found.cells if cell.channel in channels)


def test_where_the_wall_holds_an_object_a_true_model_leaves_nothing() -> None:
    """There x is read with noise alone, of which an innovation must not be told to depend on it."""
    commands, poses = held()
    chances = []
    for seed in range(60):
        found = left_by_the_truth(read(commands, poses, STIFF * (poses - commands), seed))
        chances.append(found.cells_p)
        assert bool(found.left(LEVEL)) != found.adequate(LEVEL)
    p = torch.tensor(chances)
    # With a chance of 5 % each, more than seven of 60 would be so in one of a hundred cases.
    assert int((p < 0.05).sum()) <= 7
    assert 0.35 < float(p.median()) < 0.65


def test_a_wall_that_yields_is_left_in_the_pose_and_not_in_the_wrench() -> None:
    commands, rigid = held()
    compliance = 1e-5
    # With x = wall + compliance K (u - x) for the rigid pose at the wall.
    poses = rigid.clone()
    give = compliance * STIFF[0]
    poses[1:, 0] = (rigid[1:, 0] + give * commands[1:, 0]) / (1 + give)
    episode = read(commands, poses, STIFF * (poses - commands), 0)
    found = left_by_the_truth(episode)
    assert not found.adequate(LEVEL)
    assert found.cells[0].channel == "x"
    assert "x " in found.left(LEVEL)
    assert largest(found, WRENCH) < largest(found, POSE) / 2


def test_a_sensor_off_by_the_square_of_the_force_is_left_in_the_wrench_alone() -> None:
    """A soft arm's wrench hardly counts in the pose that both readings tell."""
    commands, poses = held(SOFT)
    wrenches = SOFT * (poses - commands)
    wrenches[:, 0] *= 1 + wrenches[:, 0].abs() / 100
    episode = read(commands, poses, wrenches, 0, SOFT)
    found = left_by_the_truth(episode)
    assert not found.adequate(LEVEL)
    assert found.cells[0].channel == "F_x"
    assert "F_x" in found.left(LEVEL)
    assert largest(found, POSE) < largest(found, WRENCH) / 2
    unheard = left_by_the_truth(episode, parity=False)
    assert {c.channel for c in unheard.cells} == set(POSE)
    assert unheard.adequate(LEVEL)


def test_an_effect_of_the_sensor_takes_away_what_is_left_in_the_wrench() -> None:
    commands, poses = held()
    gain = 0.02
    episode = read(commands, poses, (1 + gain) * STIFF * (poses - commands), 0)
    assert not left_by_the_truth(episode).adequate(LEVEL)
    assert left_by_the_truth(episode, effects=((find_effect("force_gain"), gain),)).adequate(LEVEL)


def test_rows_that_the_model_does_not_explain_are_told() -> None:
    commands, rigid = held()
    poses = rigid.clone()
    off = [7, 8, 20, 21, 22, 30]
    poses[off, 1] += 0.02
    episode = read(commands, poses, STIFF * (poses - commands), 0)
    found = left_by_the_truth(episode)
    assert found.unexplained_p < LEVEL
    rows = [row for row, _ in found.beyond]
    # A row that is off, and the one that follows it and starts there.
    assert set(off) <= set(rows) | {row + 1 for row in rows}
    assert f"rows {rows[0]}, {rows[1]}" in found.left(LEVEL)


def test_what_goes_with_something_is_told_before_what_scatters() -> None:
    cells = tuple(
        Cell("all", channel, covariate, score, 40)
        for channel, covariate, score in (
            ("F_z", "size", 9.8),
            ("F_z", "load", 7.5),
            ("z", "time", 3.0),
        )
    )
    found = Adequacy(0.0, 1.0, 0.0, cells, limit=4.5)
    assert found.left(LEVEL) == cells[1].words
    assert replace(found, limit=8.0).left(LEVEL) == cells[0].words
    assert replace(found, cells_p=0.5).left(LEVEL) == ""
