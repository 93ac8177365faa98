"""Runs command lines in processes of their own, forked from one that has imported everything before.

A job is a list: program, arguments, and what its stdout is: "pipe", "full" (a full disk), "closed", "gone" (a pipe that
nobody reads), "terminal", "ascii" (it has few characters), "limit" (files cannot grow beyond a few bytes), or "memory"
(there is 1 GB of it). A job is killed after a minute. ``outcomes`` gives exit code, stdout, stderr of each. ``main`` is
the process that forks: it answers each line, a request, by a line.
"""

import atexit
import contextlib
import functools
import gc
import importlib
import json
import os
import pty
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path
from typing import Any

PROGRAMS = {"msg-analysis": "msg_analysis.cli.main", "msg-agents": "msg_agents.cli.main"}
PREPARED = (
    *PROGRAMS.values(),
    "msg_analysis.experiment.experiment",
    "msg_analysis.cli.console",
    "msg_analysis.common.text",
    "msg_analysis.report.documents",
    "msg_analysis.report.documents",
    "msg_analysis.report.tables",
    "msg_analysis.report.comparison_text",
    "msg_analysis.report.tables",
    "msg_analysis.report.tables",
    "msg_analysis.report.theory_text",
    "msg_analysis.twin.check",
    "rich._emoji_codes",
    "rich.progress",
    "threadpoolctl",
)
BY_COMMAND = {  # what takes long to import, and no other command needs
    "export": ("pyarrow.csv", "pyarrow.parquet"),
    "figures": ("msg_analysis.paper.figures",),
    "spectrum": ("scipy.signal",),
    "sweep": (
        "msg_analysis.report.sweep_plots",
        "msg_analysis.report.list_pages",
        "msg_analysis.sweeps.results",
    ),
}
CODE = f"import sys; sys.path.append({str(Path(__file__).parent)!r}); import many_commands; many_commands.main()"
MEMORY = 1 << 30  # bytes
LONGEST = 60  # s of a job


def outcomes(
    jobs: list[list[Any]], folder: Path, prepared: tuple[str, ...] = (), **environment: str
) -> list[list[Any]]:
    """Exit code, stdout, stderr of each job, with this folder to work in and additions to the environment.

    ``prepared``: more modules that are to be imported before.
    """
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    all_of_it = {**os.environ, **environment}
    request = {"jobs": jobs, "folder": str(folder), "environment": all_of_it, "prepared": prepared}
    try:
        server.stdin.write(f"{json.dumps(request)}\n")
        server.stdin.flush()
        found: list[list[Any]] = json.loads(server.stdout.readline())
    except BaseException:  # its answer would be taken for that of the next request
        server.kill()
        _server.cache_clear()
        raise
    return found


@functools.cache
def _server() -> subprocess.Popen[str]:
    """It ends with this process, which holds the other end of its stdin."""
    server = subprocess.Popen(
        [sys.executable, "-P", "-c", CODE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )
    atexit.register(server.wait)
    atexit.register(server.terminate)
    return server


def child(program: str, arguments: list[str], kind: str, stdout: int, stderr: int) -> int:
    os.dup2(stderr, 2)
    signal.alarm(LONGEST)
    sys.argv = [program, *arguments]
    if kind == "limit":
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # as Python has it at its start
        resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))
    if kind == "memory":
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    if kind == "ascii":
        sys.stdout.reconfigure(encoding="ascii", errors="strict")  # type: ignore[union-attr]
        sys.stderr.reconfigure(encoding="ascii")  # type: ignore[union-attr]
    if kind == "closed":
        os.close(1)
        sys.stdout = None  # type: ignore[assignment]  # as Python has it at its start
    else:
        os.dup2(stdout, 1)
    try:
        importlib.import_module(PROGRAMS[program]).main(arguments, prog_name=program)
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
            with contextlib.suppress(OSError):  # a terminal that nobody writes to any more
                while chunk := os.read(source, 65536):
                    text += chunk
            os.close(source)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        out.seek(0)
        err.seek(0)
        return [code, (text or out.read()).decode(), err.read().decode()]


def main() -> None:
    """Serve requests."""
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    with Path(os.devnull).open() as nothing:
        os.dup2(nothing.fileno(), 0)
    for name in PREPARED:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()  # the collector writes to what it looks at, and the memory would be copied
    for line in requests:
        request = json.loads(line)
        os.chdir(request["folder"])
        os.environ.clear()
        os.environ.update({"MPLBACKEND": "agg", **request["environment"]})
        commands = {arguments[0] for _, arguments, _ in request["jobs"]}
        for name in (*request["prepared"], *(name for command in commands for name in BY_COMMAND.get(command, ()))):
            importlib.import_module(name)
        print(json.dumps([run(*job) for job in request["jobs"]]), file=answers, flush=True)
