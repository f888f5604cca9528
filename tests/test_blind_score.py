"""What verdicts are worth, on verdicts made by hand."""

from __future__ import annotations

import math

import pytest

from eval.blind.detection import detection_figure, detection_table, size_calibration
from eval.blind.marks import mark_table
from eval.blind.pages import confusion_csv, effect_table, suite_table
from eval.blind.score import Score, median_interval, score_line, share_interval
from eval.blind.suites import MEDIUM, OUTSIDE


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
    both = key("small", "stiffness_error")  # what two parameters gain adds up
    sizes = both["hidden"]["stiffness_error"].items()
    for share, is_below in ((1.3, False), (1.5, True)):
        limits = [
            dict(name="stiffness_error", parameter=name, size=share * abs(value))
            for name, value in sizes
        ]
        told = found("nothing_missing", closed=None, limits=limits)
        assert score_line(both, told).is_below_limit == is_below
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
        "time of one diagnosis of 60 steps, median": ("reached", "100 s", 2),
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


def test_detection_goes_by_size_and_by_the_limit_that_is_stated() -> None:
    """A payload of 1 N is medium; one of 0.35 N is small, and above the limit of 0.1 N."""

    def one(suite: str, weight: float, limit: float | None, *names: str) -> Score:
        truth = key(suite, "payload")
        truth["hidden"]["payload"]["weight"] = weight
        told = [dict(name="payload", parameter="weight", size=limit)]
        return score_line(
            truth, found("named" if names else "nothing_missing", *names, limits=told)
        )

    scores = [
        *(one("medium", 1.0, 0.5, "payload"), one("small", 0.3, 0.4), one("small", 0.3, None)),
        *(one("small", 0.35, 0.1, "payload"), one("small", 0.38, 0.1, "force_bias")),
        one("no_parity", 1.0, 0.5),  # a part is switched off
        score_line(key("clean"), found("nothing_missing", closed=None)),
        score_line(key("pairs", "payload", "floor_tilt"), found("named", "payload")),
        score_line(key("outside", "friction_field"), found("formula", "friction by x")),
    ]
    assert [s.size for s in scores[:5]] == pytest.approx([1.0, 0.3, 0.3, 0.35, 0.38])
    assert [s.over_limit for s in scores[:4]] == pytest.approx([2.0, 0.75, 0.0, 3.5])
    assert all(math.isnan(s.size) for s in scores[6:])
    rows = [
        tuple(row[k] for k in ("from", "to", "runs", "exact")) for row in detection_table(scores)
    ]
    by_size = [(0.25, 0.35, 2, 0.0), (0.35, 0.5, 2, 0.5), (0.9, 1.1, 1, 1.0)]
    by_limit = [(0.0, 0.5, 1, 0.0), (0.5, 1.0, 1, 0.0), (2.0, 4.0, 3, 2 / 3)]
    assert rows == by_size + by_limit
    assert detection_table(scores[6:]) == [] and detection_figure(scores[6:]) is None
    assert size_calibration(scores[6:]) is None


def test_two_parameters_count_together() -> None:
    truth = key("medium", "stiffness_error")
    for name in truth["hidden"]["stiffness_error"]:
        truth["hidden"]["stiffness_error"][name] *= -0.5
    one = score_line(truth, found("named", "stiffness_error"))
    assert one.size == pytest.approx(0.5) and math.isnan(one.over_limit)  # no limit is stated
    parameters = [interval("log_ratio_x", -0.05, 0.01), interval("log_ratio_z", 0.05, 0.01)]
    named = found("named", "stiffness_error", stiffness_error=parameters)
    expected = [-math.log(1.1) / 2 + 0.05, -math.log(0.92) / 2 - 0.05]
    assert score_line(truth, named).size_scores == pytest.approx([100 * e for e in expected])
