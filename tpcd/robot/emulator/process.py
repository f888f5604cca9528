"""An emulator in a process of its own.

The client holds Python's interpreter lock while it waits for an answer, so that an emulator in the
same process could never give it.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from tpcd.errors import RobotError
from tpcd.robot.emulator.settings import EmulatorSettings

START_TIME = 60.0
"""Longest time to start, imports included [s]."""


@contextmanager
def running_emulator(settings: EmulatorSettings) -> Iterator[BaseProcess]:
    """An emulator that listens on its address, and is ended with the block.

    Raises RobotError where it does not start.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(settings, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        problem = ours.recv() if ours.poll(START_TIME) else "it did not start in time"
    except EOFError:
        problem = "its process ended"
    try:
        if problem:
            raise RobotError(f"no emulator on {settings.address}: {problem}")
        yield process
    finally:
        ours.close()
        process.join(5.0)
        if process.is_alive():
            process.kill()
            process.join()


def _serve(settings: EmulatorSettings, parent: Connection) -> None:
    import torch

    from tpcd.robot.emulator.server import Server

    # Ctrl-C is for the program that started it, which ends this one by its pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    try:
        server = Server(settings)
    except (RobotError, ValueError) as error:
        parent.send(str(error))
        return
    parent.send("")
    server.run(until=parent.poll)
