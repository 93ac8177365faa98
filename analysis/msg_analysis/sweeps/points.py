# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""One point of a sweep: what is done there, on a worker, and what is left of it; a network is a process of its own."""

from __future__ import annotations

import fcntl
import functools
import hashlib
import json
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from subprocess import Popen
from typing import Any, Literal, Self

from msg_analysis.common import programs
from msg_analysis.common.files import lock
from msg_analysis.common.resources import SINGLE_THREAD, __version__
from msg_analysis.common.shared_folders import own_folder
from msg_analysis.common.text import HALF_WIDTH_95
from msg_analysis.errors import InputError

# What the result of a job depends on: the folders and modules that ``evaluate`` imports.
_SOURCES = (
    *("arithmetic", "common", "experiment", "model", "theory", "twin", "inference"),
    *("sweeps/points.py", "errors.py", "protocol.py"),
)


@functools.cache
def installed_software() -> str:
    """Versions of msg_analysis, numpy and scipy in one line, with a digest of the code that results depend on."""
    libraries = " ".join(f"{name} {version(name)}" for name in ("numpy", "scipy"))
    return f"msg_analysis {__version__} ({source_digest(Path(__file__).parents[1])}), {libraries}"


def source_digest(package: Path) -> str:
    """Digest of the files in the folder of msg_analysis that results depend on."""
    digest = hashlib.sha256()
    for file in source_files(package):
        digest.update(f"{file.relative_to(package)}\0".encode() + file.read_bytes())
    return digest.hexdigest()[:10]


def source_files(package: Path) -> list[Path]:
    """These files: Python and C, in order."""
    found = [file for name in _SOURCES for file in [package / name, *(package / name).rglob("*")]]
    return sorted(file for file in found if file.suffix in (".py", ".c") and file.is_file())


JobKind = Literal["predict", "simulate", "network"]
DONE, FAILED = "done", "failed"


class NetworkStoppedError(Exception):
    """A run was ended because the sweep was: it has no result."""


@dataclass(frozen=True, slots=True)
class NetworkOptions:
    """How runs of networks are made."""

    program: str  # path of msg-agents
    directory: str  # where the bags are made
    keep: bool = False  # also keep bags of runs that agree with the prediction
    at_once: int = 1  # most networks at a time, of all sweeps of this user on one machine


