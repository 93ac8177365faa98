"""What tests have workers do: in a module that imports little, since each worker imports it."""

import os
import signal
import time
from typing import Any

import psutil


def cubes(number: int, _stopping: Any) -> int:
    if number == 13:
        os.kill(os.getpid(), 9)
    return number**3


def sockets(_item: int, _stopping: Any) -> list[Any]:
    return [each.laddr for each in psutil.Process().net_connections("all")]


def much_memory(size: int, _stopping: Any) -> int:
    return len(bytearray(size))


def first_last(item: int, _: Any) -> int:
    time.sleep(0.0 if item else 0.3)
    return item**3


def killed_by_the_third(item: int, _: Any) -> int:
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return item
