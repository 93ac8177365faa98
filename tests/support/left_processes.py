"""What processes were doing that have outlived their test: for the report of its failure."""

import contextlib
import os
import subprocess
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from waiting import state_of

from msg_agents.run.fork_server import SHOW_STACKS

ANSWER = 0.5  # s that they have to write their stacks
LONGEST = 6000  # characters of a file


def describe(pids: Sequence[int], folders: Iterable[Path]) -> str:
    """Stacks of the processes, if they can write them, and the files in which their networks say what they do."""
    lines = [f"process {pid}: {_state(pid)}" for pid in pids]
    for pid in pids:
        if _can_answer(pid):
            with contextlib.suppress(OSError):
                os.kill(pid, SHOW_STACKS)
    time.sleep(ANSWER)
    for folder in folders:
        for path in sorted([*folder.rglob("*.log"), *folder.rglob("*.json")]):
            with contextlib.suppress(OSError):
                lines.append(f"--- {path}\n{path.read_text(errors='replace')[-LONGEST:]}")
    return "\n".join(lines)


def last_line(commands: Iterable[subprocess.Popen[str]]) -> str:
    """What commands that have been killed had printed and nobody has read."""
    lines = []
    for command in commands:
        with contextlib.suppress(OSError, ValueError, subprocess.TimeoutExpired):
            lines += [f"--- {command.args}", *(text for text in command.communicate(timeout=5) if text)]
    return "\n".join(lines)


def _state(pid: int) -> str:
    """As the system sees it, and in which of its functions it waits."""
    with contextlib.suppress(OSError):
        return f"{state_of(pid)} {Path(f'/proc/{pid}/wchan').read_text()}"
    return "gone"


def _can_answer(pid: int) -> bool:
    """Whether the signal would not end it."""
    with contextlib.suppress(OSError):
        fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        return bool(int(fields["SigCgt"], 16) >> (SHOW_STACKS - 1) & 1)
    return False
