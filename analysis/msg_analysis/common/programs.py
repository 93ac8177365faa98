# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Programs that this one starts: all of them here, since none may execute files of the folder that it is started in."""

from __future__ import annotations

import subprocess
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
    process = start(command, environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    with process:
        try:
            stdout, stderr = process.communicate(timeout=timeout)
        except BaseException:
            process.kill()
            raise
    texts = (text.decode(errors="replace") for text in (stdout, stderr))
    return subprocess.CompletedProcess(command, process.returncode, *texts)
