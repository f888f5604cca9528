"""Arms that explore: the protocol, and one in simulation."""

from tpcd.robot.protocol import Reading, Robot
from tpcd.robot.simulated import SimulatedRobot

__all__ = ["Reading", "Robot", "SimulatedRobot"]
