"""What motions excite: names, how much of each an effect needs, and the motion that gives it."""

from __future__ import annotations

NEEDED: dict[str, float] = {
    "free motion": 2,
    "pause": 1,
    "lift-off": 1,
    "floor load": 3,
    "floor loads": 1.8,
    "floor places": 0.03,
    "floor slip": 2,
    "floor slip both ways": 1,
    "floor stick": 1,
    "wall load": 3,
    "wall loads": 1.8,
    "wall places": 0.02,
    "wall slip": 2,
}
"""How much of each excitation is needed: rows, the ratio of largest to smallest load, or how
far apart the places are [m]."""
UNITS: dict[str, str] = dict.fromkeys(NEEDED, "rows") | {
    "floor loads": "1",
    "floor places": "m",
    "wall loads": "1",
    "wall places": "m",
}
"""What each excitation is counted in: rows, 1 for a ratio, m for a distance."""
MOTIONS: dict[str, str] = {
    "free motion": "move 20 mm or more in free space, both ways on each axis",
    "pause": "command the same pose twice",
    "lift-off": "lift off the floor and touch it again",
    "floor load": "press on the floor",
    "floor loads": "press on one spot of the floor with 1.5, 3.5 and 6 N",
    "floor places": "press on the floor at three places at least 30 mm apart",
    "floor slip": "slide along the floor by 20 mm",
    "floor slip both ways": "slide along the floor to the right and back to the left",
    "floor stick": "press on the floor and push sideways without sliding",
    "wall load": "press against the wall",
    "wall loads": "press on one spot of the wall with 1.5, 3.5 and 6 N",
    "wall places": "press against the wall at heights at least 20 mm apart",
    "wall slip": "slide up and down along the wall at one load",
}
"""The motion that gives each excitation."""
