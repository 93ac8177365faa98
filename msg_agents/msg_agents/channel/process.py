# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The hosts of a channel and its process. Linux only.

A host is a network namespace with one TUN device, known by descriptors only: when the last process and descriptor of
one is gone, the kernel removes it with its device, whatever was killed.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import mmap
import os
import signal
import socket
import struct
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from msg_agents.channel.links import DEVICE, Forwarder, Link, LinkSettings, LossModel, Port
from msg_analysis.common.arrays import BoolArray
from msg_analysis.common.files import write_whole
from msg_analysis.errors import NotAvailableError

if TYPE_CHECKING:
    from msg_agents.channel.channel_file import Channel

TUN = "/dev/net/tun"
NETWORK = "10.77.0.0/16"  # in no other namespace: it disturbs no network of this machine
MASK = "255.255.0.0"
QUEUE_LENGTH = 10_000  # packets that the kernel keeps until the channel takes them
_CLONE_NEWNET = 0x40000000  # of linux/sched.h
_TUNSETIFF = 0x400454CA  # of linux/if_tun.h, like the flags of a device of IP packets without a header before them
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _SIOCSIFADDR = 0x8913, 0x8914, 0x8916  # of linux/sockios.h
_SIOCSIFNETMASK, _SIOCSIFMTU, _SIOCSIFTXQLEN = 0x891C, 0x8922, 0x8943
_IFF_UP = 1

REMEDY = (
    "run it as root, or in namespaces of your own: `unshare --user --map-root-user --net msg-agents run ...`; "
    "a container needs --cap-add NET_ADMIN,SYS_ADMIN and --device /dev/net/tun"
)
LARGEST_MESSAGE = 1 << 16  # bytes of a message that describes a host
PRIORITY = -10  # a delay is that of the link, not that of the scheduler


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
            # In a thread, which is then in the new namespace and ends: nothing else of this process moves.
            with ThreadPoolExecutor(1) as thread:
                made = thread.submit(_enter_new_host, host_address(index), mtu)
            try:
                hosts[name] = host = made.result()
            except OSError as error:
                raise NotAvailableError(f"--channel: {_reason(error)}: {REMEDY}") from error
            stack.callback(host.close)
        yield hosts


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
        fcntl.ioctl(opened[-1], _TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), _IFF_TUN | _IFF_NO_PI))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
            _set_up(control, b"lo")
            for request, value in ((_SIOCSIFADDR, address), (_SIOCSIFNETMASK, MASK)):
                place = struct.pack("16sHH4s8x", DEVICE.encode(), socket.AF_INET, 0, socket.inet_aton(value))
                fcntl.ioctl(control, request, place)
            fcntl.ioctl(control, _SIOCSIFMTU, struct.pack("16si20x", DEVICE.encode(), mtu))
            with suppress(PermissionError):  # in a user's own namespaces it stays at 500
                fcntl.ioctl(control, _SIOCSIFTXQLEN, struct.pack("16si20x", DEVICE.encode(), QUEUE_LENGTH))
            _set_up(control, DEVICE.encode())
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


_MODE = struct.Struct("<q")


class ActiveGraphFile:
    """The mode of the active graph, from 0; -1 before the first step, when every packet passes; and a byte per host."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), 0)

    @classmethod
    def create(cls, path: Path, hosts: int) -> Self:
        """Make the file: mode -1, no host is let through."""
        path.write_bytes(_MODE.pack(-1) + bytes(hosts))
        return cls(path)

    @property
    def mode(self) -> int:
        """The newest mode that was written."""
        return int(_MODE.unpack_from(self._map)[0])

    def set_mode(self, mode: int) -> None:
        """The graph with this mode is active now."""
        _MODE.pack_into(self._map, 0, mode)

    def lets_through(self, host: int) -> bool:
        """Whether all packets from and to a host, from 0, pass."""
        return bool(self._map[_MODE.size + host])

    def let_through(self, host: int, *, all_packets: bool) -> None:
        """Set whether they do."""
        self._map[_MODE.size + host] = all_packets


def hand_over(
    control: socket.socket,
    channel: Channel,
    hosts: Mapping[str, Host],
    counts: Path,  # file to write
    active_graph: Path | None,  # file to read, with ``joined``
    joined: BoolArray | None,
) -> None:
    """Give a new process of the channel its orders; afterwards the devices are its own."""
    orders = {
        "seed": channel.seed,
        "counts": str(counts),
        "active_graph": active_graph and str(active_graph),
        "joined": None if joined is None else joined.tolist(),
        "links": [[*pair, asdict(settings)] for pair, settings in channel.links.items()],
    }
    for name, host in hosts.items():
        message = json.dumps({"name": name, "address": host.address}).encode()
        socket.send_fds(control, [message], [host.device, host.statistics])
        host.close_device()
    file = counts.with_name("channel.json")
    file.write_text(json.dumps(orders), encoding="utf-8")
    control.send(json.dumps({"orders": str(file)}).encode())


def serve(descriptor: int) -> None:
    """Be the channel: ``descriptor`` is its end of the socket. Returns when the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run ends it, after all others
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    with socket.socket(fileno=descriptor) as control:
        received = _receive(control)
        if received is None:
            return
        ports, orders = received
        places = {port.name: place for place, port in enumerate(ports)}
        links = {}
        for sender, receiver, settings in orders["links"]:
            pair = places[sender], places[receiver]
            loss = LossModel(**settings["loss"])
            links[pair] = Link(LinkSettings(**settings | {"loss": loss}), orders["seed"], *pair)
        counts = Path(orders["counts"])

        def report(found: dict[str, Any]) -> None:
            with suppress(OSError):  # a full disk, or the run was killed and its folder is gone
                write_whole(counts, json.dumps(found).encode())

        Forwarder(ports, links, _gate(orders)).run(descriptor, report)


def _receive(control: socket.socket) -> tuple[list[Port], dict[str, Any]] | None:
    """The hosts, in order, and what to do; None if the run has ended meanwhile."""
    ports: list[Port] = []
    while True:
        message, descriptors, _, _ = socket.recv_fds(control, LARGEST_MESSAGE, 2)
        if not message:
            return None
        document = json.loads(message)
        if "orders" in document:
            return ports, json.loads(Path(document["orders"]).read_text(encoding="utf-8"))
        ports.append(Port(document["name"], socket.inet_aton(document["address"]), *descriptors))


def _gate(orders: dict[str, Any]) -> Callable[[int, int], bool]:
    """Whether packets from one host to another pass under the active graph."""
    if orders["joined"] is None:
        return lambda _sender, _receiver: True
    joined, active = orders["joined"], ActiveGraphFile(Path(orders["active_graph"]))

    def is_open(sender: int, receiver: int) -> bool:
        mode = active.mode
        return (
            mode < 0 or joined[mode][sender][receiver] or active.lets_through(sender) or active.lets_through(receiver)
        )

    return is_open
