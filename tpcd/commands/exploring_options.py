"""What the commands that explore have in common, whatever the robot; quick to import."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tpcd.cli import check_numbers, check_resume

WEIGHING = ("active", "lookahead", "grid")
"""Policies that weigh commands against each other."""
EXTENTS = ("step_limit", "workspace_low", "workspace_high")
ARM_LOW, ARM_HIGH = (-0.15, -0.15, -0.15), (0.3, 0.3, 0.15)
"""Corners of the workspace that an arm has unless told otherwise [m, m, rad]."""
LARGEST_EXTENT = 5.0
"""What is asked for beyond this [m, rad] is taken for millimetres or degrees."""


@dataclass(frozen=True, kw_only=True)
class ExploringOptions:
    """Settings of every exploration; SI units."""

    out: Path
    """Folder for the results; a stopped run in it goes on with --resume."""
    prior: str = "ycb-rich"
    """Shape prior: a checkpoint folder, or the name of a shipped one."""
    steps: int = 15
    """Moves at most."""
    stop_gain: float | None = None
    """Stop before a command that promises less than this [nat, of theta and of what the outline
    prior misses; with --task: mean square of the tolerance 1 mm, 1 mm, 5 mrad]; a goal n steps
    away counts over the root of n."""
    task: Path | None = None
    """Episode whose motions are to be predicted: learn what they depend on."""
    stop_error: float | None = None
    """Stop once the task's poses are expected to be predicted this well [m]."""
    force_limit: float = 8.0
    """Largest force on an axis [N]."""
    force_probability: float = 0.05
    """A command that exceeds it with more than this probability is not taken."""
    step_limit: tuple[float, float, float] = (0.08, 0.08, 0.3)
    """Farthest a command may be from the last pose, on each axis [m, m, rad]."""
    workspace_low: tuple[float, float, float] = (-1.0, -1.0, -0.15)
    """Lower corner of the workspace of commands [m, m, rad]."""
    workspace_high: tuple[float, float, float] = (1.0, 1.0, 0.15)
    """Upper corner of the workspace [m, m, rad]."""
    model: Path | None = None
    """Model file with effects to estimate too, such as diagnose writes (tpcd/effects/README.md)."""
    estimator: Literal["default", "paper"] = "default"
    """`paper` is the particle filter of arXiv 2409.17470 for comparison."""
    seed: int = 0
    """Seed of all that is random."""
    resume: bool = False
    """Go on with a run in the folder that was stopped."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""

    def __post_init__(self) -> None:
        check_numbers(
            self,
            least={"steps": 1},
            above={"force_limit": 0.0, "stop_gain": 0.0, "stop_error": 0.0, "step_limit": 0.0},
            most={"stop_error": 0.1} | dict.fromkeys(EXTENTS, LARGEST_EXTENT),
        )
        check_resume(self)
        if self.stop_error is not None and self.task is None:
            raise ValueError("stop_error needs a task to predict; name an episode with --task")
        if self.model is not None and self.estimator == "paper":
            raise ValueError("the estimator paper has a model of its own; leave --model out")

    def check_policy(self, policy: str) -> None:
        """Refuse wishes that a policy cannot meet."""
        if self.stop_gain is not None and policy not in WEIGHING:
            raise ValueError(f"stop_gain needs a policy that weighs commands, not {policy}")
        if self.task is not None and self.stop_error is None and policy != "active":
            raise ValueError(f"a task changes nothing with {policy}; add stop_error, or use active")
