"""scripts/import_log.py from a recording to an episode that the other commands take."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_calls import PRIOR, load_script
from made_logs import Setting, an_episode, in_space, sampled, write_csv
from made_tables import IIWA, IIWA_MAP
from matplotlib.image import imread

from tpcd.cli import run
from tpcd.data import read_episode

EPISODE = an_episode(12)
MAP = ["time=t:ms", "pose=p", "wrench=w", "command=u"]


def call(name: str, main: str, config: str, *words: str) -> int:
    """Run a command in this process; its exit code."""
    module = load_script(name)
    positional = ("log",) if name == "import_log" else ("episodes",)
    with pytest.raises(SystemExit) as stopped:
        run(
            getattr(module, main),
            getattr(module, config),
            list(words),
            positional=positional,
            prog=name,
        )
    return int(stopped.value.code or 0)


def importing(*words: str) -> int:
    return call("import_log", "import_recording", "LogImport", *words)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of twelve steps, times in ms."""
    space = in_space(sampled(EPISODE), Setting(origin=(0.3, 0.0, 0.0)))
    table = {"t": 1e3 * space["time"]}
    for name, blocks in {
        "p": ("position", "rotation"), "w": ("force", "torque"), "u": ("target", "turned")
    }.items():  # fmt: skip
        values = np.column_stack([space[block] for block in blocks])
        table.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
    table["speed"] = np.full(len(table["t"]), 0.05)
    return write_csv(tmp_path_factory.mktemp("log") / "run.csv", table)


def words(log: Path, out: Path, *more: str) -> tuple[str, ...]:
    given = ("--map", *MAP, "--stiffness", "100", "100", "50", "--origin", "0.3", "0", "0")
    return (str(log), *given, "--out", str(out), *more)


def test_springs_that_look_like_another_unit_are_taken_when_insisted_on(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    soft = [str(5.0) if word in ("100", "50") else word for word in words(log, tmp_path / "out")]
    assert importing(*soft, "--accept", "--accept_doubts") == 2
    assert "it looks like N/mm" in capsys.readouterr().err
    assert importing(*soft, "--accept", "--accept_doubts", "--unusual") == 4
    episode = read_episode(tmp_path / "out" / "episode.csv")
    assert episode.unusual and episode.stiffness.tolist() == [5.0, 5.0, 5.0]


def test_a_recording_becomes_an_episode(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert importing(*words(log, out, "--accept", "--keep", "speed", "--object", "mug")) == 0
    printed = capsys.readouterr()
    assert f"{len(EPISODE)} settled steps" in printed.out and "leaves out" in printed.out
    assert "noise of a row: x " in printed.out and printed.err == ""
    episode = read_episode(out)
    assert len(episode) == len(EPISODE) and episode.object == "mug"
    assert float((episode.poses - EPISODE.poses).abs().max()) < 5e-3
    assert list(episode.extra) == ["time_s", "speed"]
    assert np.allclose(episode.extra["speed"], 0.05)
    assert imread(out / "imported.png").shape[0] > 800
    assert (out / "config.yaml").is_file() and (out / "versions.json").is_file()
    results = json.loads((out / "results.json").read_text())
    assert results["accepted"] and results["doubts"] == []
    assert importing(*words(log, out, "--accept")) == 2
    assert "is not empty" in capsys.readouterr().err


def test_nothing_is_written_until_it_is_accepted(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for answer, code in (("", 3), ("n\n", 3), ("y\n", 0)):
        monkeypatch.setattr("sys.stdin", Terminal(answer) if answer else io.StringIO())
        assert importing(*words(log, tmp_path / "run", "--overwrite")) == code
        assert (tmp_path / "run" / "episode.csv").is_file() == (code == 0)
        assert (tmp_path / "run" / "imported.png").is_file()
        assert ("no episode written" in capsys.readouterr().out) == (code == 3)


def test_what_is_known_better_is_taken(log: Path, tmp_path: Path) -> None:
    std = ("1e-4", "1e-4", "3e-4", "0.2", "0.2", "0.01")
    more = ("--sensor_std", *std, "--tool_x", "0", "0", "1", "--accept", "--tare")
    assert importing(*words(log, tmp_path / "run", *more)) == 0
    episode = read_episode(tmp_path / "run")
    assert episode.sensor_std.tolist() == [float(value) for value in std]
    # The tool's z axis points up, a quarter of a turn from x.
    assert float(episode.poses[0, 2]) == pytest.approx(np.pi / 2, abs=0.01)


def test_parts_of_a_recording_can_be_taken(log: Path, tmp_path: Path) -> None:
    assert importing(*words(log, tmp_path / "run", "--accept", "--end", "8")) == 0
    assert 2 <= len(read_episode(tmp_path / "run")) < len(EPISODE)


BAD = {
    "no file": (("none.csv",), "none.csv: no such file"),
    "no column": (("LOG", "--map", "time=tt"), "no column 'tt'; did you mean 't'?"),
    "no angle": (("LOG", "--plane_z", "1", "0", "1"), "expected right angles"),
    "topics": (("LOG", "--topics", "pose=/a"), "topics are for bags"),
    "map": (("a.bag", "--map", "x=x"), "map is for tables"),
    "window": (("LOG", "--map", *MAP, "--window", "9"), "shorter than 9 s; lower --window"),
    "tool": (("LOG", "--tool_x", "1"), "tool_x has 1 numbers, expected 3"),
    "negative": (("LOG", "--window", "-1"), "window is -1, expected more than 0"),
    "euler": (("LOG", "--map", "time=t", "x=p_0", "z=p_2", "F_x=w_0", "F_z=w_2", "T_y=w_4",
               "e1=p_3", "e2=p_4", "e3=p_5", "--euler", "XQ"), "Euler angles e1, e2, e3"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line(
    case: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, expected = BAD[case]
    given = tuple(str(log) if word == "LOG" else word for word in given)
    code = importing(*given, "--stiffness", "100", "100", "50", "--out", str(tmp_path / "run"))
    error = capsys.readouterr().err.strip()
    assert code == 2 and expected in error and "\n" not in error
    assert not (tmp_path / "run").exists()


@pytest.mark.skipif(not IIWA.is_file(), reason="TPCD_MEASURED has no iiwa_screw_contact")
def test_a_real_recording_without_set_points_is_not_enough_information(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stiff = ("--stiffness", "2000", "1000", "200")
    out = ("--out", str(tmp_path / "iiwa"), "--accept")
    assert importing(str(IIWA), "--map", *IIWA_MAP, *stiff, *out) == 0
    header = yaml.safe_load((tmp_path / "iiwa" / "episode.yaml").read_text())
    assert header["commands"] == "unknown" and "sensor_std" not in header
    capsys.readouterr()
    given = (str(tmp_path / "iiwa"), "--prior", PRIOR, "--out", str(tmp_path / "diagnosis"))
    assert call("diagnose", "diagnose_episodes", "Diagnose", *given) == 14
    verdict = json.loads((tmp_path / "diagnosis" / "verdict.json").read_text())
    assert verdict["verdict"] == "not_enough_information"
    for reason in ("set points of the controller were not recorded", "one contact held throughout",
                   "nor is the noise of the sensors known"):  # fmt: skip
        assert reason in verdict["sentence"]
    assert (tmp_path / "diagnosis" / "report.html").is_file()
