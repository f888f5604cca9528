"""What speaks against the rows of an episode that obeys the format."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch

from tpcd.data import Episode, check_episode, read_episode, write_episode
from tpcd.data.checks import check_scale, check_units, episode_findings
from tpcd.errors import EpisodeError
from tpcd.quality.finding import Weight


def test_an_inverted_wrench_is_a_warning_and_a_right_one_is_none(tmp_path):
    generator = torch.Generator().manual_seed(0)
    commands = torch.zeros(8, 3, dtype=torch.float64)
    commands[1:, 1] = -0.03
    poses = commands.clone()
    poses[1:, 1] = 0.01
    stiffness = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
    noise = 0.05 * torch.randn(8, 3, generator=generator, dtype=torch.float64)
    poses += 1e-4 * torch.randn(8, 3, generator=generator, dtype=torch.float64)
    episode = Episode(
        commands=commands,
        poses=poses,
        wrenches=stiffness * (poses - commands) + noise,
        stiffness=stiffness,
        sensor_std=torch.tensor([1e-4, 1e-4, 1e-4, 0.05, 0.05, 0.05], dtype=torch.float64),
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
    commands[1:, 0] = 0.04 * torch.rand(11, generator=generator, dtype=torch.float64) - 0.02
    commands[1:, 2] = 0.05
    stiffness = torch.tensor([100.0, 100.0, 50.0], dtype=torch.float64)
    # Pressed on a floor that lies 40 mm below the hand and 10 mm to its right, with friction.
    forces = torch.zeros(12, 2, dtype=torch.float64)
    forces[1:, 1] = 3.0 + torch.rand(11, generator=generator, dtype=torch.float64)
    forces[1:, 0] = 2.0 * torch.rand(11, generator=generator, dtype=torch.float64) - 1.0
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
