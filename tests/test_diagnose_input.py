"""What scripts/diagnose.py is given: one set-up, known noise, enough steps, effects that work."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from command_calls import PRIOR, call
from made_logs import an_episode
from test_effects_model import block
from test_noise import STD, episode_of, silent

from tpcd.data.checks import INVERTED, wrench_slopes
from tpcd.data.files import read_episode, write_episode
from tpcd.data.header import Header, read_header
from tpcd.data.measured import Measured, measured_contents
from tpcd.discrepancy.checks import check_one_set_up, one_noise, read_data
from tpcd.errors import EpisodeError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes a and b of one set-up."""
    folder = tmp_path_factory.mktemp("input")
    for name in "ab":
        write_episode(episode_of(0), folder / f"{name}.csv")
    return folder


CHANGES: dict[str, tuple[str, object, str]] = {
    "stiffness": ("stiffness", [200.0, 100.0, 50.0], "stiffness is [200, 100, 50], but [100"),
    "noise": ("sensor_std", [0.001] * 6, "sensor_std is [0.001, 0.001"),
    "object": ("object", "hammer", "object is 'hammer', but"),
    "step": ("time_step_s", 0.5, "time_step_s is 0.5, but 2.0 in"),
    "priors": ("priors", {"friction": [0.2, 0.4]}, "priors is {'friction': (0.2, 0.4)}, but"),
}  # fmt: skip


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("fresh", [False, True], ids=["episode", "fresh"])
def test_a_force_of_the_wrong_sign_is_no_gap_to_name(
    axis: int, fresh: bool, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = episode_of(0)
    signs = torch.ones(3, dtype=torch.float64)
    signs[axis] = -1.0
    wrong = write_episode(replace(good, wrenches=signs * good.wrenches), tmp_path / "wrong.csv")
    words = (str(folder / "a.csv"), "--fresh", str(wrong)) if fresh else (str(wrong),)
    code = call("diagnose", *words, "--prior", PRIOR, "--out", str(tmp_path / "run"))
    error = capsys.readouterr().err.strip()
    name = ("F_x", "F_z")[axis]
    assert code == 2 and "\n" not in error
    assert f"{wrong}: {name} looks inverted" in error
    assert f"change the sign of the column {name}" in error
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("case", ["offset", "turned"])
def test_an_offset_or_a_turned_sensor_is_no_wrong_sign(case: str, tmp_path: Path) -> None:
    """Both make a force that is less than -0.3 times K (pose - command), and effects name them."""
    good = episode_of(0)
    expected = good.stiffness * (good.poses - good.commands)
    wrenches, (e_x, e_z) = good.wrenches.clone(), expected.mT[:2]
    if case == "offset":
        axis = 1
        wrenches[1:, 1] -= 3 * e_z.square().sum() / e_z.sum()
    else:
        axis = 0
        wrenches[:, 0] -= 3 * e_z * e_x.square().sum() / (e_x * e_z).sum()
    told = write_episode(replace(good, wrenches=wrenches), tmp_path / "told.csv")
    slope = list(wrench_slopes(read_episode(told)).values())[axis]
    assert slope is not None and slope < INVERTED
    assert len(read_data([told]).episodes) == 1


@pytest.mark.parametrize("case", CHANGES)
@pytest.mark.parametrize("fresh", [False, True], ids=["episode", "fresh"])
def test_set_ups_are_not_mixed(
    case: str, fresh: bool, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key, value, expected = CHANGES[case]
    first = write_episode(replace(episode_of(0), time_step_s=2.0), tmp_path / "first.csv")
    other = write_episode(replace(episode_of(0), time_step_s=2.0), tmp_path / "other.csv")
    header = other.with_suffix(".yaml")
    header.write_text(yaml.safe_dump({**yaml.safe_load(header.read_text()), key: value}))
    words = (str(first), *(["--fresh"] if fresh else []), str(other))
    code = call("diagnose", *words, "--prior", PRIOR, "--out", str(tmp_path / "run"))
    error = capsys.readouterr().err.strip()
    assert code == 2 and "\n" not in error
    assert f"{header}: {expected}" in error and "diagnose them apart" in error
    assert not (tmp_path / "run").exists()


def test_what_one_leaves_out_is_no_difference(folder: Path) -> None:
    known = read_header(folder / "a.yaml")
    silent = replace(known, object=None, time_step_s=None, sensor_std=None)
    timed = replace(known, time_step_s=1.0)
    check_one_set_up([Path("a"), Path("b"), Path("c")], [silent, known, timed])
    with pytest.raises(EpisodeError, match="time_step_s is 3.0, but 1.0 in b"):
        other = replace(known, time_step_s=3.0)
        check_one_set_up([Path("a"), Path("b"), Path("c")], [silent, timed, other])


def test_fewer_steps_than_parameters_is_a_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = write_episode(episode_of(0).first(10), tmp_path / "few.csv")
    code = call("diagnose", str(few), "--prior", PRIOR, "--out", str(tmp_path / "run"))
    assert code == 14
    out = capsys.readouterr().out
    assert "not enough information: 9 transitions" in out and "needs 10 transitions" in out


def test_estimated_noise_is_part_of_the_verdict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Of sixty steps the noise can be told; nine of them are not enough for anything else.
    path = silent(write_episode(episode_of(0), tmp_path / "long.csv"))
    data = read_data([path])
    (note,) = data.notes
    assert "sensor_std estimated as [" in note and "good to about" in note
    assert np.allclose(data.episodes[0].sensor_std.numpy() / STD, 1.0, atol=0.5)
    still = an_episode(3)
    rows = [0, 1, 1, 1, 1, 2, 2, 2]
    noise = torch.from_numpy(STD * np.random.default_rng(3).standard_normal((len(rows), 6)))
    noise[0] *= 0
    paused = replace(
        episode_of(0),
        commands=still.commands[rows],
        poses=still.poses[rows] + noise[:, :3],
        wrenches=still.wrenches[rows] + noise[:, 3:],
    )
    path = silent(write_episode(paused, tmp_path / "paused.csv"))
    assert call("diagnose", str(path), "--prior", PRIOR, "--out", str(tmp_path / "run")) == 14
    assert "note: " in (out := capsys.readouterr().out) and "sensor_std estimated as [" in out
    (note,) = json.loads((tmp_path / "run" / "verdict.json").read_text())["notes"]
    assert "sensor_std estimated as [" in note
    assert "sensor_std estimated as [" in (tmp_path / "run" / "report.html").read_text()


def test_noise_that_cannot_be_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cases: list[tuple[str, float | None, str]] = [
        ("large", 10.0, "plainly too large"),
        ("none", None, "repeat commands in free space and in contact"),
    ]
    for name, factor, expected in cases:
        episode = episode_of(0, steps=15 if factor is None else 60)
        path = write_episode(episode, tmp_path / f"{name}.csv")
        header = path.with_suffix(".yaml")
        content = yaml.safe_load(header.read_text())
        if factor is None:
            del content["sensor_std"]
        else:
            content["sensor_std"] = [factor * std for std in content["sensor_std"]]
        header.write_text(yaml.safe_dump(content))
        code = call("diagnose", str(path), "--prior", PRIOR, "--out", str(tmp_path / "run"))
        error = capsys.readouterr().err.strip()
        assert code == 2 and "\n" not in error and expected in error, error


def test_an_effect_file_that_fails_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nan = block("python").replace("conditions.friction * ratio", "conditions.friction * math.nan")
    for name, content, expected in (
        ("raises", "raise RuntimeError('no')\n", "RuntimeError"),
        ("empty", "x = 3\n", "EFFECTS"),
        ("nan", "import math\n" + nan, "friction"),
    ):
        path = tmp_path / f"{name}.py"
        path.write_text(content)
        words = (str(folder / "a.csv"), "--candidates", str(path))
        code = call("diagnose", *words, "--prior", PRIOR, "--out", str(tmp_path / "run"))
        error = capsys.readouterr().err.strip()
        assert code == 2 and "\n" not in error, error
        assert str(path) in error and expected in error, error
        assert not (tmp_path / "run").exists()


def test_a_recording_without_set_points_has_an_answer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = np.zeros((20, 3)) + 1e-5 * np.arange(20)[:, None]
    wrenches = np.tile([0.5, 25.0, 0.1], (20, 1))
    header = Header((1e3, 1e3, 50.0), None, None, None, None, {}, commands_known=False)
    for path, content in measured_contents(
        Measured(poses, wrenches, {}), header, tmp_path / "m"
    ).items():
        path.write_bytes(content)
    code = call(
        "diagnose", str(tmp_path / "m.csv"), "--prior", PRIOR, "--out", str(tmp_path / "run")
    )
    assert code == 14
    out = capsys.readouterr().out
    assert "set points of the controller were not recorded" in out
    assert "one contact held throughout" in out
    given = (str(tmp_path / "m.csv"), "--prior", PRIOR, "--out", str(tmp_path / "estimate"))
    assert call("estimate", *given) == 2
    error = capsys.readouterr().err.strip()
    assert "commands: unknown" in error and "\n" not in error


def test_noise_stated_much_too_small_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = episode_of(0)
    # A start that is exactly free, so that nothing but the scatter of all rows speaks.
    commands, wrenches = episode.commands.clone(), episode.wrenches.clone()
    commands[0], wrenches[0] = episode.poses[0], 0.0
    started = replace(
        episode,
        commands=commands,
        wrenches=wrenches,
        sensor_std=episode.sensor_std * torch.tensor([1.0] * 3 + [0.1] * 3),
    )
    path = write_episode(started, tmp_path / "small.csv")
    code = call("diagnose", str(path), "--prior", PRIOR, "--out", str(tmp_path / "run"))
    error = capsys.readouterr().err.strip()
    assert code == 2 and "\n" not in error and "plainly too small" in error


def test_measured_noise_may_differ_a_little(folder: Path) -> None:
    known = read_header(folder / "a.yaml")
    paths = (Path("a.yaml"), Path("b.yaml"))
    assert known.sensor_std is not None
    for factor, same in ((1.04, True), (1.9, True), (2.1, False)):
        other = replace(known, sensor_std=tuple(factor * std for std in known.sensor_std))
        if same:
            check_one_set_up(paths, (known, other))
        else:
            with pytest.raises(EpisodeError, match="sensor_std"):
                check_one_set_up(paths, (known, other))


def test_episodes_of_different_noise_take_the_root_mean_square() -> None:
    one = episode_of(0)
    assert one_noise([one, one]) == ((one, one), ())
    (first, second), (note,) = one_noise([one, replace(one, sensor_std=1.5 * one.sensor_std)])
    expected = one.sensor_std * (0.5 * (1.0 + 1.5**2)) ** 0.5
    assert torch.allclose(first.sensor_std, expected)
    assert torch.equal(first.sensor_std, second.sensor_std) and "root mean square" in note
