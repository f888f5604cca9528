"""RTDE protocol version 2 on the side of the controller: packages in and out.

A package is a big-endian size (2 bytes, header included), a type (1 byte) and a payload, after
Universal Robots, Real-Time Data Exchange (RTDE) guide. The fields known here are those that
ur_rtde asks for and those that the arm of this project reads.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

HEADER = struct.Struct(">HB")
REQUEST_VERSION, GET_CONTROL_VERSION = ord("V"), ord("v")
SETUP_OUTPUTS, SETUP_INPUTS = ord("O"), ord("I")
START, PAUSE, DATA = ord("S"), ord("P"), ord("U")
CONTROL_VERSION = (5, 11, 1, 0)

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
OUTPUTS = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "target_TCP_pose": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "safety_status": "INT32",
    "runtime_state": "UINT32",
    "speed_scaling": "DOUBLE",
    "payload": "DOUBLE",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
}


def field_type(name: str) -> str:
    """RTDE type of an output or input field; NOT_FOUND for unknown ones."""
    for kind, marker in (("INT32", "_int_register_"), ("DOUBLE", "_double_register_")):
        if marker in name and name.rsplit("_", 1)[-1].isdigit():
            return kind
    further = {"speed_slider_mask": "UINT32", "speed_slider_fraction": "DOUBLE"}
    digital = ("standard_digital", "configurable_digital", "tool_digital", "standard_analog")
    if name in further:
        return further[name]
    if name.startswith(digital):
        return "DOUBLE" if name[-1].isdigit() else "UINT8"
    return OUTPUTS.get(name, "NOT_FOUND")


@dataclass(frozen=True)
class Recipe:
    """The fields of a package in their order."""

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]

    @property
    def packing(self) -> struct.Struct:
        """How the values lie in the package, after the number of the recipe."""
        return struct.Struct(">" + "".join(FORMATS[kind] for kind in self.types))

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """The data package of these values; registers never written are zero."""
        flat: list[Any] = []
        for name, kind in zip(self.names, self.types, strict=True):
            value = values.get(name, 0)
            count = int(FORMATS[kind][0]) if FORMATS[kind][0].isdigit() else 1
            if count > 1:
                flat.extend(value if value != 0 else (0,) * count)
            else:
                flat.append(float(value) if kind == "DOUBLE" else int(value))
        return package(DATA, bytes([self.number]) + self.packing.pack(*flat))

    def decode(self, payload: bytes) -> dict[str, Any]:
        """The values of a data package without its first byte; scalars only."""
        return dict(zip(self.names, self.packing.unpack(payload), strict=True))


def package(kind: int, payload: bytes) -> bytes:
    """A package with its header."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def split_packages(buffer: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """The whole packages at the front of what was received, and the rest."""
    packages = []
    while len(buffer) >= HEADER.size:
        size, kind = HEADER.unpack_from(buffer)
        if size < HEADER.size or len(buffer) < size:
            break
        packages.append((kind, buffer[HEADER.size : size]))
        buffer = buffer[size:]
    return packages, buffer
