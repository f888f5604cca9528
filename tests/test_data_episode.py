"""Laws of the episode format: exact round trips, and files that are written whole or not at all."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from episode_files import HEADER, ROWS, YAML, edit, sample_episode, write_files
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tpcd.data import Episode, read_episode, write_episode
from tpcd.data.files import write_together
from tpcd.data.limits import LARGEST_WRENCH
from tpcd.errors import EpisodeError

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


def test_noise_widens_what_the_start_row_may_deviate(tmp_path):
    rows = edit(0, "u_z", "0.0508")
    assert len(read_episode(write_files(tmp_path, rows))) == 3
    quiet = YAML.replace("0.0002,", "0.0001,")
    with pytest.raises(EpisodeError, match="row 0"):
        read_episode(write_files(tmp_path, rows, quiet))


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
