"""What a diagnosis writes: verdict.json, figures, the page, and runs side by side."""

from __future__ import annotations

import base64
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from command_calls import PRIOR, ROOT
from diagnosis_bench import SETTINGS, bench_of
from made_diagnosis import a_diagnosis
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.tensorboard import SummaryWriter

from tpcd.belief.belief import Belief
from tpcd.belief.storage import load_belief
from tpcd.commands.diagnosing import EXIT_CODES, compare_runs, write_diagnosis
from tpcd.commands.diagnosis_figures import draw_diagnosis, shown_candidates
from tpcd.commands.diagnosis_rows import shown_coverage, shown_tests
from tpcd.data.episode import Episode
from tpcd.discrepancy.coverage import coverage_of
from tpcd.discrepancy.diagnosis import Candidate, Diagnosis, NamedEffect, Verdict
from tpcd.discrepancy.evidence import fit_model
from tpcd.discrepancy.fit import posterior
from tpcd.discrepancy.report_parts import given_effects, named_effects, theta_estimates
from tpcd.discrepancy.variants import FINER_STEPS
from tpcd.effects import find_effect
from tpcd.effects.excitations import MOTIONS, NEEDED
from tpcd.effects.model import load_model
from tpcd.figures.sinks import save_figure
from tpcd.shape.builtin import builtin_outlines
from tpcd.truth.make import make_truth
from tpcd.truth.recording import make_motion, record
from tpcd.truth.scene import draw_scene

DOCS = (ROOT / "tpcd" / "discrepancy" / "README.md").read_text(encoding="utf-8")
SAMPLER = replace(SETTINGS.sampler, flat_rounds=0)
STEPS = 12
SOFT = {"floor_compliance": {"compliance": 6e-4}}


def recorded(hidden: dict[str, dict[str, float]], path: Path) -> Episode:
    """A mug that presses on a floor, and slides."""
    generator = torch.Generator().manual_seed(5)
    scene = draw_scene("mug", builtin_outlines()["mug"].vertices, generator)
    motion = make_motion("diagnosis", scene, STEPS, generator)
    truth = make_truth(scene, "quasistatic", hidden, STEPS)
    return replace(record(truth, scene, motion, STEPS, generator).measured, path=path)


@pytest.fixture(scope="module")
def episodes() -> tuple[Episode, Episode]:
    """On a rigid floor, then on a soft one."""
    return recorded({}, Path("rigid.csv")), recorded(SOFT, Path("soft.csv"))


def learnt(episode: Episode, *names: str) -> Belief:
    """What an episode tells under a model with these effects."""
    question = replace(bench_of(episode).question, sampler=SAMPLER)
    effects = tuple(find_effect(name) for name in names)
    return posterior(question, fit_model(question, effects, (0,)))


@pytest.fixture(scope="module")
def before(episodes: tuple[Episode, Episode]) -> Belief:
    return learnt(episodes[0], "floor_tilt")


@pytest.fixture(scope="module")
def after(episodes: tuple[Episode, Episode]) -> Belief:
    return learnt(episodes[1], "floor_tilt", "floor_compliance")


def written(found: Diagnosis, folder: Path) -> str:
    """The page of a diagnosis without beliefs, with all else written beside it."""
    folder.mkdir(exist_ok=True)
    with SummaryWriter(folder / "tensorboard") as writer:
        return write_diagnosis(found, [], 6.0, PRIOR, folder, writer).read_text()


def test_what_was_added_later_is_shown_as_it_was_then() -> None:
    candidates = (
        Candidate("finer_steps", 0, 40.0),
        Candidate("floor_compliance", 1, 119.0, (), "accepted: gain 119.0"),
        Candidate("wall_compliance", 1, 28.6),
        Candidate("grasp_slip", 1, -math.inf),
        Candidate("wall_compliance", 2, 31.5, (), "accepted: gain 31.5"),
        Candidate("floor_tilt", 2, 9.0, (), "rejected: gain 9.0"),
    )
    shown = shown_candidates(replace(a_diagnosis(), candidates=candidates))
    assert [(c.name, c.round) for c in shown] == [("floor_compliance", 1), ("wall_compliance", 2)]


