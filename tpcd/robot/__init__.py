"""Arms that explore: the protocol, one in simulation, and `tpcd.robot.ur` for real ones.

Nothing is imported here, so that commands can read the settings of an arm at once.
"""
