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

"""Runs of networks for a sweep: ``msg-agents run`` as a process of its own, a limited number at a time on a machine.

Nothing of ROS is imported here: only the process that is started needs it.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from msg_analysis.common.blas_threads import SINGLE_THREAD
from msg_analysis.errors import InputError
from msg_analysis.sweep.jobs.job import Job, NetworkOptions, NetworkStoppedError

PROGRAM = "msg-agents"
POLL = 0.1  # s
# Signals, and the seconds that a run then has to end: it ends its own processes in order.
ESCALATION = ((signal.SIGINT, 30.0), (signal.SIGTERM, 10.0), (signal.SIGKILL, 5.0))
_LEASH = Path(__file__).with_name("end_with_parent.py")


def find_program() -> str:
    """Path of ``msg-agents``, beside this Python or else on PATH; InputError where it or its rclpy is missing."""
    beside = Path(sys.executable).with_name(PROGRAM)
    found = str(beside) if beside.is_file() else shutil.which(PROGRAM)
    remedy = "install the package msg_agents and ROS 2 (or simulate with the offline twin instead)"
    if found is None:
        raise InputError(f"{PROGRAM}: not found beside {sys.executable} nor on PATH: it runs the networks: {remedy}")
    # Its command line starts without ROS, a run does not.
    check = "import importlib.util, sys; sys.exit(importlib.util.find_spec('rclpy') is None)"
    python = _interpreter(Path(found))
    if python and subprocess.run([python, "-c", check], capture_output=True, check=False).returncode:
        raise InputError(f"{found}: there is no rclpy for {python}: {remedy}")
    return found


def options(directory: Path, keep: bool, at_once: int) -> NetworkOptions:
    """How the networks of a sweep in ``directory`` are run; errors as of ``find_program``."""
    return NetworkOptions(find_program(), str(directory.absolute() / "runs"), keep, at_once)


def _interpreter(program: Path) -> str | None:
    """The Python in the first line of a script; None where there is none."""
    with program.open("rb") as file:
        line = file.readline(1000).decode(errors="replace").strip()
    return line[2:] if line.startswith("#!/") and "python" in line and " " not in line else None


def run_network(job: Job, stopping: Callable[[], bool]) -> Mapping[str, Any]:
    """Run a network and read its result, the document of ``msg-agents run --json``.

    InputError has the last line that a failed run wrote to stderr. NetworkStoppedError: ``stopping`` was true, it was
    ended.
    """
    options = job.network
    assert options is not None
    directory = Path(options.directory) / job.id
    with _slot(options.at_once, stopping) as slot:
        shutil.rmtree(directory, ignore_errors=True)  # left by a run whose worker was killed
        directory.mkdir(parents=True)
        file = directory / "experiment.json"
        file.write_text(job.document, encoding="utf-8")
        try:
            document, said, code = _run(options, job.until, file, directory, slot, stopping)
        except NetworkStoppedError:
            shutil.rmtree(directory, ignore_errors=True)
            raise
    if document is None:
        shutil.rmtree(directory, ignore_errors=True)
        last = said.strip().splitlines()[-1:] or ["no error message"]
        raise InputError(f"{PROGRAM} run: exit code {code}: {last[0].removeprefix('error: ')}")
    if document.get("verdict") == "agrees" and not options.keep:
        shutil.rmtree(directory, ignore_errors=True)
        document["bag"] = None
    return document


def _run(
    options: NetworkOptions,
    until: str | None,
    file: Path,
    directory: Path,
    slot: int,
    stopping: Callable[[], bool],
) -> tuple[dict[str, Any] | None, str, int]:
    """Its result (None: not JSON), what it wrote to stderr, and its exit code."""
    report = "always" if options.keep else "on-failure"
    arguments = ["run", str(file), "--out", str(directory), "--write-report", report, "--json"]
    arguments += ["--until", until] if until else []
    with tempfile.TemporaryFile() as stdout, tempfile.TemporaryFile() as stderr:
        process = _start(options.program, arguments, [stdout.fileno(), stderr.fileno(), slot])
        try:
            while process.poll() is None:
                time.sleep(POLL)
                if stopping():
                    raise NetworkStoppedError
        finally:
            _end(process)
        stdout.seek(0)
        stderr.seek(0)
        said = stderr.read().decode(errors="replace")
        try:
            document: dict[str, Any] | None = json.loads(stdout.read())
        except ValueError:
            document = None
    return document, said, process.wait()


def _start(program: str, arguments: Sequence[str], descriptors: Sequence[int]) -> subprocess.Popen[bytes]:
    """Start the command; the descriptors are for its stdout, its stderr and the slot."""
    # In a session of its own: Ctrl-C in the terminal ends the sweep, which then ends the network in order. The slot is
    # inherited: if this worker is killed, the next network waits until this one has ended.
    stdout, stderr, slot = descriptors
    return subprocess.Popen(
        [sys.executable, str(_LEASH), str(os.getpid()), program, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        env={**os.environ, **SINGLE_THREAD},  # networks and workers share the cores
        start_new_session=True,
        pass_fds=[slot],
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    for number, patience in ESCALATION:
        process.send_signal(number)
        deadline = time.monotonic() + patience
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(POLL)
        if process.poll() is not None:
            return


@contextmanager
def _slot(at_once: int, stopping: Callable[[], bool]) -> Iterator[int]:
    """Hold one of ``at_once`` places for networks of this user on this machine; waits until one is free.

    A place is a locked file, inherited by the network: it is free when all processes that hold it have ended.
    """
    while True:
        for number in range(at_once):
            path = Path(tempfile.gettempdir()) / f"msg_agents_sweep_{os.getuid()}_{number}.lock"
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                continue
            try:
                yield descriptor
            finally:
                os.close(descriptor)
            return
        time.sleep(POLL)
        if stopping():
            raise NetworkStoppedError
