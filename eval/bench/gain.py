"""Time the choice of a command, and compare its ranking with a reference of many samples.

python -m eval.bench.gain --out runs/bench_gain

The paper's Algorithm 2 weighs 27 commands with a fifth of the filter's particles; it is timed
with that and with all of them, over the number of particles and the number of commands, beside
a choice of our own policy. The ranking is tested on beliefs met while exploring, the prior
included: goals near and far are ranked by the estimator with few particles, and by a reference
with all of them and many draws of the noise (the part that is of the outline's misfit is a closed
form in both). Regret is the gain that taking the estimator's best loses.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from eval.bench.step import fastest
from tpcd.cli import check_numbers, run

if TYPE_CHECKING:
    from torch import Tensor

    from tpcd.policies import Situation

COMMAND = "python -m eval.bench.gain"
TARGETS = {1000: 0.4, 5000: 2.0}
"""Wall seconds of 27 commands on 2 cores by the number of particles; the paper: about 5 s."""


@dataclass(frozen=True)
class Benchmark:
    """What to time."""

    out: Path = Path("runs/bench_gain")
    """Folder for results.json, figures and the TensorBoard log."""
    prior: str = "ycb21-z2"
    """Shape prior, by name or folder."""
    outline: str = "jam_jar"
    """Built-in outline that is explored."""
    particles: tuple[int, ...] = (250, 500, 1000, 2000, 5000)
    """Numbers of particles of the curve."""
    commands: tuple[int, ...] = (27, 54, 108, 216)
    """Numbers of commands of the curve."""
    scenes: int = 6
    """Scenes in which rankings are compared, after 0, 1, 4 and 8 moves each."""
    candidates: int = 64
    """Commands that are ranked."""
    reference_particles: int = 1000
    """Particles of the beliefs, all of which the reference uses."""
    reference_draws: int = 8
    """Draws of the noise for each particle in the reference."""
    repeats: int = 3
    """Each part is run this often; the fastest run counts."""
    threads: int = 2
    """Threads of torch and of the compiled loops."""
    seed: int = 0
    """Seed of scenes and particles."""
    quick: bool = False
    """Few particles and one scene, to see that everything works."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        names = ("particles", "commands", "scenes", "candidates", "repeats")
        names = (*names, "reference_particles", "reference_draws")
        check_numbers(self, least=dict.fromkeys((*names, "threads"), 1))


def benchmark(config: Benchmark) -> None:
    """Print seconds of choosing a command, and how well estimators rank commands."""
    import torch
    from torch.utils.tensorboard import SummaryWriter

    from eval.bench.figures import growth
    from tpcd.figures.sinks import save_figure
    from tpcd.results import format_table, run_folder, write_results

    torch.set_num_threads(config.threads)
    with run_folder(config.out, COMMAND, config, config.overwrite) as folder:
        times = _times(config)
        ranks = _ranks(config)
        text = format_table(times, formats={"cpu_s": ".3f", "wall_s": ".3f"})
        ranking = format_table(ranks, formats={"spearman": ".3f", "regret": ".2%", "worst": ".2%"})
        print(f"{text}\n\nranking against the reference:\n{ranking}")
        with SummaryWriter(folder / "tensorboard") as writer:
            for axis in ("particles", "commands"):
                chosen = [row for row in times if row["curve"] == axis]
                figure = growth(chosen, axis, TARGETS if axis == "particles" else {})
                save_figure(figure, folder / "figures", f"gain_by_{axis}", writer)
            writer.add_text("table", f"```\n{text}\n\n{ranking}\n```")
        write_results(folder, times, seeds=[config.seed], ranking=ranks)
    print(f"results in {config.out}")


def _times(config: Benchmark) -> list[dict[str, Any]]:
    from tpcd.belief.paper import PaperSettings
    from tpcd.exploration import Estimator
    from tpcd.policies import ActivePolicy, Limits
    from tpcd.random import stream
    from tpcd.shape.checkpoint import load_prior

    shape = load_prior(config.prior)
    sizes = (100, 200) if config.quick else config.particles
    largest = max(sizes)
    paper = Estimator(shape, "paper", paper=PaperSettings(particles=largest))
    situation = _situations(config, paper, 0, moves=(4,))[0]
    table = []
    for curve, pairs in (
        ("particles", [(m, 27) for m in sizes]),
        ("commands", [(min(1000, largest), c) for c in config.commands]),
    ):
        for particles, commands in pairs:
            found = fastest(
                lambda m=particles, c=commands: _grid_choice(situation, m, c), config.repeats, False
            )
            table.append(
                {"what": "Algorithm 2", "curve": curve, "particles": particles,
                 "commands": commands, **found}
            )  # fmt: skip
    ours = _situations(config, Estimator(shape), 0, moves=(4,))[0]
    policy = ActivePolicy(Limits())
    found = fastest(lambda: policy.choose(ours, stream(config.seed)), config.repeats, False)
    considered = policy.choose(ours, stream(config.seed)).considered
    table.append({"what": "our choice", "curve": "", "commands": considered, **found})
    return table


