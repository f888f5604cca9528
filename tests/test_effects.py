"""Effects: null values change no bit, and what each does at known sizes."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tpcd.belief.filter import HistoryLikelihood
from tpcd.belief.history import History, history_of
from tpcd.belief.likelihood import history_likelihood
from tpcd.belief.misfit import MisfitField
from tpcd.belief.prior import make_prior
from tpcd.contact import ContactScene
from tpcd.effects import KNOWN, Effect
from tpcd.effects.conditions import Rows
from tpcd.effects.protocol import Added
from tpcd.effects.simulate import simulate_rows
from tpcd.effects.truth import EffectTruth, added_effects
from tpcd.parameters import Parameters
from tpcd.planar import rotate, wrap_angle
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.simulator import QuasistaticTruth, StepSettings
from tpcd.terrain import floor, wall
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

STIFFNESS = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
HALF = 0.05
BOX = torch.tensor([[-HALF, 0.0], [HALF, 0.0], [HALF, 2 * HALF], [-HALF, 2 * HALF]]).double()
"""A box of 100 mm that rests on its lower face, 0 under the end effector."""
FRICTION, WALL_AT = 0.4, 0.15


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def run(hidden: dict[str, dict[str, float]], *commands: tuple[float, float, float]) -> Tensor:
    """Settled poses and readings (n, 6) of a box that starts 10 mm over the floor."""
    truth = EffectTruth(
        BOX,
        FRICTION,
        0.0,
        WALL_AT,
        STIFFNESS,
        added_effects(hidden),
        len(commands),
    )
    truth.reset(vector(0.0, 0.01, 0.0))
    rows = []
    for command in commands:
        pose, wrench, settled = truth.step(vector(*command))
        assert settled
        rows.append(torch.cat((pose, wrench)))
    return torch.stack(rows)


@pytest.fixture(scope="module")
def history() -> History:
    generator = torch.Generator().manual_seed(3)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    motion = make_motion("rich", scene, 8, generator)
    truth = make_truth(scene, "quasistatic")
    return history_of(record(truth, scene, motion, 8, generator).measured)


def likelihood_with(history: History, count: int, effects: tuple[Effect, ...]) -> HistoryLikelihood:
    """The likelihood at `count` draws of theta with these effects at their null values."""
    shape = PolygonShape(builtin_outlines()["mug"])
    prior = make_prior(shape)
    draws = prior.to_vector(prior.sample(count, torch.Generator().manual_seed(1)))
    field, sd = MisfitField(5e-4), torch.full((count,), 5e-4, dtype=torch.float64)
    nulls = [parameter.null for effect in effects for parameter in effect.parameters]
    null = torch.tensor([nulls], dtype=torch.float64).expand(count, -1)
    return history_likelihood(
        shape,
        Parameters.from_vector(draws),
        sd,
        history,
        field,
        StepSettings(),
        **({"added": Added(effects, null)} if effects else {}),
    )


@pytest.fixture(scope="module")
def without(history: History) -> HistoryLikelihood:
    """The likelihood without effects, by compiled loops."""
    return likelihood_with(history, 6, ())


@pytest.mark.parametrize("effect", KNOWN, ids=lambda effect: effect.name)
def test_null_values_change_no_bit(
    effect: Effect, history: History, without: HistoryLikelihood
) -> None:
    found = likelihood_with(history, 6, (effect,))
    assert torch.equal(found.total, without.total)
    assert torch.equal(found.field_mean, without.field_mean)


def test_without_effects_the_truth_is_the_quasistatic_one() -> None:
    plain = QuasistaticTruth(BOX, FRICTION, 0.0, WALL_AT, STIFFNESS)
    plain.reset(vector(0.0, 0.01, 0.0))
    commands = [(0.0, -0.03, 0.0), (0.04, -0.03, 0.0), (0.13, -0.02, 0.05)]
    rows = run({}, *commands)
    for command, row in zip(commands, rows, strict=True):
        pose, wrench, _ = plain.step(vector(*command))
        torch.testing.assert_close(row, torch.cat((pose, wrench)), rtol=0, atol=1e-12)


def test_a_soft_floor_sinks_in_proportion_to_its_load() -> None:
    rows = run({"floor_compliance": {"compliance": 2.5e-4}}, (0, -0.02, 0), (0, -0.05, 0))
    torch.testing.assert_close(rows[:, 1], -2.5e-4 * rows[:, 4], rtol=1e-5, atol=0)
    assert rows[0, 4] < rows[1, 4]


def test_a_soft_wall_sinks_in_proportion_to_its_load() -> None:
    rows = run({"wall_compliance": {"compliance": 2.5e-4}}, (0.13, 0.05, 0), (0.15, 0.05, 0))
    sunk = rows[:, 0] + HALF - WALL_AT
    torch.testing.assert_close(sunk, -2.5e-4 * rows[:, 3], rtol=1e-5, atol=0)


@pytest.mark.parametrize(
    ("surface", "hidden"),
    [
        ("floor", {"floor_compliance": {"compliance": 5e-4}}),
        ("wall", {"wall_compliance": {"compliance": 5e-4}}),
        ("floor", {"floor_height ~ root of load": {"slope": 1e-3}}),
    ],
)
def test_what_sticks_to_a_soft_surface_stays_where_it_is_as_the_load_changes(
    surface: str, hidden: dict[str, dict[str, float]]
) -> None:
    moves = ((0, 0.03, 0), (0, -0.02, 0), (0.006, -0.02, 0), (0.006, -0.07, 0), (0.006, -0.02, 0))
    if surface == "wall":
        moves = ((0, 0.05, 0), *((0.11 - z, 0.05 + x, 0.0) for x, z, _ in moves[1:]))
    rows = run(hidden, *moves)[1:]
    along, load = (0, 4) if surface == "floor" else (1, 3)
    assert rows[2, load].abs() > rows[1, load].abs() + 3
    torch.testing.assert_close(rows[1:, along], rows[:1, along].expand(3), rtol=0, atol=1e-6)


def test_a_grip_on_a_soft_surface_keeps_its_way_through_other_loads() -> None:
    """There and back: sideways force and yield are in proportion, whatever the load was."""
    c = 5e-4
    soft = {name: {"compliance": c} for name in ("floor_compliance", "tangential_compliance")}
    commands = ((0, -0.03, 0), (0.006, -0.03, 0), (0.006, -0.07, 0), (-0.006, -0.05, 0))
    rows = run(soft, *commands)
    torch.testing.assert_close(rows[1:, 0], -c * rows[1:, 3], rtol=2e-3, atol=0)


@pytest.mark.parametrize(
    "hidden",
    [
        {"tangential_compliance": {"compliance": 5e-4}},
        {"floor_height ~ root of load": {"slope": 1e-3}},
    ],
    ids=lambda hidden: next(iter(hidden)),
)
def test_one_pass_ends_where_many_end(
    hidden: dict[str, dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On one surface the arm, a spring, answers what yields in proportion."""
    moves = ((0, -0.03, 0), (0.006, -0.03, 0), (0.006, -0.07, 0), (-0.006, -0.05, 0))
    many = run(hidden, *moves)
    monkeypatch.setattr("tpcd.effects.truth.TRUE_PASSES", 1)
    one = run(hidden, *moves)
    monkeypatch.setattr("tpcd.effects.truth.TRUE_PASSES", 0)
    none = run(hidden, *moves)
    assert (none - many)[:, :2].abs().max() > 2e-4
    torch.testing.assert_close(one[:, :3], many[:, :3], rtol=0, atol=3e-6)


