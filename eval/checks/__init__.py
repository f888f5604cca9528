"""How often checks of recordings are right, and whether the simulator's good answers are."""
