"""Commands: dataclass in, one line and an exit code out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
import yaml

from tpcd.cli import check_numbers, parse, run
from tpcd.errors import RunError
from tpcd.files import to_plain


@dataclass(frozen=True)
class Memory:
    """How much is remembered."""

    steps: int = 5
    """Number of steps remembered."""

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps is {self.steps}, expected at least 1")


@dataclass(frozen=True)
class Settings:
    """Settings of a made-up command."""

    run: Path
    """Folder of the run."""
    episodes: tuple[str, ...]
    """Episodes to predict."""
    out: Path | None = None
    """Where to write."""
    rollout: bool = False
    """Feed predictions back."""
    friction: Literal["anitescu", "coulomb"] = "coulomb"
    """Friction law."""
    seeds: tuple[int, ...] = (0,)
    """Seeds, one repetition for each."""
    floor_range: tuple[float, float] = (-0.02, 0.02)
    """Floor height, low and high [m]."""
    memory: Memory = field(default_factory=Memory)
    """What is remembered."""


POSITIONAL = ("run", "episodes")


def parsed(*arguments: str) -> Settings:
    return parse(Settings, arguments, positional=POSITIONAL, prog="made-up")


def exit_of(main, *arguments: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        run(main, Settings, arguments, positional=POSITIONAL, prog="made-up")
    return stopped.value.code


def test_positional_arguments_come_in_the_order_given() -> None:
    settings = parsed("here", "one.csv", "two.csv")
    assert settings == Settings(run=Path("here"), episodes=("one.csv", "two.csv"))


def test_every_kind_of_field_is_an_option() -> None:
    settings = parsed(
        *("here", "one.csv", "--rollout", "--friction", "anitescu", "--seeds", "3", "4"),
        *("--floor_range", "-0.1", "0.1", "--memory.steps", "7", "--out", "there"),
    )
    assert settings == Settings(
        run=Path("here"),
        episodes=("one.csv",),
        out=Path("there"),
        rollout=True,
        friction="anitescu",
        seeds=(3, 4),
        floor_range=(-0.1, 0.1),
        memory=Memory(7),
    )


def test_dashes_in_option_names_mean_underscores() -> None:
    dashed = parsed("here", "a-b.csv", "--floor-range", "-1", "1", "--no-rollout")
    assert dashed == parsed("here", "a-b.csv", "--floor_range", "-1", "1")


def test_a_saved_configuration_is_read_back(tmp_path: Path) -> None:
    settings = parsed("here", "one.csv", "--seeds", "3", "4", "--memory.steps", "9")
    saved = tmp_path / "config.yaml"
    saved.write_text(yaml.safe_dump(to_plain(settings)))
    assert parsed("--config", str(saved)) == settings


@pytest.mark.parametrize(
    "line",
    [
        "typed --config {file} --seeds 6",
        "typed --seeds 6 --config {file}",
        "typed --seeds 6 --config={file}",
    ],
)
def test_the_command_line_overrides_the_file(tmp_path: Path, line: str) -> None:
    saved = tmp_path / "config.yaml"
    saved.write_text("run: filed\nepisodes: [one.csv]\nseeds: [5]\nrollout: true\n")
    settings = parsed(*line.format(file=saved).split())
    expected = Settings(run=Path("typed"), episodes=("one.csv",), seeds=(6,), rollout=True)
    assert settings == expected


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((), "RUN and EPISODES missing"),
        (("here", "one.csv", "--memory.steps", "1.5"), "steps: found '1.5', expected a whole"),
        (("here", "one.csv", "--friction", "rough"), "'rough', expected one of 'anitescu', 'c"),
        (("here", "one.csv", "--seeds", "1", "x"), "seeds: found 'x', expected a whole number"),
        (("here", "one.csv", "--roll-out"), "unknown option --roll_out; did you mean --rollout?"),
        (("here", "one.csv", "--config"), "--config: the file is missing"),
        (("here",), "EPISODES missing"),
        (("here", "one.csv", "--friction", "none"), "friction"),
        (("here", "one.csv", "--unknown", "1"), "--unknown"),
        (("here", "one.csv", "--memory.steps", "0"), "expected at least 1"),
        (("here", "one.csv", "--memory.steps", "many"), "memory.steps"),
        (("here", "one.csv", "--config", "nowhere.yaml"), "nowhere.yaml"),
    ],
)
def test_a_wrong_argument_is_one_line_and_exit_code_2(
    arguments: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    called: list[Settings] = []
    assert exit_of(called.append, *arguments) == 2
    line = capsys.readouterr().err
    assert not called
    assert line.startswith("made-up: error: ") and named in line
    assert line.count("\n") == 1 and line.endswith("\n")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "holds nothing, expected entries by name"),
        (b"a line of text", "holds a str, expected entries by name"),
        (b"step,u_x\n0,1\n", "holds a str"),
        (b"seeds: [", "not valid YAML at line 1"),
        (b"\xff\xfe", "not a UTF-8 text file"),
        (b"memory: [1]", "memory is [1], expected settings by name"),
        (b"seeds: [1]\nseeds: [2]", "key seeds appears twice; remove one of them"),
        (b"sedes: [1]", "unknown setting 'sedes' in the configuration; did you mean seeds?"),
    ],
)
def test_a_wrong_configuration_file_is_one_line(
    tmp_path: Path, content: bytes, problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "config.yaml"
    file.write_bytes(content)
    assert exit_of(failing(AssertionError()), "here", "one.csv", "--config", str(file)) == 2
    line = capsys.readouterr().err
    assert problem in line and line.count("\n") == 1 and len(line) < 300


@dataclass(frozen=True)
class Limited:
    """Numbers with limits."""

    count: int = 3
    misfit: float | None = None
    corner: tuple[float, float] = (-1.0, 1.0)
    stiffness: tuple[float, ...] = (1.0, 2.0)
    seed: int = 0

    def __post_init__(self) -> None:
        above = {"misfit": 0.0, "stiffness": 0.0}
        check_numbers(self, least={"count": 1}, above=above, most={"misfit": 0.05, "corner": 5.0})


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"count": 0}, "count is 0, expected at least 1"),
        ({"misfit": 0.0}, "misfit is 0, expected more than 0"),
        ({"misfit": 0.5}, "misfit is 0.5, expected at most 0.05 in size; lengths are in m"),
        ({"corner": (0.1, -300.0)}, "corner is -300, expected at most 5 in size; lengths are in m"),
        ({"misfit": float("nan")}, "misfit is nan, expected a finite number"),
        ({"stiffness": (1.0, -2.0)}, "stiffness is -2, expected more than 0"),
        ({"seed": -1}, "seed is -1, expected 0 to"),
        ({"seed": 2**63}, "seed is 9223372036854775808, expected 0 to"),
    ],
)
def test_numbers_out_of_their_limits_are_named(wrong: dict, line: str) -> None:
    Limited()
    with pytest.raises(ValueError, match=line):
        Limited(**wrong)


def failing(error: BaseException):
    def main(config: Settings) -> None:
        """Fail."""
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (RunError("there", "is not empty", "name a new\nfolder"), 2, "there: is not empty; name a"),
        (ValueError("friction is -1, expected >= 0"), 2, "friction is -1"),
        (FileNotFoundError(2, "No such file or directory", "gone.csv"), 2, "gone.csv"),
        (PermissionError(13, "Permission denied", "/x"), 2, "/x: Permission denied; choose a"),
        (ModuleNotFoundError("No module named 'x'", name="x"), 2, "a package does not load (No m"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_an_error_of_the_world_is_one_line_and_a_code(
    error: BaseException, code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_of(failing(error), "here", "one.csv") == code
    line = capsys.readouterr().err
    assert text in line and line.count("\n") == 1


def test_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_of(failing(ValueError("odd")), "here", "one.csv", "--debug") == 2
    assert "Traceback" in capsys.readouterr().err


def test_a_mistake_in_the_program_is_not_hidden() -> None:
    for error in (ZeroDivisionError(), ModuleNotFoundError("no such part", name="tpcd.part")):
        with pytest.raises(type(error)):
            run(failing(error), Settings, ("a", "b"), positional=POSITIONAL)


@pytest.mark.parametrize("code", [None, 0, 3])
def test_the_exit_code_is_what_main_returns(code: int | None) -> None:
    assert exit_of(lambda config: code, "here", "one.csv") == (code or 0)


def test_help_shows_the_documentation_of_each_field(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_of(failing(ValueError()), "--help") == 0
    shown = " ".join(capsys.readouterr().out.split())
    for line in ("Folder of the run.", "Episodes to predict.", "Floor height, low and high [m]."):
        assert line in shown
    assert "Number of steps remembered." in shown