def test_the_page_holds_everything_in_one_file(tmp_path: Path) -> None:
    found = a_diagnosis()
    figures = draw_diagnosis(found, [], 6.0)
    assert set(figures) == {"residuals", "evidence", "gap", "theta"}
    for name, (figure, caption) in figures.items():
        assert caption and save_figure(figure, tmp_path, name).stat().st_size > 5000
    page = written(found, tmp_path)
    for text in (
        *(
            "2.00 ± 0.10 mm per 10 N",
            "all channels: 95 % (90 to 99); in typical rows 50 %",
            "needs lift-off",
            "30.0",
            "120.0 (seeds: 120.1, 119.9) before, 150.0 (seeds: 150.5, 149.2, 150.1) after [nats]",
        ),
        *("floor and wall (7)", "z [mm]", "0.400 (0.300 to 0.500)", "100 % (90 to 100)"),
    ):
        assert text in page
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    evidence = verdict["evidence"]
    assert evidence["before_by_seed"] == list(found.log_evidence_base_by_seed)
    assert evidence["after_by_seed"] == list(found.log_evidence_by_seed)
    assert evidence["candidates"][0]["name"] == "floor_compliance"
    assert verdict["gap_by_contact"][0]["contact"] == "floor and wall"
    assert "http" not in page.replace("http-equiv", "")


def test_an_effect_without_parameters_is_shown_by_its_name(tmp_path: Path) -> None:
    numerics = NamedEffect("numerics", (), FINER_STEPS.note)
    effects = (numerics, *a_diagnosis().effects)
    page = written(replace(a_diagnosis(), effects=effects), tmp_path)
    assert f'<td>numerics</td><td colspan="3">{FINER_STEPS.note}</td>' in page
    (row,) = compare_runs([tmp_path])
    shown = effects[1].parameters[0].shown
    assert row["effects"] == f"numerics; floor_compliance.compliance {shown}"


def test_effects_that_were_given_are_told_apart_from_those_found(
    after: Belief, tmp_path: Path
) -> None:
    effects, given = named_effects(after, 1), given_effects(after, 1)
    page = written(replace(a_diagnosis(), effects=effects, given=given), tmp_path)
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    for key, name in (("given", "floor_tilt"), ("effects", "floor_compliance")):
        (effect,) = verdict[key]
        assert effect["name"] == name
        place = after.prior.names.index(f"{name}.{effect['parameters'][0]['name']}")
        assert effect["parameters"][0]["value"] == pytest.approx(float(after.mean()[place]))
        assert effect["parameters"][0]["shown"] in page
    heading = "Effects that the model had from the start"
    assert heading in page and heading not in written(a_diagnosis(), tmp_path)


def test_tests_without_theta_are_told_in_units_of_the_noise(tmp_path: Path) -> None:
    found = a_diagnosis()
    page = written(found, tmp_path)
    parity, free = shown_tests(found.tests)
    for row, name in ((parity, "parity"), (free, "free_space")):
        assert float(row["times the noise"]) ** 2 == pytest.approx(found.tests[name], rel=0.01)
        assert float(row["p under noise alone"]) == found.tests[f"{name}_p"]
        assert all(text in page for text in row.values())
    # Where too few rows are free there is one test, and before a fit none.
    assert shown_tests({"parity": 1.0, "parity_p": 1.0})[0]["test"] == parity["test"]
    assert shown_tests({}) == []


def test_what_the_motions_excite_is_told_with_what_is_lacking(
    episodes: tuple[Episode, Episode], tmp_path: Path
) -> None:
    coverage = coverage_of(episodes)
    rows = shown_coverage(coverage.counts)
    assert [row["excitation"] for row in rows] == list(NEEDED)
    lacking = [row["excitation"] for row in rows if row[""]]
    assert lacking == coverage.missing(list(NEEDED)) and 0 < len(lacking) < len(rows)
    page = written(replace(a_diagnosis(), coverage=coverage.counts), tmp_path)
    assert all(MOTIONS[need] in page for need in lacking)
    apart = 1e3 * coverage.counts["floor places"]
    assert any(row["there is"] == f"{apart:.0f} mm apart" for row in rows)
    assert "What the motions excite" not in written(Diagnosis("named", ""), tmp_path)


