"""The blind benchmark: what it hides, how it is sealed, and what verdicts are worth."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from eval.blind.__main__ import Blind, case_seed, cases_of, run_blind, score
from eval.blind.cases import draw_effect, draw_world, record_case, start_reading
from eval.blind.marks import mark_table
from eval.blind.pages import confusion_csv, effect_table, suite_table
from eval.blind.score import median_interval, score_line, share_interval
from eval.blind.sealing import key_path, read_sealed
from eval.blind.suites import EFFECTS, MEDIUM, OUTSIDE, SUITES, Case, plan
from eval.blind.trial import make_case, read_verdicts
from tpcd.data import Episode
from tpcd.discrepancy.diagnosis import Diagnosis, Estimate, NamedEffect
from tpcd.effects import CATALOGUE, find_effect
from tpcd.errors import RunError
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


# --- verdicts made by hand -----------------------------------------------------------------


def found(verdict: str, *names: str, closed: float | None = 0.9, **parts) -> dict:
    diagnosis = {
        "verdict": verdict,
        "effects": [{"name": name, "parameters": parts.get(name, [])} for name in names],
        "alternatives": [{"names": list(other)} for other in parts.get("others", ())],
        "theta_after": parts.get("theta", []),
        "share_closed": closed,
        "detection_limits": parts.get("limits", []),
    }
    return {"diagnosis": diagnosis, "wall_s": 100.0}


def key(suite: str, *names: str, run: int = 0) -> dict:
    hidden = {name: dict(MEDIUM.get(name) or OUTSIDE[name]) for name in names}
    label = "pair" if suite == "pairs" else names[0] if names else "clean"
    return {
        "suite": suite, "label": label, "run": run, "hidden": hidden,
        "theta": {"friction": 0.5, "scale": 1.0, "object_width": 0.1},
    }  # fmt: skip


def interval(name: str, value: float, sd: float) -> dict:
    return {"name": name, "value": value, "sd": sd, "low": value - 1.645 * sd,
            "high": value + 1.645 * sd}  # fmt: skip


def test_exact_is_the_very_set_that_is_hidden() -> None:
    truth = key("medium", "floor_tilt")
    assert score_line(truth, found("named", "floor_tilt")).is_exact
    assert score_line(truth, found("ambiguous", "floor_tilt")).is_exact
    assert not score_line(truth, found("named", "floor_tilt", "payload")).is_exact
    unknown = score_line(truth, found("unknown_remains", "floor_tilt"))
    assert not unknown.is_exact and not unknown.is_wrong
    assert unknown.found == "floor_tilt + unknown"
    missed = score_line(truth, found("nothing_missing", closed=None))
    assert not missed.is_exact and not missed.is_wrong and missed.closed == 0.0
    pair = key("pairs", "floor_tilt", "payload")
    assert score_line(pair, found("named", "payload", "floor_tilt")).is_exact
    assert not score_line(pair, found("named", "payload")).is_exact


def test_the_truth_among_the_alternatives_is_within_and_not_wrong() -> None:
    truth = key("press", "floor_tilt")
    other = found("ambiguous", "directional_friction", others=[["floor_tilt"]])
    one = score_line(truth, other)
    assert (one.is_exact, one.is_within, one.is_wrong) == (False, True, False)
    wrong = score_line(truth, found("named", "directional_friction"))
    assert (wrong.is_within, wrong.is_wrong) == (False, True)


def test_what_is_missed_is_below_the_limit_where_the_report_says_so() -> None:
    truth = key("small", "payload")  # 1 N at 30 mm, of which the lever is a place

    def missed(*limits: tuple[str, float | None], verdict: str = "nothing_missing") -> bool:
        told = [{"name": "payload", "parameter": name, "size": size} for name, size in limits]
        return score_line(truth, found(verdict, closed=None, limits=told)).is_below_limit

    assert missed(("weight", 1.1)) and missed(("weight", None))
    assert missed(("weight", 1.1), verdict="not_enough_information")
    assert not missed(("weight", 0.9)) and not missed(("lever", 1.0)) and not missed()
    named = found("named", "floor_tilt", limits=[dict(name="payload", parameter="weight", size=2)])
    assert not score_line(truth, named).is_below_limit
    assert not score_line(key("clean"), found("nothing_missing", closed=None)).is_below_limit


def test_clean_data_ask_for_nothing_missing_and_numerics_is_no_physics() -> None:
    truth = key("clean")
    assert score_line(truth, found("nothing_missing", closed=None)).is_exact
    assert score_line(truth, found("named", "numerics")).is_exact
    assert not score_line(truth, found("unknown_remains")).is_exact
    assert score_line(truth, found("named", "payload")).is_wrong


def test_sizes_and_theta_are_scored_against_the_key() -> None:
    parameters = [interval("weight", 1.1, 0.02), interval("lever", 0.031, 0.01)]
    theta = [interval("friction", 0.6, 0.05), interval("scale", 1.2, 0.05),
             interval("object_width", 0.112, 2e-3), interval("latent_0", 9.0, 0.1)]  # fmt: skip
    one = score_line(key("medium", "payload"), found("named", "payload", payload=parameters,
                                                     theta=theta))  # fmt: skip
    assert one.size_errors == pytest.approx((0.1,))
    assert one.size_inside == (False, True)
    assert one.theta_scores == pytest.approx({"friction": 2.0, "scale": 4.0, "object_width": 6.0})
    (line,) = [row for row in mark_table([one]) if row["item"].startswith("theta")]
    assert line["found"] == "50.0%"
    assert "worst object_width 0%; not counted: scale 0%" in line["note"]
    missed = score_line(key("medium", "payload"), found("named", "force_bias", theta=theta))
    assert (missed.size_errors, missed.theta_scores) == ((), {})


def test_intervals_of_shares_and_medians() -> None:
    low, high = share_interval(0, 200)
    assert low == 0.0 and high == pytest.approx(1 - 0.05 ** (1 / 200))
    assert share_interval(0, 0) == (0.0, 1.0)
    middle, low, high = median_interval([float(i) for i in range(1, 102)] + [math.nan])
    assert middle == 51 and 41 <= low < 51 < high <= 61
    assert all(math.isnan(value) for value in median_interval([]))


def test_marks_are_reached_missed_or_not_run() -> None:
    scores = [score_line(key("clean", run=i), found("nothing_missing")) for i in range(9)]
    scores.append(score_line(key("clean", run=9), found("named", "payload")))
    scores += [score_line(key("medium", n), found("named", n)) for n in ("floor_tilt", "payload")]
    scores.append(score_line(key("pairs", "payload", "floor_tilt"), found("named", "payload")))
    outside = key("outside", "friction_field")
    scores += [score_line(outside, found("formula", "friction by x", closed=0.8)),
               score_line(outside, found("named", "load_friction"))]  # fmt: skip
    rows = {row["item"]: row for row in mark_table(scores)}
    expected = {
        "clean (200 runs): false name": ("missed", "10.0%", 10),
        "clean (200 runs): false 'unknown'": ("reached", "0.0%", 10),
        "one medium effect: exact": ("reached", "100.0%", 2),
        "two effects: exact pair": ("missed", "0.0%", 1),
        "outside: accepted under a catalogue name": ("missed", "50.0%", 2),
        "outside: formula closes 70 %": ("missed", "50.0%", 2),
        "gap closed, medium, median": ("reached", "90.0%", 2),
        "time of one diagnosis of 60 steps, median": ("reached", "100 s", 12),
        "one small effect: exact": ("not run", None, 0),
    }
    for item, (outcome, value, runs) in expected.items():
        assert (rows[item]["outcome"], rows[item]["found"], rows[item]["runs"]) == (
            outcome, value, runs,
        )  # fmt: skip
    assert len(rows) == 21
    assert [row["suite"] for row in suite_table(scores)] == ["clean", "medium", "pairs", "outside"]
    assert effect_table(scores)[0]["otherwise"] == "payload (1)"
    clean = [one for one in scores if one.suite == "clean"]
    assert confusion_csv(clean) == "truth,nothing_missing,payload\nclean,9,1\n"


# --- whole runs with a workflow that is made up --------------------------------------------


@dataclass(frozen=True)
class Calls:
    """What the made-up workflow was asked, and whether it is to fail."""

    asked: list
    fails: list


@dataclass(frozen=True)
class FakeSettings:
    seed: int = 0
    base_refit: bool = True
    parity: bool = True


@pytest.fixture
def workflow(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """A workflow that always names a force bias, but fails on request."""
    import sys

    calls = Calls([], [])

    def diagnose(episodes, shape, settings=None, fresh=()) -> Diagnosis:
        calls.asked.append((episodes, settings, fresh))
        if len(calls.asked) in calls.fails:
            raise RuntimeError("no luck")
        bias = tuple(Estimate(n, 0.6, 0.1, 0.4, 0.8, "N") for n in ("F_x", "F_z"))
        named = NamedEffect("force_bias", bias, "the wrench is read too high")
        return Diagnosis("named", "a bias", effects=(named,), share_closed=0.95)

    module = SimpleNamespace(DiagnosisSettings=FakeSettings, diagnose=diagnose)
    monkeypatch.setitem(sys.modules, "tpcd.discrepancy.search", module)
    monkeypatch.setattr("eval.blind.trial.load_shape", lambda prior: None)
    return calls


def quick(tmp_path: Path) -> Blind:
    return Blind(out=tmp_path / "blind", quick=True)


def results(config: Blind) -> dict:
    return json.loads((config.out / "results.json").read_text())


def test_a_run_is_scored_from_its_files_and_seals(tmp_path: Path, workflow: Calls) -> None:
    config = quick(tmp_path)
    run_blind(config)
    assert len(workflow.asked) == 3
    episodes, settings, fresh = workflow.asked[0]
    assert episodes[0].object is None and len(episodes[0]) == len(fresh[0]) == 31
    assert settings.seed not in (0, config.seed) and settings.parity
    (clean, effects) = results(config)["suites"]
    assert (clean["exact"], clean["wrong name"], clean["runs"]) == (0.0, 1.0, 1)
    assert (effects["exact"], effects["wrong name"], effects["runs"]) == (0.5, 0.5, 2)
    assert {row["outcome"] for row in results(config)["table"]} == {"not run"}
    assert (config.out / "figures" / "confusion-quick.png").stat().st_size > 3000
    assert "force_bias" in (config.out / "confusion-quick.csv").read_text()
    (lines, failed) = read_verdicts(config.out)
    assert failed == [] and all(len(line["key_sha256"]) == 64 for line in lines)
    assert not any("hidden" in line or "label" in line for line in lines)


def test_switches_of_the_workflow_follow_the_suite(tmp_path: Path, workflow: Calls) -> None:
    from eval.blind.trial import run_case

    line = run_case(Case("no_parity", "clean", 0), SEED, "", tmp_path)
    assert "failed" not in line
    assert workflow.asked[0][1] == FakeSettings(seed=workflow.asked[0][1].seed, parity=False)


def test_a_key_that_was_changed_is_found_out(tmp_path: Path, workflow: Calls) -> None:
    config = quick(tmp_path)
    run_blind(config)
    token = cases_of(config)[0].token(case_seed(config))
    path = key_path(config.out, token)
    sealed = path.read_text()
    path.write_text(sealed.replace('"hidden": {}', '"hidden": {"force_bias": {"F_x": 0.6}}'))
    with pytest.raises(RunError, match="not the key that was sealed"):
        score(config)
    path.write_text(sealed)
    score(config)
    episode = config.out / "episodes" / token / "main.csv"
    episode.write_text(episode.read_text() + "\n")
    with pytest.raises(RunError, match="other episodes"):
        score(config)
    path.unlink()
    with pytest.raises(RunError, match="is missing"):
        score(config)


def test_a_failing_case_costs_no_other_and_is_tried_again(
    tmp_path: Path, workflow: Calls, capsys: pytest.CaptureFixture
) -> None:
    config = quick(tmp_path)
    workflow.fails.append(2)
    run_blind(config)
    assert "RuntimeError: no luck" in capsys.readouterr().err
    effects = results(config)["suites"][1]
    assert (effects["runs"], effects["exact"], effects["failed"]) == (2, 0.0, 0.5)
    assert len(results(config)["failed"]) == 1
    run_blind(replace(config, resume=True))
    assert len(workflow.asked) == 4
    assert results(config)["failed"] == []
    assert results(config)["suites"][1]["exact"] == 0.5


def test_a_stopped_run_goes_on_and_more_suites_may_follow(tmp_path: Path, workflow: Calls) -> None:
    config = quick(tmp_path)
    run_blind(config)
    path = config.out / "verdicts-0.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]) + lines[-1][:50])
    run_blind(replace(config, resume=True))
    assert len(workflow.asked) == 4 and len(read_verdicts(config.out)[0]) == 3
    run_blind(replace(config, resume=True, quick=False, suites=("clean",), runs=1))
    assert len(workflow.asked) == 5
    assert {row["suite"] for row in results(config)["suites"]} == {"quick", "clean"}
    with pytest.raises(RunError, match="another seed"):
        run_blind(replace(config, resume=True, seed=1))


@pytest.mark.parametrize("wrong", [{"suites": ("large",)}, {"suites": ()}, {"runs": 0}])
def test_bad_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        Blind(**wrong)
