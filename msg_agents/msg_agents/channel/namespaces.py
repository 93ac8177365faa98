# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Hosts on this machine: each a network namespace with one TUN device, known by descriptors only.

They have no names: when the last process and descriptor of one is gone, the kernel removes it with its device, whatever
was killed. Linux only.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import socket
import struct
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass

from msg_analysis.errors import NotAvailableError

DEVICE = b"channel"
TUN = "/dev/net/tun"
NETWORK = "10.77.0.0/16"  # in no other namespace: it disturbs no network of this machine
MASK = "255.255.0.0"
MOST_HOSTS = 250
WAITING_ROOM = 10_000  # packets that the kernel keeps until the channel takes them
_CLONE_NEWNET = 0x40000000  # of linux/sched.h
_TUNSETIFF = 0x400454CA  # of linux/if_tun.h, like the flags of a device of IP packets without a header before them
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _SIOCSIFADDR = 0x8913, 0x8914, 0x8916  # of linux/sockios.h
_SIOCSIFNETMASK, _SIOCSIFMTU, _SIOCSIFTXQLEN = 0x891C, 0x8922, 0x8943
_IFF_UP = 1

WHAT_TO_DO = (
    "run it as root, or in namespaces of your own: `unshare --user --map-root-user --net msg-agents run ...`; "
    "a container needs --cap-add NET_ADMIN,SYS_ADMIN and --device /dev/net/tun"
)


@dataclass(slots=True)
class Host:
    """A host, by descriptors; -1: closed."""

    address: str
    namespace: int  # to be entered by its processes
    device: int  # IP packets from and to the host
    statistics: int  # /proc/net/dev of the host

    def close_device(self) -> None:
        """Leave the device to the process that has a copy of it."""
        for descriptor in (self.device, self.statistics):
            if descriptor >= 0:
                os.close(descriptor)
        self.device = self.statistics = -1

    def close(self) -> None:
        """Close all; the host is gone when no process is on it."""
        self.close_device()
        os.close(self.namespace)


def host_address(index: int) -> str:
    """The IPv4 address of a host, from 0."""
    return f"10.77.0.{index + 1}"


@contextmanager
def open_hosts(names: Sequence[str], mtu: int) -> Iterator[dict[str, Host]]:
    """Make hosts; at the end, this process closes its descriptors. NotAvailableError: rights are missing, or TUN is."""
    with ExitStack() as stack:
        hosts = {}
        for index, name in enumerate(names):
            hosts[name] = host = _make_host(host_address(index), mtu)
            stack.callback(host.close)
        yield hosts


def _make_host(address: str, mtu: int) -> Host:
    """In a thread, which is then in the new namespace and ends: nothing else of this process moves."""
    made: list[Host] = []
    failed: list[OSError] = []

    def make() -> None:
        try:
            made.append(_enter_new_host(address, mtu))
        except OSError as error:
            failed.append(error)

    thread = threading.Thread(target=make, name="host")
    thread.start()
    thread.join()
    if failed:
        raise NotAvailableError(f"--channel: {_reason(failed[0])}: {WHAT_TO_DO}") from failed[0]
    return made[0]


def _reason(error: OSError) -> str:
    text = error.strerror or str(error)
    if sys.platform != "linux":
        return "network namespaces exist on Linux only"
    if error.filename == TUN:
        return f"{TUN}: cannot be opened ({text})"
    if error.errno in (errno.EPERM, errno.EACCES):
        return f"no right to make network namespaces and TUN devices ({text})"
    return f"network namespaces or TUN devices cannot be made ({text})"


def _enter_new_host(address: str, mtu: int) -> Host:
    """Move this thread into a new namespace, and set its devices up."""
    _call("unshare", _CLONE_NEWNET)
    opened = []
    try:
        opened.append(os.open(TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC))
        fcntl.ioctl(opened[-1], _TUNSETIFF, struct.pack("16sH22x", DEVICE, _IFF_TUN | _IFF_NO_PI))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
            _set_up(control, b"lo")
            for request, value in ((_SIOCSIFADDR, address), (_SIOCSIFNETMASK, MASK)):
                place = struct.pack("16sHH4s8x", DEVICE, socket.AF_INET, 0, socket.inet_aton(value))
                fcntl.ioctl(control, request, place)
            fcntl.ioctl(control, _SIOCSIFMTU, struct.pack("16si20x", DEVICE, mtu))
            with suppress(PermissionError):  # in a user's own namespaces it stays at 500
                fcntl.ioctl(control, _SIOCSIFTXQLEN, struct.pack("16si20x", DEVICE, WAITING_ROOM))
            _set_up(control, DEVICE)
        for file in ("ns/net", "net/dev"):
            opened.append(os.open(f"/proc/thread-self/{file}", os.O_RDONLY | os.O_CLOEXEC))
    except OSError:
        for descriptor in opened:
            os.close(descriptor)
        raise
    device, namespace, statistics = opened
    return Host(address, namespace, device, statistics)


def _set_up(control: socket.socket, device: bytes) -> None:
    found = fcntl.ioctl(control, _SIOCGIFFLAGS, struct.pack("16sH22x", device, 0))
    flags = struct.unpack("16sH22x", found)[1]
    fcntl.ioctl(control, _SIOCSIFFLAGS, struct.pack("16sH22x", device, flags | _IFF_UP))


def _call(function: str, *arguments: int) -> None:
    """Call the C library."""
    if sys.platform != "linux":
        raise OSError(errno.ENOSYS, "not on this system")
    if getattr(ctypes.CDLL(None, use_errno=True), function)(*arguments):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def enter(namespace: int) -> None:
    """Move this process into the network namespace of a descriptor; before it has any thread that uses sockets."""
    _call("setns", namespace, _CLONE_NEWNET)
    os.close(namespace)


def device_overflow(statistics: int) -> int:
    """Packets that a host's device has dropped, since the channel did not take them in time."""
    os.lseek(statistics, 0, os.SEEK_SET)
    for line in os.read(statistics, 1 << 16).decode().splitlines():
        name, _, numbers = line.partition(":")
        if name.strip() == DEVICE.decode():
            return int(numbers.split()[11])  # of the fields of transmission: bytes, packets, errs, drop
    return 0
