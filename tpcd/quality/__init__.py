"""What a recording tells of itself before it is believed: clocks, channels, units, arm, sensor."""
