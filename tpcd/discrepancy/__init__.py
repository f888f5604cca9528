"""The gap workflow: where simulation and measurement disagree, and what is missing.

`diagnose` in `search` runs all of it; nothing heavy is imported here.
"""
