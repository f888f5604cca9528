"""What the blind benchmark hides: effects, worlds, plans, and files that give nothing away."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from eval.blind.cases import draw_effect, draw_world, record_case, start_reading
from eval.blind.sealing import read_sealed
from eval.blind.suites import EFFECTS, MEDIUM, OUTSIDE, SUITES, Case, plan
from eval.blind.trial import make_case
from tpcd.data import Episode
from tpcd.effects import CATALOGUE, find_effect
from tpcd.random import stream
from tpcd.truth.injected_effects import active_effects

SEED = 10000


def same(a: Episode, b: Episode) -> bool:
    return all(
        torch.equal(getattr(a, name), getattr(b, name))
        for name in ("commands", "poses", "wrenches")
    )


def test_every_effect_of_the_catalogue_can_be_hidden_within_its_prior() -> None:
    assert set(EFFECTS) == {effect.name for effect in CATALOGUE}
    for name in EFFECTS:
        for scale in (1.0, 0.35):
            for run in range(20):
                drawn = draw_effect(name, scale, stream(SEED, run))
                for parameter in find_effect(name).parameters:
                    value = drawn.get(parameter.name, parameter.null)
                    assert parameter.low <= value <= parameter.high
    assert all(active_effects({name: OUTSIDE[name]}).values for name in OUTSIDE)


def test_sizes_stay_near_the_nominal_and_take_either_sign_where_there_are_two() -> None:
    angles = [draw_effect("floor_tilt", 1.0, stream(SEED, run))["angle"] for run in range(40)]
    nominal = MEDIUM["floor_tilt"]["angle"]
    assert all(0.8 <= abs(angle) / nominal <= 1.2 for angle in angles)
    assert min(angles) < 0 < max(angles)
    for run in range(20):
        small = draw_effect("static_kinetic", 0.35, stream(SEED, run))
        assert 1.0 + 0.35 * 0.3 * 0.8 <= small["ratio"] <= 1.0 + 0.35 * 0.3 * 1.2
        load = draw_effect("payload", 0.35, stream(SEED, run))
        assert 0.28 <= load["weight"] <= 0.42 and 0.024 <= abs(load["lever"]) <= 0.036
        assert 0.3 <= draw_effect("grasp_slip", 1.0, stream(SEED, run))["at"] <= 0.7


def test_cases_follow_from_seed_label_and_run_alone() -> None:
    case = Case("short15", "force_bias", 1)
    world, again = draw_world(case, SEED), draw_world(case, SEED)
    assert world.key() == again.key()
    assert same(record_case(world, case, SEED).measured, record_case(again, case, SEED).measured)
    assert draw_world(replace(case, suite="medium"), SEED).key() == world.key()
    for other in (replace(case, run=2), replace(case, label="force_gain")):
        assert draw_world(other, SEED).key()["theta"] != world.key()["theta"]
    assert draw_world(case, SEED + 1).key()["theta"] != world.key()["theta"]
    fresh = record_case(world, case, SEED, fresh=True).measured
    assert len(fresh) == 31 and not torch.equal(fresh.commands[:10], again_commands(case)[:10])


def again_commands(case: Case) -> torch.Tensor:
    return record_case(draw_world(case, SEED), case, SEED).measured.commands


def test_pairs_are_of_different_sites() -> None:
    for run in range(20):
        hidden = draw_world(Case("pairs", "pair", run), SEED).hidden
        first, second = (find_effect(name) for name in hidden)
        assert first.site != second.site


def test_the_start_row_is_read_by_the_same_sensor_and_keeps_its_noise() -> None:
    pose = torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
    hidden = {"payload": {"weight": 2.0, "lever": 0.05}, "force_gain": {"gain": 0.1}}
    expected = torch.tensor([0.0, -2.2, -0.11], dtype=torch.float64)
    torch.testing.assert_close(start_reading(hidden, pose), expected)
    assert not start_reading({"floor_tilt": {"angle": 0.1}}, pose).any()
    case = Case("short15", "force_bias", 0)
    world = draw_world(case, SEED)
    recording = record_case(world, case, SEED)
    noise = recording.measured.wrenches - recording.true.wrenches
    assert (
        noise[0].abs().gt(0).all()
        and (noise[0].abs() < 6 * recording.measured.sensor_std[3:]).all()
    )
    assert recording.true.wrenches[0].tolist() == pytest.approx(
        list(world.hidden["force_bias"].values())
    )


@pytest.mark.parametrize("suite, label", [("outside", "floor_step"), ("noise3", "adhesion")])
def test_other_physics_and_noise_come_from_the_suite(suite: str, label: str) -> None:
    if suite == "outside":
        pytest.importorskip("mujoco")
    case = Case(suite, label, 0)
    small = replace(case.settings, steps=5)
    world = draw_world(case, SEED)
    assert set(world.hidden) == {label}
    fake = SimpleNamespace(label=label, run=0, settings=small)
    measured = record_case(world, fake, SEED).measured  # type: ignore[arg-type]
    assert len(measured) == 6
    assert float(measured.sensor_std[0]) == pytest.approx(2e-4 * small.noise)


def test_plans_have_unique_tokens_and_all_labels() -> None:
    cases = plan(("clean", "medium", "mujoco", "no_parity"), 2)
    assert len(cases) == 2 * (1 + 23 + 24 + 24)
    assert len({case.token(SEED) for case in cases}) == len(cases)
    assert all(suite.truth == "mujoco" for suite in (SUITES["outside"], SUITES["mujoco"]))


def test_what_is_given_away_holds_no_name(tmp_path: Path) -> None:
    case = Case("short15", "floor_tilt", 0)
    sealed = make_case(case, SEED, tmp_path)
    main, fresh = read_sealed(tmp_path, sealed.case)
    assert (len(main), len(fresh)) == (16, 31)
    assert main.object is None and main.notes is None
    given = [path for path in (tmp_path / "episodes").rglob("*") if path.is_file()]
    assert sorted(path.name for path in given) == [
        "fresh.csv", "fresh.yaml", "main.csv", "main.yaml",
    ]  # fmt: skip
    name = draw_world(case, SEED).scene.outline_name
    for path in given:
        assert name not in path.read_text() and "tilt" not in path.read_text()
