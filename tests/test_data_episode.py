"""Laws of the episode format: exact round trips, and one clear line for each bad file."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tpcd.data import Episode, check_episode, read_episode, write_episode
from tpcd.data.checks import check_scale, check_units, episode_findings
from tpcd.data.files import write_together
from tpcd.data.limits import LARGEST_WRENCH
from tpcd.errors import EpisodeError
from tpcd.quality.finding import Weight

HEADER = "step,u_x,u_z,u_phi,x,z,phi,F_x,F_z,tau"
ROWS = [
    "0,0.0,0.05,0.0,0.0,0.05,0.0,0.0,0.0,0.0",
    "1,0.0,0.02,0.0,0.0,0.03,0.0,0.0,1.0,0.1",
    "2,0.01,0.01,0.0,0.008,0.03,0.0,-0.2,2.0,0.2",
]
YAML = "stiffness: [100, 100, 50]\nsensor_std: [2e-4, 0.0002, 0.0005, 0.3, 0.3, 0.02]\n"

number = st.floats(-0.17, 0.17, allow_subnormal=True)
force = st.floats(-LARGEST_WRENCH, LARGEST_WRENCH)
anything = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(1e-6, 1e6)
text = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=12)


@st.composite
def episodes(draw) -> Episode:
    n = draw(st.integers(2, 6))
    rows = st.lists(st.tuples(number, number, number), min_size=n, max_size=n)
    commands, poses = (torch.tensor(draw(rows), dtype=torch.float64) for _ in range(2))
    poses[0] = commands[0]
    wrenches = draw(st.lists(st.tuples(force, force, force), min_size=n, max_size=n))
    wrenches[0] = (0.0, 1e-4, -1e-4)
    extra = {
        "speed": draw(st.lists(anything, min_size=n, max_size=n)),
        "count": draw(st.lists(st.integers(-(10**9), 10**9), min_size=n, max_size=n)),
        "label": draw(st.lists(text.map(lambda s: "t" + s), min_size=n, max_size=n)),
    }
    return Episode(
        commands=commands,
        poses=poses,
        wrenches=torch.tensor(wrenches, dtype=torch.float64),
        stiffness=torch.tensor(draw(st.tuples(positive, positive, positive)), dtype=torch.float64),
        sensor_std=torch.tensor(
            draw(st.tuples(*[st.floats(0, largest) for largest in (0.05, 0.05, 0.5, 9, 9, 9)])),
            dtype=torch.float64,
        ),
        object=draw(st.none() | text),
        notes=draw(st.none() | text),
        time_step_s=draw(st.none() | positive),
        unusual=True,
        priors=draw(
            st.fixed_dictionaries({}, optional={"friction": st.just((0.1, 1 / 3)),
                                                "wall_position": st.just((0.1, 0.2))})
        ),
        extra={name: np.array(values) for name, values in extra.items()},
    )  # fmt: skip


@given(episode=episodes(), format=st.sampled_from(["csv", "parquet"]))
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_reading_what_was_written_returns_every_bit(episode, format, tmp_path):
    path = write_episode(episode, tmp_path / "a.b", format=format, overwrite=True)
    back = read_episode(path)
    for name in ("commands", "poses", "wrenches", "stiffness", "sensor_std"):
        assert torch.equal(getattr(back, name), getattr(episode, name)), name
    for name in ("object", "notes", "time_step_s", "priors"):
        assert getattr(back, name) == getattr(episode, name), name
    assert list(back.extra) == list(episode.extra)
    for name, column in episode.extra.items():
        assert back.extra[name].dtype.kind == column.dtype.kind
        assert np.array_equal(back.extra[name], column), name
    assert back.path == path


def write_files(folder: Path, rows: list[str] | str = "", yaml: str | None = YAML) -> Path:
    content = rows if isinstance(rows, str) and rows else "\n".join([HEADER, *(rows or ROWS)])
    (folder / "run.csv").write_text(content + "\n")
    if yaml is not None:
        (folder / "run.yaml").write_text(yaml)
    return folder / "run.csv"


@pytest.mark.parametrize("name", ["run.csv", "run.yaml", "run", "."])
def test_table_header_name_and_folder_all_lead_to_the_episode(name, tmp_path):
    write_files(tmp_path)
    (tmp_path / "run.truth.csv").write_text("not an episode")
    episode = read_episode(tmp_path / name)
    assert len(episode) == 3
    assert episode.poses[2].tolist() == [0.008, 0.03, 0.0]
    assert episode.sensor_std[0] == 2e-4


def test_column_order_is_free_and_blank_lines_and_byte_order_mark_are_ignored(tmp_path):
    path = write_files(tmp_path)
    columns = [line.split(",") for line in [HEADER, *ROWS]]
    path.write_text("\ufeff" + "\n\n".join(",".join(reversed(line)) for line in columns) + "\n\n")
    assert read_episode(path).commands[2].tolist() == [0.01, 0.01, 0.0]


def test_whole_times_since_1970_survive_to_the_nanosecond(tmp_path):
    path = write_files(tmp_path)
    times = [1_700_000_000_000_000_001 + k for k in range(len(ROWS))]
    lines = [f"{HEADER},t,big", *(f"{r},{t},{2**63}" for r, t in zip(ROWS, times, strict=True))]
    path.write_text("\n".join(lines))
    episode = read_episode(path)
    assert episode.extra["t"].tolist() == times
    assert episode.extra["big"].tolist() == [2.0**63] * len(ROWS)
    write_episode(episode, tmp_path / "again", overwrite=True)
    assert read_episode(tmp_path / "again.csv").extra["t"].tolist() == times


def edit(row: int, column: str, value: str) -> list[str]:
    rows = [line.split(",") for line in ROWS]
    rows[row][HEADER.split(",").index(column)] = value
    return [",".join(cells) for cells in rows]


BAD_TABLES = {
    "empty file": (" ", ["empty", "step,u_x"]),
    "header only": (HEADER, ["no rows"]),
    "start row only": ([ROWS[0]], ["only the start row"]),
    "missing column": ("step,u_x\n0,1", ["u_z", "missing", "expected the columns"]),
    "column in mm": (
        "\n".join([HEADER.replace(",x,", ",x_mm,"), *ROWS]),
        ["column x missing", "'x_mm' looks like it", "convert to SI and rename to 'x'"],
    ),
    "column misspelt": (
        "\n".join([HEADER.replace("F_x", "Fx"), *ROWS]),
        ["column F_x missing", "'Fx' looks like it: rename to 'F_x'"],
    ),
    "torque by its name": (
        "\n".join([HEADER.replace("tau", "torque [mNm]"), *ROWS]),
        ["column tau missing", "convert to SI and rename to 'tau'"],
    ),
    "column twice": (
        "\n".join([HEADER.replace("F_x", "F_z"), *ROWS]),
        ["column 'F_z' appears twice"],
    ),
    "semicolons": ("\n".join([HEADER, *ROWS]).replace(",", ";"), ["separate the columns"]),
    "ragged row": ([ROWS[0], ROWS[1] + ",7", ROWS[2]], ["row 1 (line 3) has 11 cells", "10"]),
    "text cell": (edit(1, "z", "high"), ["row 1 (line 3), column z", "'high'", "number"]),
    "empty cell": (edit(2, "F_z", ""), ["row 2 (line 4), column F_z", "an empty cell"]),
    "nan below blank lines": (
        [ROWS[0], "", "", *edit(2, "tau", "nan")[1:]], ["row 2 (line 6), column tau", "finite"],
    ),
    "remark above": (
        "\n".join(["# made by it", HEADER, *ROWS]),
        ["the first line is the remark '# made by it'", "begin with the line of names"],
    ),
    "units below": ([",".join(["1"] + ["m"] * 9), *ROWS], ["row 0 (line 2)", "'m'", "a number"]),
    "nan": (edit(2, "tau", "nan"), ["row 2 (line 4), column tau", "nan", "finite"]),
    "inf": (edit(1, "u_x", "-inf"), ["row 1 (line 3), column u_x", "-inf", "finite"]),
    "repeated step": ([ROWS[0], ROWS[1], ROWS[1]], ["row 2", "found 1, expected 2 (repeated)"]),
    "backwards": ([ROWS[0], ROWS[1], ROWS[0]], ["row 2", "found 0", "backwards"]),
    "missing row": ([ROWS[0], ROWS[2]], ["row 1", "found 2, expected 1 (rows missing)"]),
    "swapped rows": (
        [ROWS[0], ROWS[2], ROWS[1]],
        ["row 1", "found 2, expected 1 (steps out of order)", "sort the rows"],
    ),
    "no start row": ([ROWS[1], ROWS[2]], ["row 0", "found 1, expected 0", "start pose"]),
    "fractional step": (edit(1, "step", "0.5"), ["row 1", "not a whole number"]),
    "jump": (edit(2, "u_x", "0.8"), ["row 2 (line 4)", "u_x", "jumps by 0.8 m", "0.5 m"]),
    "millimetres": (edit(1, "x", "12.5"), ["row 1", "column x", "12.5", "millimetres"]),
    "degrees": (edit(1, "u_phi", "-45"), ["row 1", "column u_phi", "-45", "degrees"]),
    "turn": (edit(2, "u_phi", "2.6"), ["row 2 (line 4)", "turns by", "check that u_phi is in rad"]),
    "pose jumps": (edit(2, "x", "0.8"), ["row 2 (line 4)", "x, z", "the pose jumps by 0.8 m"]),
    "millinewtons": (edit(2, "F_z", "12000"), ["row 2", "F_z", "12000", "millinewtons"]),
    "start in contact": (edit(0, "F_z", "2.5"), ["row 0 (line 2), column F_z", "2.5", "zero"]),
    "start command": (edit(0, "u_z", "0.052"), ["row 0", "u_z", "0.052", "start pose z = 0.05"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_bad_table_gets_one_line_that_names_the_place(case, tmp_path):
    rows, fragments = BAD_TABLES[case]
    path = write_files(tmp_path, rows)
    with pytest.raises(EpisodeError) as caught:
        read_episode(path)
    assert_one_helpful_line(caught.value, path, fragments)


BAD_HEADERS = {
    "no file": (None, ["no such file", "YAML beside"]),
    "empty": ("", ["empty file"]),
    "not a mapping": ("- 1\n- 2\n", ["found list"]),
    "broken": ("stiffness: [1, 2\nfoo: : 3\n", ["not valid YAML", "line 2"]),
    "key twice": (YAML + "stiffness: [1, 1, 1]\n", ["key stiffness appears twice"]),
    "unknown key": (YAML + "sensor_stds: [1]\n", ["unknown key 'sensor_stds'", "'sensor_std'?"]),
    "no stiffness": (YAML.split("\n")[1], ["stiffness is missing", "[100, 100, 50]"]),
    "no noise": (YAML.split("\n")[0], ["sensor_std is missing", "hold the arm still"]),
    "zero stiffness": (YAML.replace("50]", "0]"), ["stiffness of phi is 0", "> 0"]),
    "short stiffness": (YAML.replace(", 50]", "]"), ["stiffness: found 2 entries", "3 numbers"]),
    "scalar stiffness": (YAML.replace("[100, 100, 50]", "7"), ["stiffness: found 7"]),
    "text": (YAML.replace("100, 100", "100, stiff"), ["stiffness", "'stiff'", "finite number"]),
    "negative noise": (YAML.replace("0.02]", "-0.02]"), ["sensor_std of tau is -0.02", ">= 0"]),
    "short noise": (YAML.replace(", 0.02]", "]"), ["sensor_std: found 5 entries", "F_z, tau]"]),
    "noise in mm": (YAML.replace("[2e-4", "[0.2"), ["sensor_std of x is 0.2", "like mm"]),
    "noise in degrees": (YAML.replace("0.0005", "0.6"), ["of phi is 0.6", "like degrees"]),
    "time step": (YAML + "time_step_s: 0\n", ["time_step_s is 0", "> 0"]),
    "unknown prior": (YAML + "priors: {frictoin: [0, 1]}", ["'frictoin'", "'friction'?"]),
    "reversed prior": (YAML + "priors: {friction: [0.9, 0.1]}", ["[0.9, 0.1]", "low < high"]),
    "prior in mm": (YAML + "priors: {floor_height: [-20, 20]}", ["floor_height", "mm"]),
    "prior in degrees": (YAML + "priors: {mount_phi: [-10, 10]}", ["mount_phi", "degrees"]),
    "negative friction": (YAML + "priors: {friction: [-0.1, 0.1]}", ["friction", "positive"]),
    "priors list": (YAML + "priors: [1]", ["priors is [1]", "name: [low, high]"]),
    "object": (YAML + "object: [1]", ["object: found [1]", "expected text"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_HEADERS)
def test_a_bad_yaml_gets_one_line_that_names_the_key(case, tmp_path):
    content, fragments = BAD_HEADERS[case]
    path = write_files(tmp_path, yaml=content)
    with pytest.raises(EpisodeError) as caught:
        read_episode(path)
    assert_one_helpful_line(caught.value, path.with_suffix(".yaml"), fragments)


def test_a_yaml_that_is_no_text_is_called_so(tmp_path):
    path = write_files(tmp_path)
    path.with_suffix(".yaml").write_bytes(b"notes: St\xf6\xdfe\n" + YAML.encode())
    with pytest.raises(EpisodeError) as caught:
        read_episode(path)
    assert_one_helpful_line(caught.value, path.with_suffix(".yaml"), ["not a UTF-8 text file"])


def assert_one_helpful_line(error: EpisodeError, path: Path, fragments: list[str]) -> None:
    message = str(error)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert error.remedy
    for fragment in fragments:
        assert fragment in message, message


def test_a_missing_file_a_crowded_folder_and_a_corrupt_parquet_are_named(tmp_path):
    with pytest.raises(EpisodeError, match=r"none\.csv: no such file"):
        read_episode(tmp_path / "none.csv")
    (tmp_path / "table.txt").write_text(HEADER)
    with pytest.raises(EpisodeError, match=r"table\.txt: is no \.csv or \.parquet table"):
        read_episode(tmp_path / "table.txt")
    with pytest.raises(EpisodeError, match="found 0 episodes"):
        read_episode(tmp_path)
    path = write_files(tmp_path)
    path.with_suffix(".parquet").write_bytes(b"PAR1 but not really")
    with pytest.raises(EpisodeError, match="both a .csv and a .parquet"):
        read_episode(tmp_path / "run")
    with pytest.raises(EpisodeError, match="not a readable Parquet file"):
        read_episode(tmp_path / "run.parquet")
    (tmp_path / "other.csv").write_text("")
    with pytest.raises(EpisodeError, match=re.escape("found 2 episodes (other, run)")):
        read_episode(tmp_path)


def test_noise_widens_what_the_start_row_may_deviate(tmp_path):
    rows = edit(0, "u_z", "0.0508")
    assert len(read_episode(write_files(tmp_path, rows))) == 3
    quiet = YAML.replace("0.0002,", "0.0001,")
    with pytest.raises(EpisodeError, match="row 0"):
        read_episode(write_files(tmp_path, rows, quiet))


def sample_episode(tmp_path: Path) -> Episode:
    return read_episode(write_files(tmp_path))


def test_writing_refuses_to_overwrite_unless_told(tmp_path):
    episode = sample_episode(tmp_path)
    target = tmp_path / "new" / "copy"
    write_episode(episode, target)
    before = (tmp_path / "new" / "copy.csv").read_bytes()
    with pytest.raises(EpisodeError, match="exists already"):
        write_episode(replace(episode, object="cup"), target, format="parquet")
    assert (tmp_path / "new" / "copy.csv").read_bytes() == before
    write_episode(replace(episode, object="cup"), target, format="parquet", overwrite=True)
    assert sorted(p.name for p in target.parent.iterdir()) == ["copy.parquet", "copy.yaml"]
    assert read_episode(target).object == "cup"


def test_what_could_not_be_read_back_is_not_written(tmp_path):
    episode = sample_episode(tmp_path)
    wrenches = episode.wrenches.clone()
    wrenches[1, 2] = float("nan")
    bad = [
        replace(episode, wrenches=wrenches),
        replace(episode, sensor_std=-episode.sensor_std),
        replace(episode, priors={"friction": (0.9, 0.1)}),
    ]
    for broken in bad:
        with pytest.raises(EpisodeError):
            write_episode(broken, tmp_path / "out" / "bad")
    assert not (tmp_path / "out").exists()


def test_a_failure_between_the_two_files_leaves_everything_as_it_was(tmp_path, monkeypatch):
    first, second = tmp_path / "a.yaml", tmp_path / "a.csv"
    first.write_bytes(b"old")
    replace_file, calls = os.replace, []

    def fail_on_the_second(source, target):
        calls.append(target)
        if len(calls) == 2:
            raise OSError("disk full")
        replace_file(source, target)

    monkeypatch.setattr(os, "replace", fail_on_the_second)
    with pytest.raises(OSError, match="disk full"):
        write_together({first: b"new", second: b"new"})
    assert first.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.yaml"]


def test_the_record_refuses_wrong_shapes_and_types(tmp_path):
    episode = sample_episode(tmp_path)
    # TypeError instead where jaxtyping checks the annotations, as it does in tests.
    with pytest.raises((ValueError, TypeError), match="poses"):
        replace(episode, poses=episode.poses[:2])
    with pytest.raises(ValueError, match="stiffness is"):
        replace(episode, stiffness=-episode.stiffness)
    assert replace(episode, commands=episode.commands.float()).commands.dtype == torch.float64
    with pytest.raises(ValueError, match="extra column"):
        replace(episode, extra={"speed": np.zeros(2)})


def test_an_inverted_wrench_is_a_warning_and_a_right_one_is_none(tmp_path):
    generator = torch.Generator().manual_seed(0)
    commands = torch.zeros(8, 3, dtype=torch.float64)
    commands[1:, 1] = -0.03
    poses = commands.clone()
    poses[1:, 1] = 0.01
    stiffness = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
    noise = 0.05 * torch.randn(8, 3, generator=generator, dtype=torch.float64)
    episode = Episode(
        commands=commands,
        poses=poses,
        wrenches=stiffness * (poses - commands) + noise,
        stiffness=stiffness,
        sensor_std=torch.tensor([1e-4, 1e-4, 5e-4, 0.05, 0.05, 0.05], dtype=torch.float64),
    )
    assert check_episode(episode) == []
    check_units(episode)
    # What an arm does that lags in free space, or drifts: most rows disagree, and none is refused.
    lagging = torch.cat((episode.commands, commands[-1:] + torch.linspace(0.01, 0.3, 30)[:, None]))
    lag = 0.006 * torch.randn(30, 3, generator=generator, dtype=torch.float64)
    poses_then = torch.cat((episode.poses, lagging[8:] - lag))
    drifting = torch.cat((episode.wrenches, torch.full((30, 3), -4.0, dtype=torch.float64)))
    for wrenches in (torch.cat((episode.wrenches, 0 * lagging[8:])), drifting):
        check_units(replace(episode, commands=lagging, poses=poses_then, wrenches=wrenches))
    (warning,) = check_episode(replace(episode, wrenches=-episode.wrenches))
    assert "F_z looks inverted" in warning
    with pytest.raises(EpisodeError, match="F_z looks inverted.*change the sign of the column F_z"):
        check_units(replace(episode, wrenches=-episode.wrenches))
    with pytest.raises(
        EpisodeError, match=r"F_z is 0\.0[01]\d+ times .*, expected about 1; check the"
    ):
        check_units(replace(episode, stiffness=stiffness * 100))
    (warning,) = check_episode(replace(episode, stiffness=stiffness * 100))
    assert "check the stiffness" in warning
    degrees = torch.tensor([1, 1, 180 / torch.pi], dtype=torch.float64)
    turned = episode.poses.clone()
    turned[1:, 2] = 0.02
    told = replace(episode, poses=turned, wrenches=stiffness * (turned - commands) + noise)
    assert check_episode(told) == []
    check_units(told)
    with pytest.raises(EpisodeError, match="angles are in degrees; expected rad: multiply"):
        check_units(replace(told, poses=turned * degrees))
    (warning,) = check_episode(replace(told, poses=turned * degrees))
    assert "as where angles are in degrees" in warning and "pi / 180" in warning
    free = replace(episode, poses=commands, wrenches=noise)
    assert "no step shows contact" in check_episode(free)[0]
    for factor, told in ((1e-3, "as where the stiffness is in N/mm"), (1e-2, "within the noise")):
        soft = check_episode(replace(episode, stiffness=stiffness * factor, unusual=True))
        assert any(told in line for line in soft)
    silent = replace(episode, sensor_std=torch.zeros(6, dtype=torch.float64))
    assert any("taken as free of noise" in line for line in check_episode(silent))


def soft_episode(k: float, force: float = 15.0) -> Episode:
    """What an arm of k N/m does that presses: free, pressed by `force`, slid, lifted again."""
    commands = torch.zeros(5, 3, dtype=torch.float64)
    commands[:, 1] = 0.05
    commands[1:4, 1] = -force / k
    commands[2, 0] = 0.03
    poses = commands.clone()
    poses[1:4, 1] = 0.0
    stiffness = torch.tensor([k, k, 5.0], dtype=torch.float64)
    return Episode(
        commands=commands,
        poses=poses,
        wrenches=stiffness * (poses - commands),
        stiffness=stiffness,
        sensor_std=torch.tensor([2e-4, 2e-4, 5e-4, 0.3, 0.3, 0.02], dtype=torch.float64),
    )


@pytest.mark.parametrize("k", [10.0, 30.0, 100.0])
def test_a_command_may_lie_as_far_beyond_the_pose_as_the_springs_are_stretched(k, tmp_path):
    episode = soft_episode(k)
    back = read_episode(write_episode(episode, tmp_path / "soft"))
    assert torch.equal(back.commands, episode.commands)
    assert check_episode(back) == []
    check_units(back)
    # A rotation of 3 rad that the torque holds back, and a move of 0.8 m in the air.
    turned = episode.commands.clone()
    turned[1:4, 2] = -3.0
    wrenches = episode.wrenches.clone()
    wrenches[1:4, 2] = 15.0
    write_episode(replace(episode, commands=turned, wrenches=wrenches), tmp_path / "turned")
    away = torch.tensor([0.8, 0.0, 0.0], dtype=torch.float64)
    far = replace(
        episode,
        commands=torch.cat((episode.commands, episode.commands[-1:] + away)),
        poses=torch.cat((episode.poses, episode.poses[-1:] + away)),
        wrenches=torch.cat((episode.wrenches, 0 * episode.wrenches[-1:])),
    )
    write_episode(far, tmp_path / "far")


def test_a_jump_that_neither_motion_nor_springs_explain_is_refused(tmp_path):
    episode = soft_episode(30.0)
    commands, poses = episode.commands.clone(), episode.poses.clone()
    commands[2, 0] += 0.7
    with pytest.raises(EpisodeError, match=r"row 2 .*command jumps by 0.7\d* m, and pose and"):
        write_episode(replace(episode, commands=commands), tmp_path / "a")
    poses[3, 0] += 0.9
    with pytest.raises(EpisodeError, match=r"row 3 .*the pose jumps by 0.\d+ m.*check the units"):
        write_episode(replace(episode, poses=poses), tmp_path / "a")
    # A sensor that feels nothing while the springs are stretched by 0.5 m and more.
    with pytest.raises(EpisodeError, match=r"row 1 .*the command jumps by 0.55 m"):
        write_episode(replace(episode, wrenches=0 * episode.wrenches), tmp_path / "a")


def test_places_far_off_are_millimetres_unless_they_are_said_to_be_meant(tmp_path):
    episode = soft_episode(100.0)
    hall = torch.tensor([23.0, 7.0, 0.0], dtype=torch.float64)
    moved = replace(
        episode,
        commands=episode.commands + hall,
        poses=episode.poses + hall,
        priors={"floor_height": (6.9, 7.1), "wall_position": (23.1, 23.2)},
        unusual=True,
    )
    path = write_episode(moved, tmp_path / "hall")
    assert len(read_episode(path)) == 5
    header = path.with_suffix(".yaml")
    header.write_text(header.read_text().replace("unusual: true\n", "").split("priors")[0])
    with pytest.raises(EpisodeError, match="row 0 .*column u_x.* it looks like millimetres"):
        read_episode(path)


@pytest.mark.parametrize(
    ("scale", "told"),
    [
        (1e-3, "forces are 1000 times .*as where the stiffness is in N/mm.*give the stiffness in"),
        (1e3, "forces are 0.001 times .*as where positions are in millimetres"),
    ],
)
def test_a_factor_of_a_thousand_is_named_by_its_unit(scale, told):
    episode = soft_episode(100.0)
    scaled = replace(episode, stiffness=scale * episode.stiffness, unusual=True)
    with pytest.raises(EpisodeError, match=told):
        check_units(scaled)
    with pytest.raises(EpisodeError, match=told):
        check_scale(scaled)
    assert re.search(told, check_episode(scaled)[0])
    assert [each.weight for each in episode_findings(scaled)][0] is Weight.SERIOUS


def test_an_inverted_torque_is_told_with_the_angle_that_may_be_it():
    generator = torch.Generator().manual_seed(1)
    commands = torch.zeros(12, 3, dtype=torch.float64)
    commands[:, 1] = 0.05
    commands[1:, 1] = -0.03
    commands[1:, 0] = torch.linspace(-0.02, 0.02, 11)
    commands[1:, 2] = 0.05
    stiffness = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
    # Pressed on a floor that lies 40 mm below the hand and 10 mm to its right, with friction.
    forces = torch.zeros(12, 2, dtype=torch.float64)
    forces[1:, 1] = 3.0 + torch.rand(11, generator=generator, dtype=torch.float64)
    forces[1:, 0] = torch.linspace(-1.0, 1.0, 11)
    torque = 0.01 * forces[:, 1] + 0.04 * forces[:, 0]
    wrenches = torch.cat((forces, torque[:, None]), 1)
    episode = Episode(
        commands=commands,
        poses=commands + wrenches / stiffness,
        wrenches=wrenches,
        stiffness=stiffness,
        sensor_std=torch.tensor([1e-5, 1e-5, 1e-5, 0.05, 0.05, 1e-3], dtype=torch.float64),
    )
    assert check_episode(episode) == []
    signs = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    (told,) = check_episode(replace(episode, wrenches=signs * wrenches))
    assert "either the angle or the torque looks inverted" in told
    assert "forces act from within the object; change the sign of tau, if phi does grow" in told
    turned = replace(episode, commands=signs * commands, poses=signs * episode.poses)
    (told,) = check_episode(turned)
    assert "from outside the object; change the sign of u_phi and phi, if phi does not" in told
    (few,) = check_episode(turned.first(5))
    assert "look whether phi grows as the hand turns from x to z" in few
