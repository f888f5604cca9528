"""Bags of ROS 1 and 2 and MCAP files, written here through rosbags, come back as they were."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from made_bags import BEGIN, FRAMES, KINDS, TOPICS, write_bag
from made_logs import Setting, an_episode, choices_of, in_space, sampled

from tpcd.data.episode import Episode
from tpcd.logs.bags import POSE, WRENCH, choose_topics, is_bag, read_bag
from tpcd.logs.importing import import_log
from tpcd.logs.log import LogError

EPISODE = an_episode(4)
SPACE = in_space(sampled(EPISODE), Setting())


def check(path: Path) -> None:
    log = read_bag(path)
    content = import_log(log, choices_of(Setting())).content
    assert isinstance(content, Episode) and len(content) == len(EPISODE)
    assert float((content.commands - EPISODE.commands)[1:].abs().max()) < 1e-6
    assert float((content.poses - EPISODE.poses).abs().max()) < 1e-3
    # Interpolated from readings 3 ms later.
    assert float((content.wrenches - EPISODE.wrenches).abs().max()) < 0.2
    k = 40
    expected = SPACE["force"][k] + (SPACE["force"][k - 1] - SPACE["force"][k]) * 0.3
    (found,) = log.forces[np.abs(log.times - (SPACE["time"][k] - SPACE["time"][1])) < 1e-4]
    assert np.allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("stamped", [True, False], ids=["stamps", "recorder"])
def test_bags_of_every_kind_are_the_episode(kind: str, stamped: bool, tmp_path: Path) -> None:
    stamp = BEGIN if stamped else None
    path = write_bag(kind, tmp_path / "run", SPACE, stamp=lambda role, time: stamp and stamp + time)
    assert is_bag(path)
    check(path)


@pytest.mark.parametrize(("kind", "pattern"), [("ros2", "*.db3"), ("mcap", "*.mcap")])
def test_the_file_inside_a_bag_is_enough(kind: str, pattern: str, tmp_path: Path) -> None:
    path = write_bag(kind, tmp_path / "run", SPACE)
    (inside,) = path.glob(pattern)
    check(inside)


def test_frames_that_differ_are_told_or_refused(tmp_path: Path) -> None:
    path = write_bag("ros1", tmp_path / "a", SPACE, frames={**FRAMES, "wrench": "tool0"})
    assert any("give --wrench_frame tool" in note for note in read_bag(path).notes)
    path = write_bag("ros1", tmp_path / "b", SPACE, frames={**FRAMES, "command": "world"})
    with pytest.raises(LogError, match="the pose is in 'base', the set point in 'world'"):
        read_bag(path)


def test_a_bag_without_set_points_says_so_later(tmp_path: Path) -> None:
    topics = {role: topic for role, topic in TOPICS.items() if role != "command"}
    log = read_bag(write_bag("ros1", tmp_path / "a", SPACE, topics))
    assert log.command_positions is None


def test_topics_are_chosen_where_only_one_fits() -> None:
    path = Path("a.bag")
    types = {"/pose": POSE, "/goal": POSE, "/ft": WRENCH, "/text": "std_msgs/msg/String"}
    expected = {"pose": "/pose", "wrench": "/ft", "command": "/goal"}
    assert choose_topics(types, {}, path) == expected
    assert choose_topics({**types, "/b": POSE}, {"pose": "/pose"}, path) == expected
    for more, named, match in (
        ({"/b": POSE}, {}, r"topics for the pose: /pose, /b; name one with --topics pose=TOPIC"),
        ({"/ft2": WRENCH}, {}, "topics for the wrench: /ft, /ft2"),
        ({}, {"pose": "/nothing"}, "topic '/nothing' is not in the bag"),
        ({}, {"pose": "/ft"}, "topic '/ft' is geometry_msgs/msg/WrenchStamped"),
    ):
        with pytest.raises(LogError, match=match):
            choose_topics({**types, **more}, named, path)
    with pytest.raises(LogError, match="topics for the pose: none of geometry_msgs"):
        choose_topics({"/ft": WRENCH}, {}, path)


def test_bad_bags_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"this is no bag")
    for name, expected in (
        ("none.bag", "no such file"),
        ("folder", "is a folder without metadata.yaml"),
        ("a.bag", "cannot be read as a bag"),
        ("a.mcap", "cannot be read as a bag"),
        ("a.db3", "cannot be read as a bag"),
    ):
        with pytest.raises(LogError, match=expected) as caught:
            read_bag(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="expected pose=, wrench= or command=TOPIC"):
        read_bag(tmp_path / "a.bag", ("pose",))


def test_without_rosbags_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.bag").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(LogError, match=r"bags need rosbags; pip install 'tpcd\[bags\]'"):
        read_bag(tmp_path / "a.bag")
