"""Batched contact quadratic programs: one problem record, one solution record, two backends."""

from tpcd.qp.problem import ContactQP as ContactQP
from tpcd.qp.problem import QPSolution as QPSolution
from tpcd.qp.problem import Status as Status
from tpcd.qp.solve import BACKENDS as BACKENDS
from tpcd.qp.solve import solve as solve
