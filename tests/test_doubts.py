"""What an episode was accepted in spite of stays with it, and is repeated by what reads it."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_calls import PRIOR, call, make_world
from made_logs import Setting, an_episode, in_space, sampled, write_csv
from test_import_command import importing

from tpcd.belief.belief import EstimationStep
from tpcd.commands.estimation import EstimationRun
from tpcd.commands.plausibility import run_warnings
from tpcd.data import Episode, check_episode, read_episode, write_episode
from tpcd.data.doubts import doubts_told, parse_doubts
from tpcd.discrepancy.checks import read_data
from tpcd.errors import EpisodeError
from tpcd.plain_yaml import parse_yaml
from tpcd.quality.finding import Finding, Weight

DOUBTS = (
    Finding("plane", Weight.DOUBT, "much of the motion is out of the plane"),
    Finding("convention", Weight.SERIOUS, "nothing fits K (x - u)", remedy="check stiffness"),
)
LINE = (
    "run.csv was accepted in spite of 2 doubts: serious doubt: nothing fits K (x - u); check"
    " stiffness; doubt: much of the motion is out of the plane"
)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exploration and a test, each once more with doubts, and a run that learnt from it."""
    folder = make_world(tmp_path_factory.mktemp("world"))
    episode = read_episode(folder / "explore.csv")
    write_episode(replace(episode, doubts=DOUBTS), folder / "run.csv")
    write_episode(replace(episode.first(3), doubts=DOUBTS), folder / "part3.csv")
    return folder


def test_doubts_of_every_weight_stand_in_the_yaml_and_come_back(world: Path) -> None:
    content = yaml.safe_load((world / "run.yaml").read_text())
    assert content["doubts"] == [
        {"doubt": "much of the motion is out of the plane"},
        {"serious doubt": "nothing fits K (x - u); check stiffness"},
    ]
    back = read_episode(world / "run.csv")
    assert [(each.weight, str(each)) for each in back.doubts] == [
        (each.weight, str(each)) for each in DOUBTS
    ]
    again = write_episode(back.first(4), world / "part.csv")
    assert read_episode(again).doubts == back.doubts
    assert doubts_told(back.doubts, back.path) == LINE
    assert doubts_told((), back.path) is None
    assert "doubts" not in (world / "explore.yaml").read_text()


@pytest.mark.parametrize(
    "doubts",
    ["[1]", "[{certain: it is so}]", "[{doubt: a, serious doubt: b}]", "[{doubt: 3}]"]
    + ["['serios doubt: a']", "['serious doubt: ']"],
)
def test_doubts_that_are_no_sentences_are_refused(doubts: str, world: Path, tmp_path: Path) -> None:
    text = (world / "explore.yaml").read_text() + f"doubts: {doubts}\n"
    (tmp_path / "a.yaml").write_text(text)
    (tmp_path / "a.csv").write_bytes((world / "explore.csv").read_bytes())
    with pytest.raises(EpisodeError, match="doubts: found .*expected WEIGHT: SENTENCE; weights"):
        read_episode(tmp_path / "a.csv")


@pytest.mark.parametrize(
    "text",
    [
        "- serious doubt: the cable was loose",
        "- 'serious doubt: the cable was loose'",
        '- "serious doubt": "the cable was loose"',
        "- serious doubt:the cable was loose",
        "'Serious doubt: the cable was loose'",
        "- |\n  serious doubt: the cable\n  was loose",
        "- >-\n  serious\n  doubt: the cable was loose",
    ],
)
def test_a_doubt_weighs_the_same_however_it_is_quoted(text: str) -> None:
    (doubt,) = parse_doubts(Path("a.yaml"), parse_yaml(text))
    assert doubt.weight is Weight.SERIOUS and str(doubt) == "the cable was loose"


