"""The controller's ports on a loopback address: dashboard, script upload, RTDE.

One thread serves all of them and lets the controller's time go on, so that nothing is shared.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from tpcd.errors import RobotError
from tpcd.robot.emulator import protocol
from tpcd.robot.emulator.controller import STEP, Controller
from tpcd.robot.emulator.settings import EmulatorSettings

DASHBOARD, SCRIPT, RTDE = 29999, 30003, 30004
FREQUENCY = round(1 / STEP)
PATIENCE = 0.004
"""At the client's pace, real time without a servo target after which time goes on all the same,
cycle by cycle [s]."""
LONGEST_CATCH_UP = 0.1
"""Real time that is made up for after a pause of this process; the rest is dropped [s]."""


@dataclass
class Connection:
    """One client of one port, and what it asked for."""

    socket: socket.socket
    port: int
    received: bytes = b""
    output: protocol.Recipe | None = None
    every: int = 1
    """Cycles between two packages."""
    inputs: dict[int, protocol.Recipe] = field(default_factory=dict)
    started: bool = False


class Server:
    """Emulated controller behind sockets."""

    def __init__(self, settings: EmulatorSettings) -> None:
        """Listen; raises RobotError where the address cannot be had."""
        self._controller, self._settings = Controller(settings), settings
        self._selector = selectors.DefaultSelector()
        self._connections: list[Connection] = []
        self._cycle, self._served = 0, False
        for port in (DASHBOARD, SCRIPT, RTDE):
            listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                listener.bind((settings.address, port))
            except OSError as error:
                raise RobotError(
                    f"cannot listen on {settings.address}:{port} ({error.strerror}); name another"
                    " address 127.0.0.x, or end the emulator that runs there"
                ) from error
            listener.listen()
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ, port)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until told to end."""
        last = time.monotonic()
        while not until():
            step = PATIENCE if self._at_client_pace else STEP
            ready = self._selector.select(max(0.0, last + step - time.monotonic()))
            targets = sum(self._handle(key) for key, _ in ready)
            now = time.monotonic()
            if self._at_client_pace and targets:
                for _ in range(self._coarsest()):
                    self._advance()
                last = now
            elif now - last >= step:
                last = max(last, now - LONGEST_CATCH_UP)
                while now - last >= step:
                    self._advance()
                    last += step

    @property
    def _at_client_pace(self) -> bool:
        return self._settings.pace == "client" and self._controller.servoing

    def _coarsest(self) -> int:
        return max((c.every for c in self._connections if c.started), default=1)

    def _advance(self) -> None:
        controller = self._controller
        controller.advance()
        self._cycle += 1
        if controller.is_due("killed_controller"):
            os._exit(1)
        if controller.is_due("frozen_link"):
            return
        due = [c for c in self._connections if c.started and self._cycle % c.every == 0]
        if not due:
            return
        values = controller.outputs()
        for connection in due:
            assert connection.output is not None
            self._send(connection, connection.output.encode(values))

    def _handle(self, key: selectors.SelectorKey) -> int:
        """Take what a socket has; returns how many servo targets came."""
        if isinstance(key.data, int):
            client, _ = key.fileobj.accept()  # type: ignore[union-attr]
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection = Connection(client, key.data)
            self._connections.append(connection)
            self._selector.register(client, selectors.EVENT_READ, connection)
            if key.data == DASHBOARD:
                self._send(connection, b"Connected: Universal Robots Dashboard Server\n")
            return 0
        connection: Connection = key.data
        try:
            data = connection.socket.recv(65536)
        except OSError:
            data = b""
        if not data:
            self._drop(connection)
            return 0
        if self._controller.is_due("frozen_link"):
            return 0
        connection.received += data
        try:
            return self._understood(connection)
        except (ValueError, LookupError, ArithmeticError, struct.error) as error:
            told = f"closing a connection to port {connection.port} that sent what is no message"
            print(f"warning: {told} ({error})", file=sys.stderr, flush=True)
            self._drop(connection)
            return 0

    def _understood(self, connection: Connection) -> int:
        """Take the whole messages of what was received; returns how many servo targets came."""
        if connection.port == RTDE:
            return self._handle_rtde(connection)
        if connection.port == DASHBOARD:
            self._handle_dashboard(connection)
        elif connection.received.rstrip().endswith(b"end"):
            connection.received = b""
            self._controller.upload()
        return 0

    def _handle_dashboard(self, connection: Connection) -> None:
        *lines, connection.received = connection.received.split(b"\n")
        for line in lines:
            answer = self._dashboard_answer(line.decode("ascii", "replace").strip().lower())
            self._send(connection, answer.encode() + b"\n")

    def _dashboard_answer(self, request: str) -> str:
        controller = self._controller
        local = self._settings.fault == "local_control"
        if request == "stop":
            controller.stop_program()
            return "Stopped"
        if request == "unlock protective stop":
            controller.unlock()
            return "Protective stop releasing"
        answers = {
            "polyscopeversion": "URSoftware 5.11.1.108318 (emulated)",
            "is in remote control": str(not local).lower(),
            "running": f"Program running: {str(controller.running).lower()}",
            "programstate": f"{'PLAYING' if controller.running else 'STOPPED'} script",
            "robotmode": "Robotmode: RUNNING",
            "safetystatus": "Safetystatus: "
            + ("PROTECTIVE_STOP" if controller.protective_stopped else "NORMAL"),
            "get robot model": "UR5",
            "get serial number": "00000000",
            "close popup": "closing popup",
            "close safety popup": "closing safety popup",
        }
        return answers.get(request, f"could not understand: '{request}'")

    def _handle_rtde(self, connection: Connection) -> int:
        packages, connection.received = protocol.split_packages(connection.received)
        targets = 0
        for kind, payload in packages:
            if kind == protocol.DATA:
                recipe = connection.inputs.get(payload[0])
                if recipe is not None:
                    targets += self._controller.write(recipe.decode(payload[1:]))
            else:
                answer = self._setup(connection, kind, payload)
                self._send(connection, protocol.package(kind, answer))
        return targets

    def _setup(self, connection: Connection, kind: int, payload: bytes) -> bytes:
        if kind == protocol.REQUEST_VERSION:
            return bytes([int(payload == b"\x00\x02")])
        if kind == protocol.GET_CONTROL_VERSION:
            return struct.pack(">4I", *protocol.CONTROL_VERSION)
        if kind in (protocol.START, protocol.PAUSE):
            connection.started = kind == protocol.START and connection.output is not None
            return b"\x01"
        if kind == protocol.SETUP_OUTPUTS:
            (frequency,) = struct.unpack_from(">d", payload)
            connection.every = max(1, round(FREQUENCY / frequency))
            recipe = _recipe(1, payload[8:])
            connection.output = recipe if "NOT_FOUND" not in recipe.types else None
        elif kind == protocol.SETUP_INPUTS:
            recipe = _recipe(len(connection.inputs) + 1, payload)
            others = (one for one in self._connections if one is not connection)
            taken = {
                name for one in others for other in one.inputs.values() for name in other.names
            }
            if self._settings.fault == "register_in_use" or taken.intersection(recipe.names):
                types = ("IN_USE", *recipe.types[1:])
                return b"\x00" + ",".join(types).encode()
            connection.inputs[recipe.number] = recipe
        else:
            return b""
        return bytes([recipe.number]) + ",".join(recipe.types).encode()

    def _send(self, connection: Connection, data: bytes) -> None:
        try:
            connection.socket.sendall(data)
        except OSError:
            self._drop(connection)

    def _drop(self, connection: Connection) -> None:
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(connection.socket)
        connection.socket.close()
        connection.started = False
        if connection in self._connections:
            self._connections.remove(connection)


def _recipe(number: int, names: bytes) -> protocol.Recipe:
    fields = tuple(name for name in names.decode("ascii").split(",") if name)
    return protocol.Recipe(number, fields, tuple(protocol.field_type(name) for name in fields))
