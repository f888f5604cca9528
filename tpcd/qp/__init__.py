"""Batched contact quadratic programs: one problem record, one solution record, three engines."""

from tpcd.qp.problem import ContactQP as ContactQP
from tpcd.qp.problem import QPSolution as QPSolution
from tpcd.qp.problem import Status as Status
from tpcd.qp.solve import ENGINES as ENGINES
from tpcd.qp.solve import native_available as native_available
from tpcd.qp.solve import solve as solve
