"""The learnt contact dynamics p(x', w' | x, u) as an object to hold, ask and plan with.

Each particle of the belief predicts a normal distribution of the settled pose: where contact
comes to rest with the mean of its misfit field, with the field's remaining uncertainty and the
propagated noise of the start pose. The prediction is the mixture over particles. The wrench
follows from the pose, w = K (x' - u), so one mixture serves both.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tpcd.belief.belief import Belief
from tpcd.belief.misfit import misfit_rows
from tpcd.belief.resampling import systematic_resample
from tpcd.contact import ContactScene, column_scene, scene_from_parameters
from tpcd.contract import as_numbers, check_noise, check_pose
from tpcd.effects.conditions import Rows, sequence
from tpcd.effects.simulate import RowByRow, SimulatedRows, simulate_rows
from tpcd.planar import wrap_angle
from tpcd.prediction import Prediction
from tpcd.simulator import StepStatus, Transition, simulate_step

LEAST_STD = 1e-5
"""Numerical noise of the model itself [m, m, rad]; keeps every component a proper normal."""


class ContactPredictor:
    """Predicts settled pose and wrench from a belief; its answers are differentiable in u.

    Gradients hold the answer of the pose to a change of gap or lever fixed, with which the
    outline misfit acts, and the contact forces that effects answer to (a grip that yields
    sideways counts as rigid where it is); without misfit and such effects they are exact.
    """

    def __init__(self, belief: Belief, particles: int = 400) -> None:
        """Keep at most `particles` particles, chosen evenly by weight."""
        if particles < 1:
            raise ValueError(f"particles is {particles}, expected at least 1")
        self.belief = belief
        if len(belief.weights) > particles:
            generator = torch.Generator().manual_seed(0)
            keep = systematic_resample(belief.weights, particles, generator)
            self.weights = torch.full((particles,), 1.0 / particles, dtype=torch.float64)
        else:
            keep = torch.arange(len(belief.weights))
            self.weights = belief.weights
        parameters = belief.prior.parameters_of(belief.vectors[keep])
        with torch.no_grad():
            scene = scene_from_parameters(belief.prior.shape, parameters)
        self._flat = scene
        self._added = belief.prior.added_of(belief.vectors[keep])
        self._scene: ContactScene = column_scene(scene)
        self._field_sd = belief.misfit_sd[keep]
        self._field_mean = belief.misfit_mean[keep]
        # The covariance may have eigenvalues of zero up to rounding, which Cholesky refuses.
        values, vectors = torch.linalg.eigh(belief.misfit_covariance[keep])
        self._field_root = vectors * values.clamp_min(0.0).sqrt()[:, None, :]

    def predict(
        self,
        pose: Float[Tensor, "n 3"],
        command: Float[Tensor, "n 3"],
        previous: Float[Tensor, "n 3"] | None = None,
        pose_std: Float[Tensor, " 3"] | None = None,
        sensor_std: Float[Tensor, " 6"] | None = None,
        keep_field: bool = False,
        unusual: bool = False,
    ) -> Prediction:
        """Predict n transitions from pose and command [m, m, rad].

        One row may be given without its axis, and one pose for many commands. Raises TypeError and
        ValueError for other shapes and, unless `unusual`, for what looks like millimetres or
        degrees (see `tpcd.contract`). A row that is not finite is not answered. Where particles
        take the pose to be inside a terrain, `Prediction.start_inside` says so.

        `previous` is the command at which the arm rested in `pose` (None: without load).
        `pose_std` is the noise of `pose` where it was measured (None: exact). With
        `sensor_std`, noise of the six channels, the prediction is of what sensors will read;
        without, of what will truly be. `keep_field` asks for `Prediction.component_field`.

        Effects of time take rows of which each begins where the one before ended for a whole run,
        from its start to its end, and others for the end of one.
        """
        pose, command, previous = _asked(pose, command, previous, unusual)
        start_variance = _variance("pose_std", pose_std, 3, unusual)
        found = None
        gap = self._gap(self._field_mean[:, None], command[:, 2])
        if self._added.effects:
            found = self._with_effects(pose, command, previous)
            transition = found.transition
        else:
            transition = simulate_step(
                self._scene if gap is None else self._scene.further(gap),
                pose,
                command,
                self.belief.stiffness,
                self.belief.step,
                previous=previous,
                unusual=True,
            )
        settled = transition.pose
        # Angles are averaged near the command, the short way round.
        turn = command[:, 2:] + wrap_angle(settled[..., 2:] - command[:, 2:])
        settled = torch.cat((settled[..., :2], turn), dim=-1)
        spread = transition.pose_from_start * start_variance.sqrt()
        covariance = spread @ spread.mT + LEAST_STD**2 * torch.eye(3, dtype=torch.float64)
        rows, uncovered = misfit_rows(
            self.belief.misfit, self._field_sd[:, None], settled[..., 2], transition
        )
        covariance = covariance + uncovered
        field = rows @ self._field_root[:, None]
        if rows.shape[-1]:
            settled = settled + _shift(rows, self._field_mean[:, None], transition, gap)
            covariance = covariance + field @ field.mT
        usable = transition.status <= int(StepStatus.RELAXED)
        usable = usable & torch.isfinite(settled).all(-1)
        weights = torch.where(usable, self.weights[:, None], 0.0)
        total = weights.sum(0)
        answered = total > 0
        share = weights / torch.where(answered, total, math.nan)
        keep = usable[..., None]
        wrench = None
        if found is not None:
            moved = settled - transition.pose
            moved = torch.cat((moved[..., :2], wrap_angle(moved[..., 2:])), dim=-1)
            wrench = found.wrench + (found.matrix @ moved[..., None])[..., 0]
            wrench = torch.where(keep, wrench, 0.0)
        identity = torch.eye(3, dtype=torch.float64)
        sensor = _variance("sensor_std", sensor_std, 6, unusual)
        return Prediction(
            command=command,
            stiffness=self.belief.stiffness,
            weights=share,
            component_mean=torch.where(keep, settled, 0.0),
            component_covariance=torch.where(keep[..., None], covariance, identity),
            component_mode=transition.mode,
            component_status=transition.status,
            answered=answered,
            sensor_variance=sensor,
            component_wrench=wrench,
            wrench_matrix=None if found is None else found.matrix,
            component_field=torch.where(keep[..., None], field, 0.0) if keep_field else None,
        )

    def _with_effects(
        self, pose: Tensor, command: Tensor, previous: Tensor | None
    ) -> SimulatedRows:
        """The transitions as rows: of a run where they follow each other, else in pairs."""
        before = pose if previous is None else previous
        if torch.equal(before[1:], command[:-1]):
            rows, commands = (
                sequence(torch.cat((pose, pose[-1:]))),
                torch.cat((before[:1], command)),
            )
        else:
            commands = torch.stack((before, command), dim=1).flatten(0, 1)
            first = torch.arange(len(command)).repeat_interleave(2) * 2
            starts = pose.repeat_interleave(2, dim=0)
            rows = Rows(first, torch.ones(len(commands), dtype=torch.float64), starts)
        return simulate_rows(
            self._flat,
            rows,
            commands,
            self.belief.stiffness,
            self._added,
            self.belief.step,
            gap=self._gap(self._field_mean[:, None], commands[:, 2]),
        )

    def _gap(
        self, coefficients: Float[Tensor, "*#batch c"], angle: Float[Tensor, "*#batch"]
    ) -> Float[Tensor, "*batch t"] | None:
        """What the field changes of the gaps where the arm is asked to turn the object to `angle`,
        from which the rest of the way is linear."""
        return self.belief.misfit.gap(coefficients, angle) if coefficients.shape[-1] else None

    def rollout(
        self,
        pose: Float[Tensor, " 3"],
        commands: Float[Tensor, "n 3"],
        generator: torch.Generator,
        samples: int = 200,
        previous: Float[Tensor, " 3"] | None = None,
        unusual: bool = False,
    ) -> Float[Tensor, "samples n 6"]:
        """Draw whole trajectories: every particle follows its own poses, n steps long.

        Each trajectory keeps one theta, its effects and one draw of its misfit field throughout.
        What the field leaves to each reading is drawn at each step. A trajectory that a step has no
        answer for is replaced by another one; where all are, everything is NaN. What is taken and
        raised is that of `predict`.
        """
        if samples < 1:
            raise ValueError(f"samples is {samples}, expected at least 1")
        starts, commands, befores = _asked(pose, commands, previous, unusual)
        if bool((starts != starts[:1]).any()):
            raise ValueError(f"pose has shape {tuple(pose.shape)}, expected the pose of one start")
        pose, before = starts[0], None if befores is None else befores[0]
        chosen = torch.multinomial(self.weights, samples, replacement=True, generator=generator)
        scene = self._scene.gather(chosen)
        field = self._field_mean[chosen]
        if field.shape[-1]:
            noise = torch.randn(field.shape, generator=generator, dtype=torch.float64)
            field = field + (self._field_root[chosen] @ noise[..., None])[..., 0]
        gaps = self._gap(field[:, None], commands[:, 2])
        rough, levers = gaps, None
        if gaps is not None:
            own, levers = self._of_each_reading(chosen, commands[:, 2], generator)
            rough = gaps + own
        walk = None
        if self._added.effects:
            rest = pose if before is None else before
            everything = torch.cat((rest[None], commands))
            begin = self._gap(field[:, None], rest[None, 2])
            walk = RowByRow(
                self._flat.gather(chosen),
                everything,
                self.belief.stiffness,
                self._added[chosen],
                self.belief.step,
                pose,
                None if begin is None or rough is None else torch.cat((begin, rough), dim=1),
            )
        usable = torch.ones(samples, dtype=torch.bool)
        here, steps = pose.expand(samples, 3), []
        stiffness = self.belief.stiffness
        for row, command in enumerate(commands, start=1):
            gap = None if gaps is None else gaps[:, row - 1]
            if walk is None:
                world = scene if rough is None else scene.further(rough[:, row - 1])
                transition = simulate_step(
                    world, here, command, stiffness, self.belief.step, previous=before, unusual=True
                )
            else:
                found = walk.settle(row, here)
                transition = Transition(**{n: v[:, 0] for n, v in vars(found.transition).items()})
            here = transition.pose
            usable = usable & (transition.status <= int(StepStatus.RELAXED))
            rows, _ = misfit_rows(
                self.belief.misfit, self._field_sd[chosen], here[..., 2], transition
            )
            shift = _shift(rows, field, transition, gap)
            if levers is not None:
                lever = levers[:, row - 1, :, None]
                shift = shift + (transition.pose_from_lever * lever).sum(-2)
            here = here + shift
            if walk is None:
                offset = here - command
                offset = torch.cat((offset[..., :2], wrap_angle(offset[..., 2:])), dim=-1)
                wrench = stiffness * offset
            else:
                wrench = found.wrench[:, 0] + (found.matrix[:, 0] @ shift[..., None])[..., 0]
            steps.append(torch.cat((here, wrench), dim=-1))
            before = command
        found_steps = torch.stack(steps, dim=1)
        usable = usable & torch.isfinite(found_steps).flatten(1).all(-1)
        if not bool(usable.any()):
            return torch.full_like(found_steps, torch.nan)
        others = torch.multinomial(usable.double(), samples, replacement=True, generator=generator)
        return found_steps[torch.where(usable, torch.arange(samples), others)]

    def _of_each_reading(
        self, chosen: Int[Tensor, " s"], angles: Float[Tensor, " n"], generator: torch.Generator
    ) -> tuple[Float[Tensor, "s n t"], Float[Tensor, "s n t"]]:
        """Draws of what gaps and levers have besides the field's bumps."""
        terrains, field = self._flat.friction.shape[-1], self.belief.misfit
        left = field.uncovered(field.basis(angles)[0]).sqrt()
        noise = torch.randn(
            2, len(chosen), len(angles), terrains, generator=generator, dtype=torch.float64
        )
        gap, lever = self._field_sd[chosen, None, None] * noise
        return left[:, None] * gap, field.roughness * lever


