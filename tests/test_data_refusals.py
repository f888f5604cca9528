"""One clear line for each bad file of an episode."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from episode_files import HEADER, ROWS, YAML, edit, write_files

from tpcd.data import read_episode
from tpcd.errors import EpisodeError

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
