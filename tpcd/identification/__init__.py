"""What a recording tells of arm and sensor: load, stiffness, biases, friction, lags."""
