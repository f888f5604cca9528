"""Arms that explore: the protocol, one in simulation, and `tpcd.robot.ur` for real ones."""

from tpcd.robot.protocol import Reading, Robot
from tpcd.robot.simulated import SimulatedRobot

__all__ = ["Reading", "Robot", "SimulatedRobot"]