def test_effects_that_answer_to_each_other_get_one_pass_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where the floor yields, what slips is dragged less, and holds so before it is let go."""
    hidden = {
        "floor_height ~ root of load": {"slope": 2e-3},
        "tangential_compliance": {"compliance": 5e-4},
    }
    assert [added_effects({name: value}).passes for name, value in hidden.items()] == [1, 1]
    moves = ((0, -0.03, 0), (0.03, -0.03, 0), (0.028, -0.03, 0), (0.024, -0.05, 0))
    many, off = run(hidden, *moves), {}
    for passes in (1, added_effects(hidden).passes):
        monkeypatch.setattr("tpcd.effects.truth.TRUE_PASSES", passes)
        off[passes] = float((run(hidden, *moves) - many)[:, :2].abs().max())
    assert off[1] > 1e-5 and off[2] < 0.1 * off[1], off


def test_pairs_of_rows_know_what_they_begin_with() -> None:
    """A step from a grip, told as the command before and the next, ends where it does in a run."""
    hidden = {"tangential_compliance": {"compliance": 5e-4}}
    moves = ((0, -0.03, 0), (0.006, -0.03, 0), (-0.004, -0.05, 0), (0.004, -0.02, 0))
    poses = run(hidden, *moves)[:, :3]
    before, commands = (torch.tensor(m, dtype=torch.float64) for m in (moves[:-1], moves[1:]))
    one = torch.ones(1, dtype=torch.float64)
    scene = ContactScene(
        BOX[None], (floor(0 * one), wall(WALL_AT * one)), torch.full((1, 2), FRICTION).double()
    )
    rows = Rows(
        torch.arange(3).repeat_interleave(2) * 2,
        torch.ones(6, dtype=torch.float64),
        poses[:-1].repeat_interleave(2, dim=0),
    )
    asked = torch.stack((before, commands), dim=1).flatten(0, 1)
    found = simulate_rows(scene, rows, asked, STIFFNESS, added_effects(hidden), StepSettings())
    assert found.index.tolist() == [1, 3, 5]
    torch.testing.assert_close(found.transition.pose[0], poses[1:], rtol=0, atol=2e-6)


def test_a_contact_that_sticks_yields_sideways() -> None:
    commands = ((0, -0.03, 0), (0.006, -0.03, 0))
    stiff, soft = (
        run({}, *commands),
        run({"tangential_compliance": {"compliance": 2.5e-4}}, *commands),
    )
    assert stiff[1, 0].abs() < 1e-9
    torch.testing.assert_close(soft[1, 0], -2.5e-4 * soft[1, 3], rtol=2e-3, atol=0)


def test_a_tilted_floor_lifts_what_slides_up() -> None:
    angle = 0.03
    rows = run({"floor_tilt": {"angle": angle}}, (-0.03, -0.03, angle), (0.05, -0.03, angle))
    moved = rows[1] - rows[0]
    assert moved[0] > 0.03
    torch.testing.assert_close(
        moved[1] / moved[0], torch.tensor(angle).double().tan(), rtol=1e-3, atol=0
    )


def test_a_curved_floor_is_touched_where_it_is() -> None:
    """A box sits with both its edges on a valley: its middle is c h^2 / 2 over the bottom."""
    rows = run({"floor_curvature": {"curvature": -1.0}}, (0, -0.03, 0), (0.0, -0.04, 0))
    torch.testing.assert_close(rows[1, 1], torch.zeros(()).double(), rtol=0, atol=2e-3)


def test_friction_of_the_wall_is_its_own() -> None:
    up = ((0.13, 0.03, 0), (0.13, 0.08, 0))
    for ratio in (0.0, -0.6):
        rows = run({"wall_friction": {"log_ratio": ratio}}, *up)
        expected = FRICTION * torch.tensor(ratio).double().exp()
        torch.testing.assert_close(-rows[1, 4] / -rows[1, 3], expected, rtol=1e-5, atol=0)


def test_friction_depends_on_the_direction_of_slip() -> None:
    ways = ((0, -0.03, 0), (0.06, -0.03, 0), (-0.04, -0.03, 0))
    rows = run({"directional_friction": {"log_ratio": 0.3}}, *ways)
    ratio = (rows[1:, 3] / rows[1:, 4]).abs()
    expected = FRICTION * torch.tensor([0.3, -0.3]).double().exp()
    torch.testing.assert_close(ratio, expected, rtol=1e-5, atol=0)


def test_friction_that_depends_on_load() -> None:
    rows = run(
        {"load_friction": {"exponent": -0.3}},
        (0, -0.02, 0),
        (0.05, -0.02, 0),
        (0.05, -0.05, 0),
        (0.08, -0.05, 0),
    )
    for row in (rows[1], rows[3]):
        expected = FRICTION * (row[4] / 3.0) ** -0.3
        torch.testing.assert_close(-row[3] / row[4], expected, rtol=1e-3, atol=0)


def test_static_friction_holds_until_it_slips() -> None:
    press, hold, slide = (0, -0.03, 0), (0.014, -0.03, 0), (0.05, -0.03, 0)
    rows = run({"static_kinetic": {"ratio": 1.4}}, press, hold, slide)
    assert rows[1, 0].abs() < 1e-9 and -rows[1, 3] > FRICTION * rows[1, 4]
    torch.testing.assert_close(-rows[2, 3] / rows[2, 4], vector(FRICTION)[0], rtol=1e-5, atol=0)


def test_adhesion_holds_until_it_is_pulled_off() -> None:
    rows = run({"adhesion": {"force": 1.0}}, (0, -0.02, 0), (0, 0.008, 0), (0, 0.02, 0))
    torch.testing.assert_close(rows[1, 4], vector(-0.8)[0], rtol=0, atol=1e-6)
    assert rows[1, 1].abs() < 1e-9
    torch.testing.assert_close(rows[2, 4], vector(0.0)[0], rtol=0, atol=1e-9)


def test_payload_sags_in_free_space_and_keeps_parity() -> None:
    rows = run({"payload": {"weight": 1.0, "lever": 0.05}}, (0, 0.05, 0.0))
    torch.testing.assert_close(rows[0], vector(0, 0.04, -0.001, 0, -1.0, -0.05), rtol=0, atol=1e-9)


def test_lag_and_arm_friction_stop_short() -> None:
    lag = run({"command_lag": {"share": 0.1}}, (0, 0.06, 0), (0, 0.06, 0))
    torch.testing.assert_close(lag[:, 1], vector(0.055, 0.06), rtol=0, atol=1e-9)
    stuck = run(
        {"arm_friction": {"force": 0.3}}, (0, 0.06, 0), (0, 0.06, 0), (0, 0.058, 0), (0, 0.02, 0)
    )
    torch.testing.assert_close(stuck[:, 1], vector(0.057, 0.057, 0.057, 0.023), rtol=0, atol=1e-9)
    assert stuck[:, 3:].abs().max() < 1e-9


def test_stiffness_error_shows_in_the_wrench() -> None:
    rows = run({"stiffness_error": {"log_ratio_z": 0.1}}, (0, -0.03, 0))
    torch.testing.assert_close(rows[0, 4], 3.0 * vector(0.1)[0].exp(), rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("hidden", "expected"),
    [
        ({"force_bias": {"F_x": 0.5, "tau": 0.03}}, (0.5, 3.0, 0.03)),
        ({"force_drift": {"F_z": -1.0}}, (0.0, 2.0, 0.0)),
        ({"force_gain": {"gain": 0.08}}, (0.0, 3.24, 0.0)),
        ({"sensor_rotation": {"angle": 0.1}}, (-3.0 * 0.0998334166, 3.0 * 0.9950041653, 0.0)),
        ({"wrench_reference_point": {"x": 0.02}}, (0.0, 3.0, -0.06)),
    ],
)
def test_sensors_read_what_they_are_said_to(
    hidden: dict[str, dict[str, float]], expected: tuple[float, float, float]
) -> None:
    rows = run(hidden, (0, -0.03, 0))
    torch.testing.assert_close(rows[0, 3:], vector(*expected), rtol=0, atol=1e-6)
    assert rows[0, 1].abs() < 1e-9


def test_a_loose_grasp_turns_with_the_torque_and_slips() -> None:
    """Pressed on one lower edge, 50 mm from the end effector."""
    tilted = (0, -0.03, 0.1)
    rows = run({"grasp_compliance": {"compliance": 0.1}}, tilted)
    corner = torch.tensor(0.1).double() + rows[0, 2] - 0.1 + 0.1 * rows[0, 5]
    torch.testing.assert_close(rows[0, 1], HALF * corner.sin(), rtol=2e-2, atol=0)
    slipped = run(
        {"grasp_slip": {"angle": 0.03, "at": 0.9}}, (0, 0.05, 0), (0, 0.05, 0), (0, -0.01, 0.02)
    )
    assert slipped[:2, 3:].abs().max() < 1e-9
    torch.testing.assert_close(
        slipped[2, 1], HALF * (slipped[2, 2] + 0.03).sin(), rtol=1e-6, atol=0
    )


def test_a_drifting_floor_rises_over_the_run() -> None:
    rows = run({"floor_drift": {"drift": 0.003}}, (0, -0.03, 0), (0, -0.03, 0), (0, -0.03, 0))
    torch.testing.assert_close(rows[:, 1], vector(0.001, 0.002, 0.003), rtol=0, atol=1e-7)


def test_a_soft_grasp_twists_alike_wherever_the_angle_begins() -> None:
    """An angle counted from elsewhere, across pi and beyond it, is the same arm."""
    commands = [(0.0, -0.03, 0.05), (0.02, -0.03, 0.08)]
    plain = run({"grasp_compliance": {"compliance": 0.05}}, *commands)
    for turn in (math.pi, 1.5 * math.pi, -math.pi):
        outline = rotate(vector(-turn), BOX)
        hidden = added_effects({"grasp_compliance": {"compliance": 0.05}})
        truth = EffectTruth(outline, FRICTION, 0.0, WALL_AT, STIFFNESS, hidden, len(commands))
        truth.reset(vector(0.0, 0.01, turn))
        for command, expected in zip(commands, plain, strict=True):
            pose, wrench, _ = truth.step(vector(*command) + vector(0.0, 0.0, turn))
            found = torch.cat((pose, wrench))
            found[2] = wrap_angle(found[2] - turn)
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
