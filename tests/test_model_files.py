"""Files of models and of effects: what they may hold, and how the rest is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from effect_cases import block, one_line

from tpcd.effects import CATALOGUE
from tpcd.effects.excitations import NEEDED
from tpcd.effects.model import Model, load_model, write_model
from tpcd.effects.own import load_candidates, load_effects
from tpcd.errors import ModelError
from tpcd.files import to_plain


def test_models_come_back_as_they_were_written(tmp_path: Path) -> None:
    (tmp_path / "my_effects.py").write_text(block("python"))
    (tmp_path / "model.yaml").write_text(block("yaml"))
    model = load_model(tmp_path / "model.yaml")
    again = load_model(write_model(model, tmp_path / "deep.yaml", notes="by hand"))
    assert again.step == model.step
    assert [to_plain(effect) for effect in again.effects] == to_plain(model.effects)
    assert load_model(write_model(Model(), tmp_path / "none.yaml")) == Model()


FAULTS = {
    "no file": (None, "no such file"),
    "a folder": ("", "cannot be read"),
    "no YAML": ("effects: [", "not valid YAML"),
    "a key twice": ("effects: []\neffects: [{name: floor_tilt}]", "key effects appears twice"),
    "found twice": (
        "effects: [{name: floor_tilt, found: {angle: [0.1, 0.1], angle: [0.2, 0.1]}}]",
        "key angle appears twice",
    ),
    "prior in mm/N": (
        "effects: [{name: floor_compliance, parameters: {compliance: [0.1, 0.4]}}]",
        "prior of floor_compliance.compliance is [0.1, 0.4], expected m/N, within 10 times",
    ),
    "found in mm/N": (
        "effects: [{name: floor_compliance, found: {compliance: [0.21, 0.02]}}]",
        "found of floor_compliance.compliance is 0.21, expected m/N, within 10 times",
    ),
    "prior of the other sign": (
        "effects: [{name: floor_compliance, parameters: {compliance: [-1.0e-4, 1.0e-4]}}]",
        "starts at -0.0001, expected at least 0",
    ),
    "a list": ("- floor_tilt", "is not a mapping"),
    "another key": ("effect: []", "has 'effect'"),
    "no list": ("effects: floor_tilt", "expected a list"),
    "no name": ("effects: [floor_tilt]", "expected at least 'name: ...'"),
    "an unknown key": (
        "effects: [{name: floor_tilt, prior: [0, 1]}]",
        "expected name, file, parameters and found",
    ),
    "unknown effect": ("effects: [{name: floor_till}]", "no effect 'floor_till'; expected one of"),
    "unknown parameter": (
        "effects: [{name: floor_tilt, parameters: {slope: [0, 1]}}]",
        "effect 'floor_tilt' has no 'slope'; expected angle",
    ),
    "twice": ("effects: [{name: floor_tilt}, {name: floor_tilt}]", "'floor_tilt' twice"),
    "no width": ("effects: [{name: floor_tilt, parameters: {angle: [1, 1]}}]", "low < high"),
    "infinite": ("effects: [{name: floor_tilt, parameters: {angle: [0, .inf]}}]", "finite"),
    "one end": (
        "effects: [{name: floor_tilt, parameters: {angle: [1]}}]",
        "prior of floor_tilt.angle is [1], expected [low, high]",
    ),
    "a word": ("effects: [{name: floor_tilt, parameters: {angle: [0, steep]}}]", "[low, high]"),
    "a number": ("effects: [{name: floor_tilt, parameters: {angle: 3}}]", "is 3, expected [low"),
    "no mapping": ("effects: [{name: floor_tilt, parameters: 3}]", "expected 'name: [low, high]'"),
    "unknown step": ("step: {parts: 3}", "expected any of friction, substeps"),
    "bad step": ("step: {substeps: 0}", "substeps is 0, expected a whole number"),
    "no effects file": ("effects: [{name: a, file: nowhere.py}]", "nowhere.py: no such file"),
    "no EFFECTS": ("effects: [{name: a, file: empty.py}]", "empty.py: holds no EFFECTS"),
    "failing file": (
        "effects: [{name: a, file: failing.py}]",
        "failing.py: fails when it is run: ZeroDivisionError: division by zero",
    ),
    "no Python": ("effects: [{name: a, file: broken.py}]", "fails when it is run: SyntaxError"),
    "no effect": ("effects: [{name: a, file: other.py}]", "EFFECTS holds 3"),
    "other name": (
        "effects: [{name: dry_floor, file: my_effects.py}]",
        "expected one of wet_floor",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_models_are_refused_in_one_line(tmp_path: Path, fault: str) -> None:
    text, told = FAULTS[fault]
    (tmp_path / "my_effects.py").write_text(block("python"))
    (tmp_path / "empty.py").write_text("x = 1\n")
    (tmp_path / "failing.py").write_text("1 / 0\n")
    (tmp_path / "broken.py").write_text("def f(:\n")
    (tmp_path / "other.py").write_text("EFFECTS = (3,)\n")
    path = tmp_path if text == "" else tmp_path / "model.yaml"
    if text:
        path.write_text(text)
    with pytest.raises(ModelError) as caught:
        load_model(path)
    assert told in one_line(caught.value)
    assert str(tmp_path) in str(caught.value)


SPOILT = {
    "not null": ("torch.exp(log_ratio * beyond)", "1.0 + torch.exp(log_ratio * beyond)"),
    "mixes": ("(x - edge)", "(x - edge.mean())"),
    "no passes": ("        passes=1,\n", ""),
    "no text": ("{1}", "{2}"),
    "site": ('"contact tangent"', '"contact"'),
    "raises": ("    x = ", "    raise RuntimeError('on\\npurpose')\n    x = "),
    "nothing": ("    return replace(conditions, friction=conditions.friction * ratio)", "    pass"),
    "shape": ("conditions.friction * ratio", "ratio[..., 0]"),
    "dtype": ("conditions.friction * ratio", "(conditions.friction * ratio).float()"),
    "null": ("null=0.05", "null=0.5"),
    "needs": ('"floor slip"', '"floor slips"'),
}
TOLD = {
    "not null": "changes friction at the null values",
    "mixes": "mixes particles: friction of the first depends on the others",
    "no passes": "expected 'passes' of 1 or more",
    "no text": "expected {0}, {1}",
    "site": "expected one of command, impedance",
    "raises": "'wet_floor' fails with RuntimeError: on purpose",
    "nothing": "'wet_floor'",
    "shape": "'wet_floor'",
    "dtype": "'wet_floor'",
    "null": "null value 0.5 of 'edge' outside of its range",
    "needs": f"needs 'floor slips', expected any of {', '.join(NEEDED)}",
}


@pytest.mark.parametrize("case", TOLD)
def test_effects_that_break_their_promises_are_refused_when_read(tmp_path: Path, case: str) -> None:
    before, after = SPOILT[case]
    assert block("python").count(before) == 1
    path = tmp_path / "own.py"
    path.write_text(block("python").replace(before, after))
    with pytest.raises(ModelError) as caught:
        load_effects(path)
    assert TOLD[case] in one_line(caught.value) and "own.py" in str(caught.value)


def test_an_effect_may_not_come_twice_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(block("python") + "\nEFFECTS = EFFECTS * 2\n")
    with pytest.raises(ModelError, match="holds 'wet_floor' twice"):
        load_effects(path)


def test_candidates_have_names_of_their_own(tmp_path: Path) -> None:
    path, other = tmp_path / "own.py", tmp_path / "other.py"
    path.write_text(block("python"))
    other.write_text(block("python").replace('"wet_floor"', '"floor_tilt"'))
    assert [effect.name for effect in load_candidates([path], CATALOGUE)] == ["wet_floor"]
    for files in ([path, path], [other]):
        with pytest.raises(ModelError, match=r"holds an effect '.*', of which there is one"):
            load_candidates(files, CATALOGUE)