@dataclass(frozen=True, slots=True)
class Job:
    """One thing to do, self-contained: a worker needs no file for it."""

    id: str  # hash of kind, document and, of runs, level and until
    kind: JobKind
    document: str  # the experiment, as JSON
    level: float  # of the tests of a run
    until: str | None = None  # `--until` of a network
    network: NetworkOptions | None = field(default=None, compare=False)

    @classmethod
    def of(cls, kind: JobKind, document: Mapping[str, Any], level: float = 0.01, until: str | None = None) -> Self:
        """The job for an experiment, a document as in its file; ``level`` of the tests of a run."""
        what = json.dumps([kind, None if kind == "predict" else level, document], sort_keys=True)
        # The order of the graphs, which sort_keys hides, is that of the modes.
        what += json.dumps(list(document["graphs"])) + (until or "")
        return cls(hashlib.sha256(what.encode()).hexdigest()[:20], kind, json.dumps(document), level, until)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a job, or why it failed."""

    id: str  # of the job
    status: str  # ``DONE`` or ``FAILED``
    reason: str | None  # why it failed
    result: Mapping[str, Any]  # also of an incomplete run; empty where it failed otherwise
    seconds: float  # wall time [s]
    place: str  # host:process id
    software: str  # see ``installed_software``


@dataclass(frozen=True, slots=True)
class JobResults:
    """What became of all jobs."""

    outcomes: tuple[Outcome, ...]  # in the order of the jobs
    reused: int  # jobs that had been done before


PROGRAM = "msg-agents"
POLL = 0.1  # s
# Signals, and the seconds that a run then has to end: it ends its own processes in order.
ESCALATION = ((signal.SIGINT, 30.0), (signal.SIGTERM, 10.0), (signal.SIGKILL, 5.0))
_END_WITH_PARENT = Path(programs.__file__)


def find_program() -> str:
    """Path of ``msg-agents``, beside this Python or else on PATH; InputError where it or its rclpy is missing."""
    beside = Path(sys.executable).with_name(PROGRAM)
    found = str(beside) if beside.is_file() else shutil.which(PROGRAM)
    remedy = "install the package msg_agents and ROS 2 (or simulate with the offline twin instead)"
    if found is None:
        raise InputError(f"{PROGRAM}: not found beside {sys.executable} nor on PATH: it runs the networks: {remedy}")
    with Path(found).open("rb") as file:
        line = file.readline(1000).decode(errors="replace").strip()
    python = line[2:] if line.startswith("#!/") and "python" in line and " " not in line else None
    # Its command line starts without ROS, a run does not.
    check = "import importlib.util, sys; sys.exit(importlib.util.find_spec('rclpy') is None)"
    if python and programs.run([python, "-c", check], os.environ).returncode:
        raise InputError(f"{found}: there is no rclpy for {python}: {remedy}")
    return found


def options(directory: Path, keep: bool, at_once: int) -> NetworkOptions:
    """How the networks of a sweep in ``directory`` are run; errors as of ``find_program``."""
    return NetworkOptions(find_program(), str(directory.absolute() / "runs"), keep, at_once)


def run_network(job: Job, stopping: Callable[[], bool]) -> Mapping[str, Any]:
    """The document of ``msg-agents run --json``. InputError: the run failed; NetworkStoppedError: it was ended."""
    options = job.network
    assert options is not None
    directory = Path(options.directory) / job.id
    with _slot(options.at_once, stopping) as slot:
        shutil.rmtree(directory, ignore_errors=True)  # left by a run whose worker was killed
        directory.mkdir(parents=True)
        file = directory / "experiment.json"
        file.write_text(job.document, encoding="utf-8")
        report = "always" if options.keep else "on-failure"
        arguments = ["run", str(file), "--out", str(directory), "--write-report", report, "--json"]
        arguments += ["--until", job.until] if job.until else []
        try:
            document, said, code = _run([options.program, *arguments], slot, stopping)
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


def _run(command: Sequence[str], slot: int, stopping: Callable[[], bool]) -> tuple[dict[str, Any] | None, str, int]:
    """Its result (None: not JSON), what it wrote to stderr, and its exit code."""
    with tempfile.TemporaryFile() as stdout, tempfile.TemporaryFile() as stderr:
        # In a session of its own: Ctrl-C in the terminal ends the sweep, which then ends the network in order. The slot
        # is inherited: if this worker is killed, the next network waits until this one has ended.
        process = programs.start(
            [sys.executable, str(_END_WITH_PARENT), str(os.getpid()), *command],
            {**os.environ, **SINGLE_THREAD},  # networks and workers share the cores
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
            pass_fds=[slot],
        )
        try:
            while process.poll() is None:
                time.sleep(POLL)
                if stopping():
                    raise NetworkStoppedError
        finally:
            _end(process)
        stdout.seek(0)
        stderr.seek(0)
        document: dict[str, Any] | None = None
        with suppress(ValueError):
            document = json.loads(stdout.read())
        return document, stderr.read().decode(errors="replace"), process.wait()


def _end(process: Popen[bytes]) -> None:
    for number, timeout in ESCALATION:
        process.send_signal(number)
        deadline = time.monotonic() + timeout
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(POLL)
        if process.poll() is not None:
            return


@contextmanager
def _slot(at_once: int, stopping: Callable[[], bool]) -> Iterator[int]:
    """Hold one of ``at_once`` places for networks of this user on this machine; waits until one is free."""
    # A place is a locked file, inherited by the network: it is free when all processes that hold it have ended.
    while True:
        for number in range(at_once):
            file = own_folder() / f"sweep_{number}.lock"
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                lock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, file)
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


def evaluate(job: Job, stopping: Callable[[], bool] = lambda: False) -> Outcome:
    """Do a job; an error becomes a failed outcome. NetworkStoppedError: ``stopping`` ended a network."""
    begin = time.perf_counter()
    reason: str | None = None
    result: Mapping[str, Any] = {}
    try:
        result = _result(job, stopping)
        if result.get("verdict") == "incomplete":
            reason = result["failure"]
    except InputError as error:
        reason = str(error)
    except NetworkStoppedError:
        raise
    except MemoryError:
        reason = "out of memory"
    except Exception as error:  # a defect, perhaps of this point only: the others go on
        reason = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - begin
    place = f"{socket.gethostname()}:{os.getpid()}"
    return Outcome(job.id, FAILED if reason else DONE, reason, result, seconds, place, installed_software())


def _result(job: Job, stopping: Callable[[], bool]) -> Mapping[str, Any]:
    from msg_analysis.experiment.experiment import Experiment

    if job.kind == "network":
        return of_comparison(run_network(job, stopping))
    experiment = Experiment.parse(json.loads(job.document), source="experiment")
    if job.kind == "predict":
        from msg_analysis.experiment.limits import prediction_method
        from msg_analysis.theory.prediction import predict
        from msg_analysis.theory.sampling import sampled_prediction

        if prediction_method(experiment)[0] == "sampled":
            return of_prediction(sampled_prediction(experiment).to_json())
        return of_prediction(predict(experiment).to_json())
    from msg_analysis.inference.verdict import compare_run
    from msg_analysis.twin.simulate import simulate

    return of_comparison(compare_run(simulate(experiment), level=job.level).to_json())


def of_prediction(document: Mapping[str, Any]) -> dict[str, Any]:
    """What is left of a prediction, as ``predict --json`` prints it: the errors under every law, without matrices."""
    from msg_analysis.theory.prediction import LAW_NAMES

    keys = ("system_error", "system_certainty", "node_errors")
    laws = {law: document[law] for law in LAW_NAMES if document.get(law)}
    kept: dict[str, Any] = {law: {key: found[key] for key in keys} for law, found in laws.items()}
    for law, found in laws.items():
        if "interval" in found:  # it is sampled
            low, high = found["interval"]
            numbers = {"standard_error": (high - low) / 2.0 / HALF_WIDTH_95, "low": low, "high": high}
            kept[law] |= {f"system_error.{key}": number for key, number in numbers.items()}
    return {"agents": document["agents"], "stationary": document["stationary"], **kept}


def of_comparison(document: Mapping[str, Any]) -> dict[str, Any]:
    """What is left of a comparison, as ``compare --json`` prints it: the errors and the least p-value of its tests."""
    # As the p-values are adjusted, the least one is a p-value of the hypothesis that the run follows its law.
    least = min(document.get("tests") or [], key=lambda test: test["p_adjusted"], default=None)
    keys = ("verdict", "unpredicted", "steps", "simulated_time", "law", "system_error", "node_errors", "bag", "rate")
    causes = document.get("causes") or []
    return {key: document.get(key) for key in keys} | {
        "p": least["p_adjusted"] if least else None,
        "least": least["name"] if least else None,
        "causes": "; ".join(cause["words"] for cause in causes) or None,
        "continuous": document.get("continuous"),
        "failure": "; ".join(document.get("failures") or []) or "data incomplete",
    }
