"""What a process does at its start to be in another namespace."""

import ctypes
from pathlib import Path

CLONE_NEWUSER, CLONE_NEWNET = 0x10000000, 0x40000000  # linux/sched.h
CAPABILITY_VERSION = 0x20080522  # linux/capability.h: the third, with two words of each set


def give_up_rights() -> None:
    """As ``unshare --user`` does it: no user outside is one of the namespace: no rights after an exec."""
    libc = ctypes.CDLL(None, use_errno=True)
    header, none = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)()
    if libc.unshare(CLONE_NEWUSER) or libc.capset(header, none):
        raise OSError(ctypes.get_errno(), "no user namespace")


def enter_network(name: Path) -> None:
    """As ``ip netns exec`` does it."""
    with name.open() as file:
        if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")
