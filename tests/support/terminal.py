"""A terminal for tests: what a program prints on it, and what is typed."""

import fcntl
import os
import pty
import select
import signal
import subprocess
import termios
import time
from pathlib import Path
from typing import Any

from many_commands import PROGRAMS, ForkedCommand


def default_signals() -> None:
    """The tests may run under nohup or in the background."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def take_terminal() -> None:
    """Make the terminal that is stdin that of this process, in a session of its own."""
    os.setsid()
    default_signals()
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


class Terminal:
    """A program on a terminal of its own, one of ours forked, others executed; stdout may be a file."""

    def __init__(self, *command: str | Path, columns: int = 80, rows: int = 24, stdout: Path | None = None) -> None:
        self._master, slave = pty.openpty()
        termios.tcsetwinsize(slave, (rows, columns))
        self.before = termios.tcgetattr(slave)
        self._slave = slave
        self.text = ""
        # readline adds its own, also to the environment of pytest's workers, and they would fix the size
        environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        program, *words = command
        self.process: Any
        if program in PROGRAMS:
            where = {"terminal": os.ttyname(slave), "stdout": stdout}
            self.process = ForkedCommand(str(program), words, environment, first=default_signals, **where)
        else:
            streams = dict.fromkeys(("stdin", "stdout", "stderr"), slave)
            self.process = subprocess.Popen(command, **streams, preexec_fn=take_terminal, env=environment)

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def mode(self) -> list[Any]:
        return termios.tcgetattr(self._slave)

    def local_flags(self) -> int:
        """Whether lines are edited, and whether what is typed is shown."""
        return int(termios.tcgetattr(self._slave)[3] & (termios.ICANON | termios.ECHO))

    def read(self, seconds: float) -> str:
        """What is printed within so much time."""
        end, new = time.monotonic() + seconds, ""
        while (left := end - time.monotonic()) > 0:
            if select.select([self._master], [], [], left)[0]:
                new += os.read(self._master, 65536).decode(errors="replace")
        self.text += new
        return new

    def wait_for(self, *texts: str, seconds: float = 30) -> None:
        """Until one of them is printed, wherever the lines are wrapped."""
        end = time.monotonic() + seconds
        while not any(text in self.text.replace("\r\n", "") for text in texts):
            assert time.monotonic() < end, f"no {texts} in {self.text!r}"
            self.read(0.1)

    def resize(self, columns: int, rows: int) -> None:
        """Make the window larger or smaller; the program is told."""
        termios.tcsetwinsize(self._slave, (rows, columns))

    def read_to_the_end(self, seconds: float = 120) -> int:
        """Until the program ends; its exit code."""
        end = time.monotonic() + seconds
        while self.process.poll() is None:
            assert time.monotonic() < end, f"still running: {self.text[-2000:]!r}"
            self.read(0.1)
        self.read(0.2)
        return self.process.returncode

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self._master)
        os.close(self._slave)
