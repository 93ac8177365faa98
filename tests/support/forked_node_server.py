"""Node servers that commands of tests fork from themselves: to import all of it again takes half a second of CPU time.

Preloaded by what forks these commands (``many_commands``). Programs that are executed start theirs as users do.
"""

import atexit
import ctypes
import gc
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

from many_commands import MARK, NO_MARK, starts_as_here
from setproctitle import setproctitle

from msg_agents.cli import node_server
from msg_agents.run import fork_server
from msg_agents.run.fork_server import ForkedProcess
from msg_analysis.common import programs


class ForkedServer(ForkedProcess):
    """With what is used of ``subprocess.Popen``."""

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def start(command: Sequence[str], environment: Mapping[str, str], **options: Any) -> Any:
    """``programs.start``, but node servers are forked."""
    if not starts_as_here(command, environment):
        return programs.start(command, environment, **options)
    sys.stdout.flush()
    sys.stderr.flush()
    if pid := os.fork():
        return ForkedServer(pid)
    try:
        become(command, environment, options["stdout"].fileno(), *options["pass_fds"])
    finally:
        os._exit(1)


def become(command: Sequence[str], environment: Mapping[str, str], output: int, control: int) -> NoReturn:
    """Leave of this process, which has been forked, what one has that has been executed."""
    os.setsid()
    atexit._clear()
    signal.set_wakeup_fd(-1)
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) == signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for stream, source in enumerate((os.open(os.devnull, os.O_RDONLY), output, output)):
        os.dup2(source, stream)
    os.closerange(3, control)
    os.closerange(control + 1, os.sysconf("SC_OPEN_MAX"))
    sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115  nodes write at once
    sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
    os.environ.clear()
    os.environ.update({**environment, **programs.SAFE_PATH})
    _write_mark(environment.get(MARK, NO_MARK))
    sys.argv = [fork_server.PROGRAM[-1], str(control)]
    setproctitle(" ".join(["python", *command[1:4]]))
    node_server.main()
    raise AssertionError


def _write_mark(mark: str) -> None:
    """Where others see it: in the environment with which what has forked this process was executed."""
    begin, end = map(int, Path("/proc/self/stat").read_text().rpartition(")")[2].split()[47:49])
    place = ctypes.string_at(begin, end - begin).index(f"{MARK}=".encode())
    ctypes.memmove(begin + place + len(MARK) + 1, mark.encode(), len(NO_MARK))


node_server.prepare()  # also finds the place of titles, before anything has changed the environment
gc.enable()
fork_server.programs = SimpleNamespace(start=start)  # type: ignore[assignment]
