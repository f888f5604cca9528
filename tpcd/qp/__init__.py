"""Batched contact quadratic programs: one problem record, one solution record, three engines."""