def _asked(
    pose: Any, command: Any, previous: Any, unusual: bool
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3"] | None]:
    """What is asked of a predictor, as rows of equal number."""
    cpu, found = torch.device("cpu"), []
    for name, given in (("pose", pose), ("command", command), ("previous", previous)):
        if given is None and name == "previous":
            continue
        rows = as_numbers(name, given, 3, axes=2, device=cpu).double()
        check_pose(name, rows, unusual)
        found.append((name, rows))
    count = max(len(rows) for _, rows in found)
    for name, rows in found:
        if len(rows) not in (1, count):
            raise ValueError(f"{name} has {len(rows)} rows, expected 1 or {count} as the others")
    rows = [rows.expand(count, 3) for _, rows in found]
    return rows[0], rows[1], rows[2] if len(rows) > 2 else None


def _variance(name: str, std: Any, count: int, unusual: bool) -> Float[Tensor, " c"]:
    """The variances of so many channels with the given standard deviation; zeros for None."""
    if std is None:
        return torch.zeros(count, dtype=torch.float64)
    found = as_numbers(name, std, count, axes=1, device=torch.device("cpu")).double()
    check_noise(name, found, unusual)
    return found**2


def _shift(
    rows: Float[Tensor, "*#batch 3 c"],
    coefficients: Float[Tensor, "*#batch c"],
    transition: Transition,
    gap: Float[Tensor, "*#batch t"] | None,
) -> Float[Tensor, "*batch 3"]:
    """What the field moves of poses that settled with `gap` of it already."""
    if gap is None:
        return torch.zeros_like(transition.pose)
    moved = (rows @ coefficients[..., None])[..., 0]
    return moved - (transition.pose_from_gap * gap[..., None]).sum(-2)
