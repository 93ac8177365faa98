# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Programs that this one starts: all of them here, since none may execute files of the folder that it is started in.

As a program, with PARENT_PID COMMAND...: becomes a command that gets a signal when its parent ends (on Linux).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any

# Without it, ``python -c`` and ``python -m`` look there first: a ``random.py`` would take the place of Python's own.
# Unlike the option -P, programs that these start have it too, and a Python older than 3.11 passes over it.
SAFE_PATH = {"PYTHONSAFEPATH": "1"}


def start(command: Sequence[str], environment: Mapping[str, str], **options: Any) -> subprocess.Popen[bytes]:
    """Start a program without stdin; ``options`` of ``subprocess.Popen``."""
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, env={**environment, **SAFE_PATH}, **options)


def run(
    command: Sequence[str], environment: Mapping[str, str], timeout: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Exit code and output of a program; TimeoutExpired after ``timeout`` seconds."""
    how: dict[str, Any] = {"stdin": subprocess.DEVNULL, "env": {**environment, **SAFE_PATH}, "timeout": timeout}
    return subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", check=False, **how)


PR_SET_PDEATHSIG = 1


def end_with_parent(parent: int) -> None:
    """Ask for SIGTERM when the parent process ends; if it has ended already, end."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM))
    if os.getppid() != parent:
        sys.exit(1)


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])
