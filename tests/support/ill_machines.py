"""Machines on which something is wrong: words before a command that then runs on one, in namespaces of its own."""

import contextlib
import ctypes
import os
import resource
import sys
from pathlib import Path

CLONE_NEWNS, CLONE_NEWNET = 0x20000, 0x40000000  # linux/sched.h
MS_REC, MS_PRIVATE = 1 << 14, 1 << 18  # linux/mount.h
ROOM = 2**16  # bytes

_PROGRAM = (sys.executable, "-P", __file__)
FULL_SHARED_MEMORY = (*_PROGRAM, "full_shared_memory")
NO_LOOPBACK = (*_PROGRAM, "no_loopback")
FEW_DESCRIPTORS = (*_PROGRAM, "few_descriptors")


def full_shared_memory() -> None:
    _done("unshare", CLONE_NEWNS)
    _done("mount", b"none", b"/", None, MS_REC | MS_PRIVATE, None)  # what is mounted here is mounted here only
    _done("mount", b"none", b"/dev/shm", b"tmpfs", 0, f"size={ROOM}".encode())
    with contextlib.suppress(OSError), Path("/dev/shm/full").open("wb", buffering=0) as file:
        while file.write(bytes(ROOM)):
            pass


def no_loopback() -> None:
    """An interface that is down is there."""
    _done("unshare", CLONE_NEWNET)


def few_descriptors() -> None:
    """Too few for two processes of a network."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (16, 16))


def _done(function: str, *arguments: int | bytes | None) -> None:
    if getattr(ctypes.CDLL(None, use_errno=True), function)(*arguments):
        raise OSError(ctypes.get_errno(), function)


if __name__ == "__main__":
    {function.__name__: function for function in (full_shared_memory, no_loopback, few_descriptors)}[sys.argv[1]]()
    os.execv(sys.argv[2], sys.argv[2:])
