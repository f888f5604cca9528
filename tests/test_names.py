"""Names that options repeat, as they are read before anything slow is imported, are one set."""

from __future__ import annotations

from inspect import unwrap
from typing import get_args, get_type_hints

import pytest
from command_calls import load_script

from eval.table.pages import POLICIES
from tpcd.commands.exploring_options import WEIGHING
from tpcd.policies.named import PolicyName, make_policy
from tpcd.qp.solve import BACKENDS
from tpcd.simulator import StepSettings

NAMES = set(get_args(PolicyName))


def choices(script: str, record: str, field: str) -> set[str]:
    return set(get_args(get_type_hints(getattr(load_script(script), record))[field]))


def test_policies_have_the_same_names_everywhere() -> None:
    assert choices("explore", "Exploration", "policy") == NAMES
    assert choices("robot", "Experiment", "policy") == NAMES | {"file"}
    assert set(POLICIES) == NAMES >= set(WEIGHING)


def test_solvers_have_the_same_names_everywhere() -> None:
    assert set(get_args(get_type_hints(StepSettings)["solver"])) == set(BACKENDS)
    assert choices("estimate", "Estimate", "solver") == set(BACKENDS)


def test_another_name_is_no_policy() -> None:
    with pytest.raises(ValueError, match="policy is 'gird', expected one of active, lookahead"):
        unwrap(make_policy)("gird", None, None, 0)  # type: ignore[arg-type]
