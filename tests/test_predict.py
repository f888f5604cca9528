"""Laws of the predictor: mixtures, noise, wrench, gradients, and per-element truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tpcd.belief import EstimatorSettings, SamplerSettings, estimate
from tpcd.belief.belief import Belief
from tpcd.belief.storage import FORMAT_VERSION, load_belief, save_belief
from tpcd.commands.prediction import rollout_rows
from tpcd.errors import RunError
from tpcd.planar import wrap_angle
from tpcd.predict import ContactPredictor
from tpcd.shape.builtin import builtin_outlines
from tpcd.shape.polygon import PolygonShape
from tpcd.truth.make import make_truth
from tpcd.truth.recording import Recording, make_motion, record
from tpcd.truth.scene import Scene, draw_scene


@pytest.fixture(scope="module")
def learnt() -> tuple[Belief, Scene, Recording]:
    """A belief from eight steps on a known outline, its scene, and a held-out recording."""
    outline = builtin_outlines()["milk_carton"]
    generator = torch.Generator().manual_seed(3)
    scene = draw_scene("milk_carton", outline.vertices, generator)
    truth = make_truth(scene, "quasistatic")
    explored = record(truth, scene, make_motion("rich", scene, 8, generator), 8, generator)
    test = record(truth, scene, make_motion("test", scene, 12, generator), 12, generator)
    settings = EstimatorSettings(sampler=SamplerSettings(particles=200), misfit_sd=3e-4)
    sampler = torch.Generator().manual_seed(0)
    for step in estimate(explored.measured, PolygonShape(outline), sampler, settings):
        belief = step.belief
    return belief, scene, test


def predict(belief: Belief, test: Recording, **options):
    episode = test.measured
    return ContactPredictor(belief, 100).predict(
        episode.poses[:-1], episode.commands[1:], previous=episode.commands[:-1], **options
    )


def test_predictions_of_a_learnt_scene_are_close_and_cover_the_truth(learnt) -> None:
    belief, _, test = learnt
    prediction = predict(belief, test, pose_std=test.measured.sensor_std[:3])
    rows = torch.cat((test.true.poses, test.true.wrenches), -1)[1:]
    error = (prediction.mean - rows).abs().mean(0)
    assert float(error[:2].max()) < 1.5e-3
    assert float(error[3:5].max()) < 0.15
    inside = (rows >= prediction.quantile(0.005)) & (rows <= prediction.quantile(0.995))
    assert float(inside.double().mean()) > 0.8


def test_the_wrench_is_the_stiffness_times_the_offset(learnt) -> None:
    belief, _, test = learnt
    prediction = predict(belief, test)
    offset = prediction.mean[:, :3] - test.measured.commands[1:]
    torch.testing.assert_close(prediction.mean[:, 3:], belief.stiffness * offset)
    torch.testing.assert_close(prediction.std[:, 3:], belief.stiffness * prediction.std[:, :3])


def test_quantiles_invert_the_distribution_function(learnt) -> None:
    belief, _, test = learnt
    prediction = predict(belief, test, pose_std=test.measured.sensor_std[:3])
    for level in (0.05, 0.5, 0.95):
        reached = prediction.probability_below(prediction.quantile(level))
        assert float((reached - level).abs().max()) < 1e-3
    with pytest.raises(ValueError, match="level is 1"):
        prediction.quantile(1.0)


def test_samples_have_the_moments_of_the_mixture(learnt) -> None:
    belief, _, test = learnt
    noise = test.measured.sensor_std
    prediction = predict(belief, test, pose_std=noise[:3], sensor_std=noise)
    draws = prediction.sample(20_000, torch.Generator().manual_seed(1))
    standard_error = prediction.std / math.sqrt(20_000)
    assert float(((draws.mean(0) - prediction.mean).abs() / standard_error).max()) < 5
    assert float((draws.std(0) / prediction.std - 1).abs().max()) < 0.06


def test_sensor_noise_adds_in_quadrature(learnt) -> None:
    belief, _, test = learnt
    noise = test.measured.sensor_std
    silent, noisy = predict(belief, test), predict(belief, test, sensor_std=noise)
    torch.testing.assert_close(noisy.std**2, silent.std**2 + noise**2)
    torch.testing.assert_close(noisy.mean, silent.mean)


def test_a_free_motion_is_certain_and_exact(learnt) -> None:
    belief, scene, _ = learnt
    start = scene.start_pose[None]
    command = start + torch.tensor([[0.0, 0.03, 0.05]], dtype=torch.float64)
    prediction = ContactPredictor(belief).predict(start, command)
    torch.testing.assert_close(prediction.mean[:, :3], command, atol=1e-9, rtol=0)
    assert float(prediction.std[:, :3].max()) < 1e-4
    torch.testing.assert_close(
        prediction.mode_probability[0, :, 0], torch.ones(2, dtype=torch.float64)
    )


def test_mode_probabilities_sum_to_one(learnt) -> None:
    belief, _, test = learnt
    total = predict(belief, test).mode_probability.sum(-1)
    torch.testing.assert_close(total, torch.ones_like(total))


@pytest.mark.parametrize(("misfit", "tolerance"), [(1.0, 2e-3), (0.0, 1e-6)])
def test_predictions_are_differentiable_in_the_command(
    learnt, misfit: float, tolerance: float
) -> None:
    """Exact without a misfit of the outline; with it, its lever is held fixed."""
    belief, _, test = learnt
    belief = replace(belief, misfit_mean=misfit * belief.misfit_mean)
    predictor = ContactPredictor(belief, 20)
    pose, before = test.measured.poses[4:5], test.measured.commands[4:5]
    command = test.measured.commands[5:6].clone().requires_grad_()
    mean = predictor.predict(pose, command, previous=before).mean
    weights = torch.tensor([1.0, -2.0, 3.0, 0.1, 0.2, -0.3], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((mean * weights).sum(), command)
    step = 1e-6
    for axis in range(3):
        shift = step * torch.eye(3, dtype=torch.float64)[axis]
        values = [
            float((predictor.predict(pose, at, previous=before).mean * weights).sum())
            for at in (command.detach() + shift, command.detach() - shift)
        ]
        difference = (values[0] - values[1]) / (2 * step)
        assert float(gradient[0, axis]) == pytest.approx(difference, rel=tolerance, abs=tolerance)


def test_a_bad_command_leaves_its_neighbours_alone(learnt) -> None:
    belief, _, test = learnt
    predictor = ContactPredictor(belief, 50)
    poses, commands = test.measured.poses[:-1], test.measured.commands[1:].clone()
    good = predictor.predict(poses, commands)
    commands[3, 0] = math.nan
    bad = predictor.predict(poses, commands)
    others = torch.arange(len(commands)) != 3
    assert torch.equal(bad.mean[others], good.mean[others])
    assert not bool(bad.answered[3])
    assert bool(bad.mean[3].isnan().all())


def test_rollouts_start_as_the_one_step_prediction(learnt) -> None:
    belief, scene, test = learnt
    predictor = ContactPredictor(belief, 100)
    commands = test.measured.commands[1:]
    draws = predictor.rollout(
        scene.start_pose, commands, torch.Generator().manual_seed(2), samples=100
    )
    assert draws.shape == (100, len(commands), 6)
    first = predictor.predict(scene.start_pose[None], commands[:1])
    assert float((draws[:, 0].mean(0) - first.mean[0]).abs()[:3].max()) < 1e-3
    error = (draws.mean(0) - torch.cat((test.true.poses, test.true.wrenches), -1)[1:]).abs()
    assert float(error[:, :2].mean()) < 3e-3


def test_rolled_out_angles_about_pi_are_not_averaged_to_zero(learnt) -> None:
    belief, _, test = learnt
    turn = torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64)
    there = replace(
        test.measured, poses=test.measured.poses + turn, commands=test.measured.commands + turn
    )

    class Near(ContactPredictor):
        """Trajectories that end on both sides of pi."""

        def rollout(self, *_: object, samples: int) -> torch.Tensor:
            draws = torch.zeros(samples, len(there) - 1, 6, dtype=torch.float64)
            draws[..., 2] = torch.linspace(-1e-3, 1e-3, samples)[:, None].double() + math.pi
            draws[..., 2] = wrap_angle(draws[..., 2])
            return draws

    rows = rollout_rows(Near(belief, 20), there, torch.Generator().manual_seed(0), of="true")
    assert float(wrap_angle(rows.mean[:, 2] - math.pi).abs().max()) < 1e-4
    assert float(rows.std[:, 2].max()) < 1e-3
    assert float((rows.high - rows.low)[:, 2].max()) < 3e-3


def test_particles_are_kept_by_weight(learnt) -> None:
    belief, _, test = learnt
    weights = torch.zeros_like(belief.weights)
    weights[7] = 1.0
    alone = replace(belief, weights=weights)
    prediction = predict(alone, test)
    expected = predict(
        replace(
            belief,
            vectors=belief.vectors[7:8],
            weights=torch.ones(1, dtype=torch.float64),
            misfit_sd=belief.misfit_sd[7:8],
            misfit_mean=belief.misfit_mean[7:8],
            misfit_covariance=belief.misfit_covariance[7:8],
        ),
        test,
    )
    torch.testing.assert_close(prediction.mean, expected.mean)
    torch.testing.assert_close(prediction.std, expected.std)


def test_a_folder_without_a_belief_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no such file; give the folder that estimate wrote"):
        load_belief(tmp_path)
    (tmp_path / "belief.json").write_text('{"format": "tpcd-belief", "format_version": 99}')
    expected = f"version 99, expected tpcd-belief version {FORMAT_VERSION}"
    with pytest.raises(RunError, match=expected):
        load_belief(tmp_path)


@pytest.mark.parametrize("spoil", ["a list", "no misfit", "an unknown setting of the step"])
def test_a_malformed_card_is_refused_in_one_line(learnt, tmp_path: Path, spoil: str) -> None:
    belief, _, _ = learnt
    save_belief(belief, tmp_path, "ycb21-z2")
    path = tmp_path / "belief.json"
    card = json.loads(path.read_text())
    if spoil == "a list":
        card = [card]
    elif spoil == "no misfit":
        del card["misfit"]
    else:
        card["step"]["gravity"] = 9.81
    path.write_text(json.dumps(card))
    with pytest.raises(RunError, match="cannot be read|expected tpcd-belief|expected entries"):
        load_belief(tmp_path, belief.prior.shape)


def test_a_belief_that_was_cut_off_is_refused_in_one_line(learnt, tmp_path: Path) -> None:
    belief, _, _ = learnt
    save_belief(belief, tmp_path, "ycb21-z2")
    data = tmp_path / "belief.safetensors"
    data.write_bytes(data.read_bytes()[:100])
    with pytest.raises(RunError, match="cannot be read .*; estimate again"):
        load_belief(tmp_path, belief.prior.shape)
    data.unlink()
    with pytest.raises(RunError, match="no such file"):
        load_belief(tmp_path, belief.prior.shape)


def test_intervals_are_numbers(learnt) -> None:
    belief, _, test = learnt
    prediction = predict(belief, test)
    low, high = prediction.quantile(0.05).numpy(), prediction.quantile(0.95).numpy()
    assert np.isfinite(low).all() and np.isfinite(high).all()
    assert (low <= high).all()


def test_particles_and_card_of_two_beliefs_are_not_taken_for_one(learnt, tmp_path) -> None:
    """Files of two runs, or of a run stopped in between, read as one belief without a word."""
    belief = learnt[0]
    for name, weights in (("a", belief.weights), ("b", belief.weights.flip(0))):
        save_belief(replace(belief, weights=weights), tmp_path / name, "ycb21-z2")
    data = (tmp_path / "b" / "belief.safetensors").read_bytes()
    (tmp_path / "a" / "belief.safetensors").write_bytes(data)
    with pytest.raises(RunError, match="does not belong to its belief.json .hash differs"):
        load_belief(tmp_path / "a", belief.prior.shape)


def test_a_card_whose_entries_are_not_those_of_the_particles_is_refused(learnt, tmp_path) -> None:
    belief = learnt[0]
    path = save_belief(belief, tmp_path, "ycb21-z2")
    card = json.loads(path.read_text())
    path.write_text(json.dumps(card | {"names": card["names"][:-1]}))
    with pytest.raises(RunError, match="names and effects are not those of the"):
        load_belief(tmp_path, belief.prior.shape)
