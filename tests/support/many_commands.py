"""Runs command lines in processes of their own that have imported everything before: python many_commands.py < jobs

A job is a list: program, arguments, and what its stdout is: "pipe", "full" (a full disk), "closed", "gone" (a pipe that
nobody reads), "terminal", or "limit" (files cannot grow beyond a few bytes). Prints a JSON list of exit code, stdout,
stderr of each.
"""

from __future__ import annotations

import gc
import json
import os
import pty
import resource
import signal
import sys
import tempfile
import traceback
from typing import Any

import matplotlib
import scipy.stats  # noqa: F401

import msg_agents.cli.main
import msg_analysis.api
import msg_analysis.cli.main
import msg_analysis.paper.figures
import msg_analysis.report.terminal.comparison_text
import msg_analysis.twin.check

PROGRAMS = {"msg-analysis": msg_analysis.cli.main.main, "msg-agents": msg_agents.cli.main.main}


def child(program: str, arguments: list[str], kind: str, stdout: int, stderr: int) -> int:
    os.dup2(stderr, 2)
    if kind == "limit":
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # as Python has it at its start
        resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))
    if kind == "closed":
        os.close(1)
        sys.stdout = None  # type: ignore[assignment]  # as Python has it at its start
    else:
        os.dup2(stdout, 1)
    try:
        PROGRAMS[program](arguments, prog_name=program)
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
        code = 1
    try:
        if sys.stdout:
            sys.stdout.flush()
    except OSError:
        code = 120  # as Python has it at its end
    return code


def run(program: str, arguments: list[str], kind: str) -> list[Any]:
    terminal = None
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        stdout = out.fileno()
        if kind == "full":
            stdout = os.open("/dev/full", os.O_WRONLY)
        elif kind == "gone":
            read, stdout = os.pipe()
            os.close(read)
        elif kind == "limit":  # the limit is for files, and stdout is none
            read, stdout = os.pipe()
        elif kind == "terminal":
            terminal, stdout = pty.openpty()
        pid = os.fork()
        if pid == 0:
            os._exit(child(program, arguments, kind, stdout, err.fileno() if kind != "limit" else stdout))
        if stdout != out.fileno():
            os.close(stdout)
        text = b""
        if terminal is not None or kind == "limit":
            source = read if terminal is None else terminal
            try:
                while chunk := os.read(source, 65536):
                    text += chunk
            except OSError:  # a terminal that nobody writes to any more
                pass
            os.close(source)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        out.seek(0)
        err.seek(0)
        return [code, (text or out.read()).decode(), err.read().decode()]


if __name__ == "__main__":
    matplotlib.use("Agg")
    gc.collect()
    gc.freeze()  # the collector writes to what it looks at, and the memory would be copied
    print(json.dumps([run(*job) for job in json.load(sys.stdin)]))