def test_a_plain_sentence_is_a_doubt(world: Path, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(
        (world / "explore.yaml").read_text() + "doubts: [the cable was loose]\n"
    )
    (tmp_path / "a.csv").write_bytes((world / "explore.csv").read_bytes())
    (doubt,) = read_episode(tmp_path / "a.csv").doubts
    assert doubt.weight is Weight.DOUBT and str(doubt) == "the cable was loose"


def one_line(error: str) -> list[str]:
    return [line for line in error.splitlines() if "accepted in spite of" in line]


def test_every_command_that_reads_it_repeats_them_in_one_line(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = read_episode(world / "run.csv")
    assert check_episode(episode)[0] == LINE
    assert read_data([world / "run.csv"]).notes == (LINE,)
    assert read_data([world / "test.csv"], [world / "run.csv"]).notes == (LINE,)
    assert LINE in run_warnings(world / "run", [episode])
    assert call("plan_diagnosis", "--after", str(world / "run.csv")) == 0
    assert one_line(capsys.readouterr().err) == [f"warning: {LINE}"]
    out = str(tmp_path / "learnt")
    words = ("--prior", PRIOR, "--out", out, "--particles", "60")
    assert call("estimate", str(world / "part3.csv"), *words) == 0
    assert len(one_line(capsys.readouterr().err)) == 1
    # A belief that was learnt from it tells so of every prediction.
    clean = (out, str(world / "test.csv"), "--out", str(tmp_path / "p.csv"))
    assert call("predict", *clean) == 0
    (line,) = one_line(capsys.readouterr().err)
    assert "was learnt from an episode with doubts: part3.csv was accepted" in line


def test_an_estimate_that_was_stopped_keeps_them_and_goes_on_with_them(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, add = str(tmp_path / "run"), EstimationRun.add

    def stopped(self: EstimationRun, step: EstimationStep, *rest: object) -> None:
        if step.index == 2:
            raise KeyboardInterrupt
        add(self, step, *rest)

    words = (str(world / "part3.csv"), "--prior", PRIOR, "--out", out, "--particles", "60")
    with monkeypatch.context() as patch:
        patch.setattr(EstimationRun, "add", stopped)
        assert call("estimate", *words) == 130
    assert len(one_line(capsys.readouterr().err)) == 1
    for again in (False, True):
        if again:
            assert call("estimate", *words, "--resume") == 0
            assert len(one_line(capsys.readouterr().err)) == 1
        target = str(tmp_path / f"{again}.csv")
        assert call("predict", out, str(world / "test.csv"), "--out", target) == 0
        (line,) = one_line(capsys.readouterr().err)
        assert "run was learnt from an episode with doubts: part3.csv was accepted" in line


@pytest.fixture(scope="module")
def inverted(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Words that import a recording whose wrench is the opposite."""
    space = in_space(sampled(an_episode(8)), Setting(sign=-1.0))
    blocks = {"p": ("position", "rotation"), "w": ("force", "torque"), "u": ("target", "turned")}
    table = {"t": space["time"]}
    for name, parts in blocks.items():
        values = np.column_stack([space[part] for part in parts])
        table.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
    log = write_csv(tmp_path_factory.mktemp("inverted") / "run.csv", table)
    given = ("--map", "time=t", "pose=p", "wrench=w", "command=u")
    return (str(log), *given, "--stiffness", "100", "100", "50")


def test_serious_doubts_need_their_own_word_and_the_exit_code_says_so(
    inverted: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert importing(*inverted, "--out", str(out), "--accept") == 3
    printed = capsys.readouterr()
    assert "1 serious doubt; look at" in printed.out and "--accept_doubts" in printed.out
    assert "serious doubt: the recording was read otherwise than it looks" in printed.err
    assert not (out / "episode.csv").exists()
    words = (*inverted, "--out", str(out), "--overwrite")
    assert importing(*words, "--accept_doubts") == 4
    assert "in spite of serious doubts" in capsys.readouterr().err
    episode = read_episode(out)
    assert isinstance(episode, Episode) and episode.doubts[0].weight is Weight.SERIOUS
    assert "the wrench is inverted" in str(episode.doubts[0])
    results = json.loads((out / "results.json").read_text())
    assert results["accepted"] and results["doubts"][0].startswith("serious doubt: ")
    assert importing(*words, "--accept", "--invert_wrench") == 0
    assert read_episode(out).doubts == ()


def test_a_yes_is_not_enough_in_spite_of_serious_doubts(
    inverted: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for answer, code in (("y\n", 3), ("yes\n", 3), ("doubts\n", 4)):
        monkeypatch.setattr("sys.stdin", Terminal(answer))
        assert importing(*inverted, "--out", str(tmp_path / "run"), "--overwrite") == code
        assert (tmp_path / "run" / "episode.csv").is_file() == (code == 4)