def test_all_of_a_diagnosis_with_a_posterior_is_written_and_read_again(
    episodes: tuple[Episode, Episode], before: Belief, after: Belief, tmp_path: Path
) -> None:
    found = replace(
        a_diagnosis(),
        gap=(),
        effects=named_effects(after, 1),
        given=given_effects(after, 1),
        theta_before=theta_estimates(before),
        theta_after=theta_estimates(after),
        belief_before=before,
        belief=after,
    )
    with SummaryWriter(tmp_path / "tensorboard") as writer:
        page = write_diagnosis(found, episodes, 6.0, PRIOR, tmp_path, writer).read_text()
    figures = {path.stem: path for path in (tmp_path / "figures").iterdir()}
    # What moved is drawn though no gap could be told; the soft floor is what the base has wrong.
    assert set(figures) == {"residuals", "evidence", "theta", "stretch"}
    for path in figures.values():
        assert base64.b64encode(path.read_bytes()).decode() in page
    assert f"The {STEPS} rows in a row of soft.csv that the base model predicts worst." in page
    assert str(episodes[0].path) in page
    model = load_model(tmp_path / "model.yaml")
    assert model.effects == after.prior.effects and model.step == after.step
    for name, value in zip(after.prior.names, after.mean().tolist(), strict=True):
        effect, _, parameter = name.partition(".")
        if parameter:
            assert model.found[effect][parameter][0] == pytest.approx(value)
    again = load_belief(tmp_path, after.prior.shape)
    assert torch.equal(again.vectors, after.vectors) and torch.equal(again.weights, after.weights)
    log = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert set(log.Tags()["images"]) == {f"diagnosis/{name}" for name in figures}
    (text,) = log.Tensors("verdict/text_summary")
    assert found.sentence in text.tensor_proto.string_val[0].decode()


def test_what_did_not_change_is_not_drawn(
    episodes: tuple[Episode, Episode], before: Belief
) -> None:
    theta = theta_estimates(before)
    same = Diagnosis("nothing_missing", "", theta_before=theta, theta_after=theta)
    assert draw_diagnosis(replace(same, belief=before, belief_before=before), episodes, 6.0) == {}


def test_the_docs_tell_every_key_and_every_exit_code(tmp_path: Path) -> None:
    written(a_diagnosis(), tmp_path)
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert "candidates" in verdict["evidence"] and "non_finite" in verdict
    told = [row.split("|")[1:3] for row in DOCS.splitlines() if row.startswith("| `")]
    keys = {key for names, _ in told for key in re.findall(r"`(\w+)`", names)}
    assert set(verdict) <= keys
    assert set(verdict["evidence"]) <= set(re.findall(r"`(\w+)`", DOCS))
    codes = {names.strip(" `"): int(code) for names, code in told if code.strip().isdigit()}
    assert codes == EXIT_CODES and set(codes) == set(get_args(Verdict))


def test_runs_of_before_are_put_side_by_side_with_those_of_today(tmp_path: Path) -> None:
    found = replace(a_diagnosis(), given=a_diagnosis().effects)
    for name in ("old", "new"):
        written(found, tmp_path / name)
    path = tmp_path / "old" / "verdict.json"
    verdict = json.loads(path.read_text())
    for key in ("given", "tests", "coverage", "seconds", "non_finite"):
        del verdict[key]
    for key in ("before_by_seed", "after_by_seed"):
        del verdict["evidence"][key]
    path.write_text(json.dumps(verdict))
    old, new = compare_runs([tmp_path / "old", tmp_path / "new"])
    assert old == {**new, "run": "old"}
