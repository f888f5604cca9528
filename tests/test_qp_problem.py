"""What the door of the contact problems accepts and refuses."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

import pytest
import torch

from tpcd.errors import SolverError
from tpcd.qp import ContactQP, Status, solve
from tpcd.qp.problem import check_problem, select


def problem(batch: tuple[int, ...] = (2,), m: int = 4, n: int = 3) -> ContactQP:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    return ContactQP(torch.eye(n, dtype=torch.float64), draw(n), draw(m, n), draw(m))


def unchecked(given: ContactQP, **changes: object) -> ContactQP:
    """A record that got past the type checks of the tests, as in a user's session."""
    changed = object.__new__(ContactQP)
    for name in ("hessian", "target", "rows", "offsets", "compliance", "row_mask"):
        object.__setattr__(changed, name, changes.get(name, getattr(given, name)))
    return changed


def test_a_consistent_problem_passes():
    check_problem(problem())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rows", torch.zeros(2, 4, 2, dtype=torch.float64)),
        ("offsets", torch.zeros(2, 3, dtype=torch.float64)),
        ("compliance", torch.zeros(4, dtype=torch.float64)),
        ("row_mask", torch.ones(2, 5, dtype=torch.bool)),
        ("hessian", torch.eye(2, dtype=torch.float64)),
        ("hessian", torch.eye(3, dtype=torch.float64).expand(5, 3, 3)),
        ("hessian", torch.eye(3, dtype=torch.float64).expand(1, 2, 3, 3)),
    ],
)
def test_a_wrong_shape_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=f"^{field} has shape .*expected"):
        check_problem(unchecked(problem(), **{field: value}))


def test_mixed_dtypes_are_refused():
    with pytest.raises(TypeError, match="one dtype"):
        check_problem(unchecked(problem(), offsets=torch.zeros(2, 4)))


def test_integers_and_half_precision_are_refused():
    with pytest.raises(TypeError, match="expected float32 or float64"):
        check_problem(unchecked(problem(), target=torch.zeros(2, 3, dtype=torch.int64)))
    with pytest.raises(TypeError, match="expected float32 or float64"):
        check_problem(unchecked(problem(), target=torch.zeros(2, 3, dtype=torch.float16)))


def test_a_mask_that_is_not_boolean_is_refused():
    with pytest.raises(TypeError, match="expected bool"):
        check_problem(unchecked(problem(), row_mask=torch.ones(2, 4)))


def test_a_problem_without_variables_is_refused():
    with pytest.raises(ValueError, match="no variables"):
        check_problem(problem(n=0))


def test_two_devices_are_refused():
    with pytest.raises(ValueError, match="one device"):
        check_problem(unchecked(problem(), offsets=torch.zeros(2, 4, device="meta").double()))


def test_an_unknown_backend_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="native, qpth"):
        solve(problem(), "osqp")


def test_a_missing_backend_says_how_to_get_it(monkeypatch):
    def find_nothing(name: str) -> None:
        return None

    monkeypatch.setattr(import_module("tpcd.qp.qpth_backend"), "find_spec", find_nothing)
    with pytest.raises(SolverError, match=r"tpcd\[qpth\]"):
        solve(problem(), "qpth")
    assert solve(problem()).solved.all()


def test_every_status_has_its_own_sentence():
    sentences = [status.sentence for status in Status]
    assert len(set(sentences)) == len(Status)
    assert all(sentence.endswith(".") and len(sentence) > 20 for sentence in sentences)
    assert Status(0) is Status.SOLVED
    assert [int(status) for status in Status] == [0, 1, 2, 3, 4]


def test_selected_elements_are_the_same_problems():
    whole = problem((2, 3))
    whole = replace(
        whole,
        hessian=torch.eye(3, dtype=torch.float64).expand(3, 3, 3),
        compliance=torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(1)).double(),
        row_mask=torch.ones(2, 3, 4, dtype=torch.bool),
    )
    chosen = torch.tensor([True, False, False, True, False, True])
    part = select(whole, chosen)
    assert part.batch_shape == (3,)
    expected = solve(whole).motion.reshape(6, 3)[chosen]
    torch.testing.assert_close(solve(part).motion, expected, rtol=0, atol=0)