def _grid_choice(situation: Situation, particles: int, commands: int) -> Tensor:
    """Gains of a grid, repeated to so many commands."""
    from tpcd.information import grid_commands, grid_gain
    from tpcd.predict import ContactPredictor

    grid = grid_commands(situation.episode.commands[-1])
    grid = grid.repeat(-(-commands // len(grid)), 1)[:commands]
    prediction = ContactPredictor(situation.belief, particles).predict(
        situation.episode.poses[-1].expand_as(grid),
        grid,
        previous=situation.episode.commands[-1].expand_as(grid),
    )
    return grid_gain(prediction)


def _ranks(config: Benchmark) -> list[dict[str, Any]]:
    """Rank correlation and regret of our estimator, by its number of particles."""
    import torch
    from scipy.stats import spearmanr

    from tpcd.belief import EstimatorSettings, SamplerSettings
    from tpcd.exploration import Estimator
    from tpcd.information import belief_outcomes, expected_information_gain
    from tpcd.policies import Limits
    from tpcd.predict import ContactPredictor
    from tpcd.random import stream
    from tpcd.shape.checkpoint import load_prior

    sampler = SamplerSettings(particles=config.reference_particles)
    estimator = Estimator(load_prior(config.prior), settings=EstimatorSettings(sampler=sampler))
    found: dict[int, list[tuple[float, float]]] = {}
    for scene in range(1 if config.quick else config.scenes):
        for situation in _situations(config, estimator, scene, moves=(0, 1, 4, 8)):
            episode = situation.episode
            place = torch.rand(
                config.candidates, 3, generator=stream(config.seed, scene, 9), dtype=torch.float64
            )
            # Near and far goals in turn, as the policy searches them.
            near, far = (
                Limits().box(episode.poses[-1], episode.stiffness, strides)
                for strides in (1.0, 3.0)
            )
            commands = near[0] + (near[1] - near[0]) * place
            commands[::2] = far[0] + (far[1] - far[0]) * place[::2]
            noise = torch.randn(
                config.reference_draws, 3, generator=stream(config.seed, scene, 8),
                dtype=torch.float64,
            )  # fmt: skip

            def gain(particles: int, noise: Tensor | None = None) -> Tensor:
                predictor = ContactPredictor(situation.belief, particles)  # noqa: B023
                outcomes, _ = belief_outcomes(
                    predictor, episode.poses[-1], commands, episode.commands[-1],  # noqa: B023
                    episode.sensor_std,  # noqa: B023
                )  # fmt: skip
                return expected_information_gain(outcomes, noise)

            reference = gain(config.reference_particles, noise)
            for particles in (50, 100, 300):
                value = gain(particles)
                correlation = float(spearmanr(value.numpy(), reference.numpy())[0])
                lost = float(reference.max() - reference[value.argmax()]) / float(reference.max())
                found.setdefault(particles, []).append((correlation, lost))
    return [
        {
            "particles": particles,
            "beliefs": len(pairs),
            "spearman": sum(r for r, _ in pairs) / len(pairs),
            "regret": sum(lost for _, lost in pairs) / len(pairs),
            "worst": max(lost for _, lost in pairs),
        }
        for particles, pairs in found.items()
    ]


def _situations(
    config: Benchmark, estimator: Any, scene_number: int, moves: tuple[int, ...]
) -> list[Situation]:
    """Beliefs after some moves of the paper's random policy."""
    from tpcd.exploration import explore
    from tpcd.policies import Limits, Situation, make_policy
    from tpcd.random import stream
    from tpcd.robot.simulated import SimulatedRobot
    from tpcd.shape.builtin import builtin_outlines
    from tpcd.truth.make import make_truth
    from tpcd.truth.scene import draw_scene

    vertices = builtin_outlines()[config.outline].vertices
    scene = draw_scene(config.outline, vertices, stream(config.seed, scene_number))
    robot = SimulatedRobot(make_truth(scene, "quasistatic"), scene, config.seed)
    policy = make_policy("random", Limits(), scene, config.seed)
    found = []
    if 0 in moves:
        start = robot.start()
        belief = estimator.before(start, stream(config.seed, scene_number, 7))
        found.append(Situation(start, belief))
    for step in explore(robot, policy, estimator, config.seed):
        if len(step.episode) - 1 in moves:
            found.append(Situation(step.episode, step.estimation.belief))
        if len(found) == len(moves):
            return found
    raise AssertionError("exploration goes on without end")


if __name__ == "__main__":
    run(benchmark, Benchmark, prog=COMMAND)
