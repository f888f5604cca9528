"""Steps whose contact problems another QP backend solves, round by round.

The compiled loops run until they meet a problem whose solution they do not know, and leave it. The
problems of all elements are solved together, on the device of the step's tensors, and the loops run
again from the start, as far as the next problem. So every backend solves the same rows in the same
order, and nothing else is different; what it gets wrong shows in the residual of the answer.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from tpcd.qp import ContactQP, solve
from tpcd.simulator.workspace import LIST, Tape

_FIRST = 16
"""Problems for which a tape has room at first; it doubles."""


def no_tape(loaded: int) -> Tape:
    """That of loops that solve their problems themselves, with so many loaded rows."""
    shapes = ((0, 0, loaded), (0, 0, 1))
    whole = (np.zeros((0, 0), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))
    rest = (np.zeros((0, 0, loaded)), np.zeros((0, 0)))
    return Tape(*(np.zeros(shape) for shape in shapes), *whole, *rest)


def solved_by(
    backend: str,
    run: Callable[[Tape], None],
    wanted: Bool[np.ndarray, " b"],
    loaded: int,
    terrains: int,
    device: torch.device,
) -> None:
    """Call `run` until all elements that are wanted have an answer; so many rows bear load at most.

    `run` evaluates the elements that are wanted, with the solutions on the tape. Raises SolverError
    where the backend is not installed.
    """
    if backend == "native":
        run(no_tape(loaded))
        return
    count, width = len(wanted), 2 * terrains * LIST
    tape = Tape(
        np.zeros((count, _FIRST, loaded)),
        np.zeros((count, _FIRST, width)),
        np.zeros((count, _FIRST), np.int64),
        np.zeros(count, np.int64),
        wanted.astype(np.int64),
        np.zeros((count, width, loaded)),
        np.zeros((count, width)),
    )
    while True:
        run(tape)
        waiting = np.flatnonzero(tape.wanted)
        if len(waiting) == 0:
            return
        at = tape.known[waiting]
        if int(at.max()) == tape.motion.shape[1]:
            tape = _longer(tape)
        solution = solve(_problem(tape, waiting, device), backend, elastic=False)
        tape.motion[waiting, at] = _numbers(solution.motion)
        tape.multipliers[waiting, at] = _numbers(solution.multipliers)
        tape.status[waiting, at] = solution.status.cpu().numpy()
        tape.known[waiting] += 1


def _problem(tape: Tape, waiting: np.ndarray, device: torch.device) -> ContactQP:
    rows, values = (torch.from_numpy(part[waiting]).to(device) for part in (tape.rows, tape.values))
    real = np.arange(tape.rows.shape[1]) < tape.wanted[waiting, None]
    return ContactQP(
        hessian=torch.eye(rows.shape[-1], dtype=rows.dtype, device=device),
        target=torch.zeros_like(rows[:, 0]),
        rows=rows,
        offsets=values,
        row_mask=torch.from_numpy(real).to(device),
    )


def _numbers(values: Tensor) -> np.ndarray:
    return values.nan_to_num(0.0).cpu().numpy()


def _longer(tape: Tape) -> Tape:
    """The same with room for twice as many problems."""
    parts = (tape.motion, tape.multipliers, tape.status)
    longer = [np.concatenate((part, np.zeros_like(part)), axis=1) for part in parts]
    return Tape(*longer, *tape[3:])
