"""What a process does at its start: enter other namespaces, or make some of its own in which something is wrong."""

import contextlib
import ctypes
import resource
from pathlib import Path

CLONE_NEWNS, CLONE_NEWUSER, CLONE_NEWNET = 0x20000, 0x10000000, 0x40000000  # linux/sched.h
MS_REC, MS_PRIVATE = 1 << 14, 1 << 18  # linux/mount.h
CAPABILITY_VERSION = 0x20080522  # linux/capability.h: the third, with two words of each set
ROOM = 2**16  # bytes


def enter_network(name: Path) -> None:
    """As ``ip netns exec`` does it."""
    with name.open() as file:
        _done("setns", file.fileno(), CLONE_NEWNET)


def give_up_rights() -> None:
    """As ``unshare --user`` does it: no user outside is one of the namespace: no rights after an exec."""
    header, none = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    _done("unshare", CLONE_NEWUSER)
    _done("capset", header, none)


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


def some_descriptors() -> None:
    """Enough for a run, but not for a large one."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))


def few_descriptors() -> None:
    """Too few for two processes of a network."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (16, 16))


def _done(function: str, *arguments: object) -> None:
    if getattr(ctypes.CDLL(None, use_errno=True), function)(*arguments):
        raise OSError(ctypes.get_errno(), function)
