"""A container engine: one that already runs, or Debian's, started for as long as it is needed.

Debian's engine (packages docker.io and containerd) needs root, but no rights over the network of the host: it gets no
default bridge and leaves the packet filter alone. Bridges that a user defines work all the same.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

START = 60.0  # s for a daemon to answer, or to end


class Engine:
    """A running engine.

    Parameters
    ----------
    address : of its socket; None for the client's default
    """

    def __init__(self, address: str | None = None) -> None:
        self.environment = os.environ | {"DOCKER_BUILDKIT": "1"} | ({"DOCKER_HOST": address} if address else {})

    def __call__(
        self, *words: str | Path, client: str = "docker", check: bool = True, stdin: IO[bytes] | None = None
    ) -> str:
        """Run a command of the client; what it printed on stdout."""
        command = [client, *map(str, words)]
        done = subprocess.run(command, env=self.environment, check=check, stdin=stdin, stdout=subprocess.PIPE)
        return done.stdout.decode().strip()

    def answers(self) -> bool:
        """Whether a client reaches it."""
        command = ["docker", "version"]
        return subprocess.run(command, env=self.environment, capture_output=True).returncode == 0

    def build(self, *words: str | Path) -> None:
        """``docker build`` with BuildKit; where there is no default bridge, steps have the network of the host."""
        bridge = "bridge" in self("network", "ls", "--format", "{{.Name}}").split()
        self("build", *(() if bridge else ("--network", "host")), *words, client=builder())


def builder() -> str:
    """A client with BuildKit: up to version 22 it is part of the client, later it is the component buildx."""
    clients = [client for client in (shutil.which("docker"), "/usr/bin/docker") if client and Path(client).exists()]
    for client in clients:
        version = re.search(r"version (\d+)", subprocess.check_output([client, "--version"], text=True))
        buildx = subprocess.run([client, "buildx", "version"], capture_output=True).returncode == 0
        if buildx or (version and int(version[1]) < 23):
            return client
    sys.exit(f"error: {' '.join(clients)}: cannot build with BuildKit: install buildx")


@contextlib.contextmanager
def engine(folder: Path) -> Iterator[Engine | None]:
    """The running engine, or Debian's with its data in a folder; None, with a note, where neither is to be had."""
    if shutil.which("docker") and Engine().answers():
        yield Engine()
    elif os.geteuid() != 0 or not shutil.which("docker") or not shutil.which("dockerd"):
        print("no container engine runs here, nor can be started (root; apt-get install docker.io)", file=sys.stderr)
        yield None
    else:
        with debian_engine(folder) as started:
            yield started


@contextlib.contextmanager
def debian_engine(folder: Path) -> Iterator[Engine | None]:
    """Debian's engine; None, with a note, if it does not start."""
    # The path of a socket is at most 107 bytes long.
    with tempfile.TemporaryDirectory(prefix="msg_agents_engine_", ignore_cleanup_errors=True) as place:
        address = f"unix://{place}/socket"
        command = ["dockerd", "--iptables=false", "--bridge=none", "--data-root", str(folder / "engine")]
        command += ["--exec-root", f"{place}/exec", "--pidfile", f"{place}/pid", "--host", address]
        log = folder / "engine.log"
        with log.open("w") as lines:
            daemon = subprocess.Popen(command, stdout=lines, stderr=lines, start_new_session=True)
        try:
            found, deadline = Engine(address), time.monotonic() + START
            while daemon.poll() is None and time.monotonic() < deadline and not found.answers():
                time.sleep(0.5)
            works = found.answers()
            if not works:
                print(f"Debian's container engine does not start here: see {log}", file=sys.stderr)
            yield found if works else None
        finally:
            daemon.terminate()
            daemon.wait(START)
