"""What commands say about bad input: one line, an exit code, and nothing half-written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from command_calls import PRIOR, call, make_world


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an exploration, a test episode, and the run that learnt from the first."""
    return make_world(tmp_path_factory.mktemp("world"))


def tree(folder: Path) -> dict[str, bytes | None]:
    """Every file and folder below a folder, with content."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def refused(
    capsys: pytest.CaptureFixture[str], folder: Path, script: str, *arguments: str, code: int = 2
) -> str:
    """Call a command that must fail; its one line, after a look at what it left behind."""
    before = tree(folder)
    capsys.readouterr()
    assert call(script, *arguments) == code
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if "step/s" not in line and line]
    assert len(lines) == 1, captured.err
    assert lines[0].startswith(f"{script}: ")
    assert tree(folder) == before, "something was left behind"
    return lines[0]


def estimate_arguments(world: Path, out: Path, episode: str = "explore.csv") -> tuple[str, ...]:
    return (str(world / episode), "--prior", PRIOR, "--out", str(out), "--particles", "50")


ESTIMATE = {
    "episode that is not there": (("nowhere.csv",), "nowhere.csv: no such file"),
    "unknown prior": (("--prior", "ycb21-z3"), "ycb21-z3: holds no prior"),
    "few particles": (("--particles", "3"), "particles is 3, expected at least 16"),
    "negative particles": (("--particles", "-5"), "particles is -5, expected at least 16"),
    "no misfit": (("--misfit", "0"), "misfit is 0, expected more than 0"),
    "misfit in mm": (("--misfit", "0.5"), "misfit is 0.5, expected at most 0.05 in size; lengths"),
    "huge seed": (("--seed", "9" * 30), "expected 0 to 9223372036854775807"),
    "misspelt option": (("--particels", "50"), "did you mean --particles?"),
    "file in the way": (("--out", "explore.csv"), "explore.csv: is a file"),
    "folder below a file": (("--out", "explore.csv/run"), "explore.csv is a file"),
    "another run": (("--out", "run"), "run: is not empty"),
}


@pytest.mark.parametrize("case", ESTIMATE)
def test_estimate_refuses(world, tmp_path, monkeypatch, capsys, case) -> None:
    monkeypatch.chdir(world)
    given, expected = ESTIMATE[case]
    arguments = list(estimate_arguments(world, tmp_path / "run"))
    if given[0].startswith("--"):
        arguments += given
    else:
        arguments[0] = given[0]
    assert expected in refused(capsys, world, "estimate", *arguments)
    assert not any(tmp_path.iterdir())


def changed_episode(
    world: Path, folder: Path, row: int, values: dict[str, float], name: str = "explore"
) -> Path:
    """A copy of a recording with other values in one row."""
    shutil.copy(world / f"{name}.yaml", folder / "changed.yaml")
    lines = [line.split(",") for line in (world / f"{name}.csv").read_text().splitlines()]
    for column, value in values.items():
        lines[row + 1][lines[0].index(column)] = repr(value)
    path = folder / "changed.csv"
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return path


EPISODES = {
    "not a number": (2, {"z": float("nan")}, ("row 2 (line 4)", "column z")),
    "jump": (3, {"u_x": 2.0}, ("row 3 (line 5)", "the command jumps by")),
    "millimetres": (3, {"x": 65.0}, ("row 3 (line 5), column x", "millimetres")),
    "degrees": (3, {"phi": 12.0}, ("row 3 (line 5), column phi", "degrees")),
    "start in contact": (0, {"F_z": 3.0}, ("row 0 (line 2), column F_z", "free of contact")),
    "start far inside": (
        0,
        {"z": -0.3, "u_z": -0.3},
        ("row 0 (line 2)", "mm inside the floor", "check the frame"),
    ),
}


@pytest.mark.parametrize("case", EPISODES)
def test_a_bad_episode_names_its_row(world, tmp_path, capsys, case) -> None:
    row, values, expected = EPISODES[case]
    path = changed_episode(world, tmp_path, row, values)
    arguments = (str(path), *estimate_arguments(world, tmp_path / "run")[1:])
    line = refused(capsys, tmp_path, "estimate", *arguments)
    assert all(fragment in line for fragment in (str(path), *expected)), line


@pytest.mark.parametrize("overwrite", [False, True])
def test_an_interrupted_estimate_leaves_what_was_there(
    world, tmp_path, monkeypatch, capsys, overwrite
) -> None:
    def interrupted(*arguments):
        raise KeyboardInterrupt
        yield

    out = tmp_path / "run"
    if overwrite:
        shutil.copytree(world / "run", out)
    monkeypatch.setattr("tpcd.exploration.estimate", interrupted)
    arguments = (*estimate_arguments(world, out), *(["--overwrite"] if overwrite else []))
    assert "interrupted" in refused(capsys, tmp_path, "estimate", *arguments, code=130)


def test_an_estimate_interrupted_after_a_step_goes_on(world, tmp_path, monkeypatch, capsys) -> None:
    from tpcd.belief import estimate

    def interrupted(*arguments):
        yield next(iter(estimate(*arguments)))
        raise KeyboardInterrupt

    def stopped(estimator):
        raise KeyboardInterrupt

    whole, out = tmp_path / "whole", tmp_path / "run"
    assert call("estimate", *estimate_arguments(world, whole)) == 0
    with monkeypatch.context() as patch:
        patch.setattr("tpcd.exploration.estimate", interrupted)
        assert call("estimate", *estimate_arguments(world, out)) == 130
        assert call("estimate", *estimate_arguments(world, out), "--overwrite") == 130
    assert "run goes on with --resume" in capsys.readouterr().err
    again, resumed = estimate_arguments(world, out), (*estimate_arguments(world, out), "--resume")
    line = refused(capsys, world, "estimate", *again)
    assert "run: is not empty; go on with --resume, name a new folder or pass --overwrite" in line
    with monkeypatch.context() as patch:
        patch.setattr("tpcd.exploration.Estimator.closing", property(stopped))
        assert call("estimate", *resumed) == 130
    assert "run goes on with --resume" in capsys.readouterr().err
    line = refused(capsys, world, "estimate", *resumed, "--overwrite")
    assert "give --resume or --overwrite, not both" in line
    assert call("estimate", *resumed) == 0
    results = [json.loads((run / "results.json").read_text()) for run in (whole, out)]
    assert results[0]["table"] == results[1]["table"]
    assert "run: is finished; leave out --resume" in refused(capsys, world, "estimate", *resumed)


def test_a_start_pose_that_its_own_rows_contradict_is_told(
    world, tmp_path, capsys, monkeypatch
) -> None:
    """35 mm lower it is free under some prior draws, and inside the floor that was touched; here no
    row presses at its angle."""
    monkeypatch.setattr("tpcd.commands.plausibility.LOAD_DEVIATIONS", 1e9)
    rows = (world / "explore.csv").read_text().splitlines()
    z = float(rows[1].split(",")[rows[0].split(",").index("z")]) - 0.035
    path = changed_episode(world, tmp_path, 0, {"z": z, "u_z": z})
    assert call("estimate", str(path), *estimate_arguments(world, tmp_path / "run")[1:]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "changed.csv: row 0 (line 2)" in line and "mm inside the floor that the rows" in line
    assert "not to be trusted" in line and "what was found is in" in line
    told = json.loads((tmp_path / "run" / "results.json").read_text())["contradicted"]
    assert told and told in line
    arguments = (str(tmp_path / "run"), str(world / "test.csv"), "--out", str(tmp_path / "p.csv"))
    assert call("predict", *arguments) == 0
    assert told in capsys.readouterr().err


PREDICT = {
    "no belief": (("episodes",), {}, "belief.json: no such file"),
    "no particles": (("run",), {"--particles": "0"}, "particles is 0, expected at least 1"),
    "folder in the way": (("run",), {"--out": "run"}, "run: is a folder"),
    "file in the way": (("run",), {"--out": "run/belief.json"}, "run/belief.json: exists already"),
    "no table": (("run",), {"--out": "p.txt"}, "p.txt: is no .csv or .parquet"),
    "its own input": (("run",), {"--out": "test.csv"}, "test.csv: is what the command reads"),
    "below a file": (("run",), {"--out": "test.csv/p.csv"}, "test.csv is a file"),
    "misspelt choice": (("run",), {"--of": "treu"}, "found 'treu', expected one of"),
}


@pytest.mark.parametrize("case", PREDICT)
def test_predict_refuses(world, monkeypatch, capsys, case) -> None:
    monkeypatch.chdir(world)
    (run,), options, expected = PREDICT[case]
    words = [word for pair in ({"--out": "p.csv"} | options).items() for word in pair]
    assert expected in refused(capsys, world, "predict", run, "test.csv", *words)


def test_predict_refuses_a_start_that_no_particle_allows(world, tmp_path, capsys) -> None:
    path = changed_episode(world, tmp_path, 0, {"z": -0.2, "u_z": -0.2}, "test")
    arguments = (str(world / "run"), str(path), "--out", str(tmp_path / "p.csv"))
    line = refused(capsys, tmp_path, "predict", *arguments)
    assert f"{path}: row 0" in line and "particles of the belief" in line
    assert "mm inside the floor" in line and "in the same frame" in line


@pytest.mark.parametrize("part", ["belief.json", "belief.safetensors"])
@pytest.mark.parametrize("length", [0, 100])
def test_a_belief_that_was_cut_off_is_named(world, tmp_path, capsys, part, length) -> None:
    run = shutil.copytree(world / "run", tmp_path / "run")
    (run / part).write_bytes((run / part).read_bytes()[:length])
    arguments = (str(run), str(world / "test.csv"), "--out", str(tmp_path / "p.csv"))
    assert str(run / part) in refused(capsys, tmp_path, "predict", *arguments)


def test_a_belief_or_prior_of_another_version_is_named(world, tmp_path, capsys) -> None:
    run = shutil.copytree(world / "run", tmp_path / "run")
    prior = shutil.copytree(PRIOR, tmp_path / "prior")
    for path in (run / "belief.json", prior / "card.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "format_version": 99}))
    arguments = (str(run), str(world / "test.csv"), "--out", str(tmp_path / "p.csv"))
    line = refused(capsys, tmp_path, "predict", *arguments)
    assert "version 99, expected" in line and "estimate again" in line
    arguments = (*estimate_arguments(world, tmp_path / "new"), "--prior", str(prior))
    assert "version 99, this program" in refused(capsys, tmp_path, "estimate", *arguments)


SIMULATE = {
    "misspelt outline": ({"--outline": "mugg"}, "did you mean mug"),
    "outline crosses itself": ({"--outline": "cross.csv"}, "crosses or touches itself at (0, 0)"),
    "outline in millimetres": ({"--outline": "mm.csv"}, "looks like millimetres"),
    "no steps": ({"--steps": "-3"}, "steps is -3, expected at least 1"),
    "negative noise": ({"--noise-force": "-1"}, "noise_force is -1, expected at least 0"),
    "noise in millimetres": ({"--noise-position": "0.2"}, "looks like millimetres"),
    "not finite": ({"--friction": "nan"}, "friction: found 'nan', expected a finite number;"),
    "no stiffness": ({"--stiffness": "100 0 50"}, "stiffness is 0, expected more than 0"),
    "angle in degrees": ({"--mount-phi": "90"}, "mount_phi is 90, expected rad"),
    "start in degrees": ({"--start": "0 0.3 45"}, "start phi is 45, expected rad"),
    "start in millimetres": ({"--start": "0 300 0"}, "start z is 300, expected m"),
    "start in the floor": ({"--start": "0 -0.1 0"}, "inside the floor"),
    "name with a folder": ({"--name": "../x"}, "name is '../x', expected a file name"),
    "negative seed": ({"--seed": "-1"}, "seed is -1"),
    "episode in the way": ({"--name": "there"}, "there.yaml: exists already"),
    "unknown effect": ({"--effects": "foo.bar=1"}, "no effect 'foo'"),
    "unit of a name": ({"--unit": "mm"}, "unit is 'mm', expected none for 'mug', which is no file"),
    "file in the way": ({"--out": "cross.csv"}, "is a file"),
    "scale of a house": ({"--scale": "1000"}, "error: scale is 1000, which makes the object 1"),
    "scale of a crumb": ({"--scale": "1e-6"}, "m long, expected 0.004 to 1.2 m: give the ratio"),
    "friction of glue": ({"--friction": "1000"}, "error: friction is 1000, expected 0 to 100"),
    "stiffness in N/mm": (
        {"--stiffness": "0.1 100 50"},
        "error: stiffness is 0.1, expected N/m (10 or more): it looks like N/mm; convert it",
    ),
    "compliance in mm/N": (
        {"--effects": "floor_compliance.compliance=0.2"},
        "floor_compliance.compliance is 0.2, expected m/N (at most 0.01): it looks like mm/N",
    ),
    "tilt in degrees": ({"--effects": "floor_tilt.angle=5"}, "expected rad (at most 1)"),
    "step in millimetres": (
        {"--effects": "floor_step.height=3 floor_step.x=0.05", "--truth": "mujoco"},
        "floor_step.height is 3, expected m (at most 0.1): it looks like millimetres",
    ),
    "effect twice": (
        {"--effects": "adhesion.force=1 adhesion.force=2"},
        "effects has adhesion.force twice",
    ),
    "effect without its parameter": ({"--effects": "adhesion=1"}, "expected EFFECT.PARAMETER="),
    "force noise in mN": (
        {"--noise-force": "1e9"},
        "error: --noise_force makes an episode that cannot be, row 0 (line 2), column F_x",
    ),
    "two at once": (
        {"--noise-torque": "1e6", "--noise-angle": "0.01", "--stiffness": "90 90 40"},
        "error: --noise_torque and --stiffness make an episode that cannot be",
    ),
}


@pytest.mark.parametrize("case", SIMULATE)
def test_simulate_refuses(tmp_path, monkeypatch, capsys, case) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cross.csv").write_text("x,z\n-.05,-.05\n.05,.05\n.05,-.05\n-.05,.05\n")
    (tmp_path / "mm.csv").write_text("x,z\n-50,-50\n50,-50\n50,50\n-50,50\n")
    (tmp_path / "there.yaml").write_text("mine")
    options, expected = SIMULATE[case]
    options = {"--outline": "mug", "--truth": "quasistatic", "--out": "."} | options
    words = [word for name, value in options.items() for word in (name, *value.split(" "))]
    assert expected in refused(capsys, tmp_path, "simulate", *words)


def test_an_outline_in_its_own_unit_is_simulated(tmp_path) -> None:
    (tmp_path / "mm.csv").write_text("x,z\n-50,-50\n50,-50\n50,50\n-50,50\n")
    words = ("--outline", str(tmp_path / "mm.csv"), "--unit", "mm", "--truth", "quasistatic")
    assert call("simulate", *words, "--steps", "1", "--out", str(tmp_path / "data")) == 0
    assert (tmp_path / "data" / "rich.csv").is_file()


def test_what_is_left_out_of_an_outline_is_told(tmp_path, capsys) -> None:
    ring = "M0,0 L90,0 L90,90 L0,90 Z M30,30 L60,30 L60,60 L30,60 Z"
    (tmp_path / "ring.svg").write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" width="90mm" height="90mm" viewBox="0 0 90 90">'
        f'<path d="{ring}"/></svg>'
    )
    words = ("--outline", str(tmp_path / "ring.svg"), "--truth", "quasistatic", "--steps", "1")
    assert call("simulate", *words, "--out", str(tmp_path / "data")) == 0
    told = capsys.readouterr()
    assert "ring.svg: 1 loop inside the outer one, taken for filled" in told.err
    assert told.out.startswith("ring: scale")


FETCH = {
    "no folder": ((), "FOLDER missing"),
    "no attempts": (("y", "--attempts", "0"), "attempts is 0, expected at least 1"),
    "no patience": (("y", "--timeout-s", "0"), "timeout_s is 0, expected more than 0"),
    "no such name": (("y", "--objects", "mug"), "'mug' is no name of the set, such as 025_mug"),
    "no address": (("y", "--base-url", "ycb.org"), "expected http:// or https://"),
    "a file in the way": (("here", "--objects", "025_mug"), "here is a file"),
    "nobody there": (
        ("y", "--objects", "025_mug", "--attempts", "1", "--base-url", "http://127.0.0.1:9/"),
        "nothing was downloaded: download broke off",
    ),
    "misspelt option": (("y", "--object", "025_mug"), "did you mean --objects?"),
}


@pytest.mark.parametrize("case", FETCH)
def test_fetch_refuses(tmp_path, monkeypatch, capsys, case) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").write_text("a file")
    arguments, expected = FETCH[case]
    assert expected in refused(capsys, tmp_path, "fetch_ycb", *arguments)
