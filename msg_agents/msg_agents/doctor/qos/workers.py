# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The processes that publish and read, as seen by the command."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from msg_agents.doctor.qos.connection import Connection
from msg_agents.running.surroundings import Surroundings
from msg_analysis.common.forked_processes import ForkedProcess, ForkServer
from msg_analysis.errors import InputError

PROGRAM = [sys.executable, "-m", "msg_agents.nodes.qos.server"]
ENDING = 5.0  # s that a process has to leave the network and end

Role = Literal["writer", "reader"]


class Worker:
    """One process with a node: a writer or a reader of several topics."""

    def __init__(self, process: ForkedProcess, connection: Connection, log: Path) -> None:
        self._process = process
        self._connection = connection
        self._log = log

    def tell(self, command: str, **arguments: Any) -> None:
        """Send a request, whose answer is to be taken later."""
        with contextlib.suppress(OSError):  # it has ended, as ``answer`` says
            self._connection.send({"command": command, **arguments})

    def answer(self) -> dict[str, Any]:
        """Wait for the answer; InputError: the process has ended."""
        try:
            answer = self._connection.receive()
        except OSError:
            answer = None
        if answer is None:
            lines = self._log.read_text(errors="replace").split("\n") if self._log.is_file() else []
            reason = next((line for line in reversed(lines) if line.strip()), "killed from outside, or no memory")
            raise InputError(f"--qos: a process of the matrix has ended: {reason}: run `msg-agents doctor`")
        return answer

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a request and wait for its answer."""
        self.tell(command, **arguments)
        return self.answer()

    def kill(self) -> None:
        """Kill the process: it leaves the network without a word."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()
        self._connection.close()

    def stop(self) -> None:
        """Stop the process (SIGSTOP), and wait until it stands still."""
        self._process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self._process.pid, os.WSTOPPED)

    def resume(self) -> None:
        """Let a stopped process go on."""
        self._process.send_signal(signal.SIGCONT)

    def leave(self) -> None:
        """Let the process leave the network and end."""
        self.tell("leave")
        if self._connection.waits(ENDING):  # the end of its side
            self._process.wait()
            self._connection.close()
        else:
            self.kill()


class Workers:
    """Starts processes, forked from one that has imported everything: a context, at whose end all are gone."""

    def __init__(self, around: Surroundings, folder: Path) -> None:
        self._log = folder / "workers.log"
        self._server = ForkServer(PROGRAM, around.environment, self._log)
        self._introducer = around.introducer
        self._started: list[ForkedProcess] = []
        self._count = 0
        self._writer = ""  # name of the newest one, which readers are introduced to

    def __enter__(self) -> Self:
        self._server.__enter__()
        return self

    def start(self, role: Role, count: int = 1) -> list[Worker]:
        """So many processes of one kind, each with a node of its own."""
        pairs = [socket.socketpair() for _ in range(count)]
        names = [f"{role}_{self._count + i}" for i in range(count)]
        self._count += count
        introduction = [self._introducer.descriptor] if self._introducer else []
        if role == "writer":
            self._writer = names[0]
        elif self._introducer:
            self._introducer.introduce({name: [self._writer] for name in names})
        requests = [
            ({"role": role, "name": name, "parent": os.getpid()}, [theirs.fileno(), *introduction])
            for name, (_, theirs) in zip(names, pairs, strict=True)
        ]
        processes = self._server.fork(requests)
        for _, theirs in pairs:
            theirs.close()
        self._started = [each for each in self._started if each.poll() is None] + processes
        if len(processes) < count:
            raise InputError("--qos: a process could not be forked (Linux only): raise `ulimit -u`, or free memory")
        return [
            Worker(process, Connection(ours), self._log) for process, (ours, _) in zip(processes, pairs, strict=True)
        ]

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._started:
            process.send_signal(signal.SIGKILL)
            process.wait()
        self._server.__exit__(kind, error, trace)
