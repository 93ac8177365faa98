"""One point of a sweep: what is done there, and what is kept of it. This is what runs on the workers.

Theory, twin and statistics are imported only in the jobs that need them.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from msg_analysis.errors import InputError
from msg_analysis.sweep.spec import Kind

DONE, FAILED = "done", "failed"
_LAWS = ("continuous", "emulated", "discrete")


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

    id: str  # hash of kind, document and, of runs, level
    kind: Kind
    document: str  # the experiment, as JSON
    level: float  # of the tests of a run
    network: NetworkOptions | None = field(default=None, compare=False)

    @classmethod
    def of(cls, kind: Kind, document: Mapping[str, Any], level: float = 0.01) -> Self:
        """The job for an experiment, a document as in its file; ``level`` of the tests of a run."""
        text = json.dumps(document)
        what = json.dumps([kind, None if kind == "predict" else level, document], sort_keys=True)
        # The order of the graphs, which sort_keys hides, is that of the modes.
        what += json.dumps(list(document["graphs"]))
        return cls(hashlib.sha256(what.encode()).hexdigest()[:20], kind, text, level)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a job."""

    id: str  # of the job
    status: str  # ``DONE`` or ``FAILED``
    reason: str | None  # why it failed
    result: Mapping[str, Any]  # what is kept, also of an incomplete run; empty where it failed otherwise
    seconds: float  # wall time [s]
    place: str  # host:process id
    software: str  # see ``software.installed``


def evaluate(job: Job, stopping: Callable[[], bool] = lambda: False) -> Outcome:
    """Do a job. An error becomes a failed outcome, so that the other points go on.

    ``stopping`` is asked while a network runs; if the sweep is being ended, NetworkStoppedError is raised.
    """
    from msg_analysis.sweep.software import installed

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
    except Exception as error:  # a defect, perhaps of this point only
        reason = f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - begin
    place = f"{socket.gethostname()}:{os.getpid()}"
    return Outcome(job.id, FAILED if reason else DONE, reason, result, seconds, place, installed())


def _result(job: Job, stopping: Callable[[], bool]) -> Mapping[str, Any]:
    from msg_analysis.model.experiment import Experiment

    if job.kind == "network":
        from msg_analysis.sweep.network import run_network

        return of_comparison(run_network(job, stopping))
    experiment = Experiment.parse(json.loads(job.document), source="experiment")
    if job.kind == "predict":
        from msg_analysis.theory.prediction import predict

        return of_prediction(predict(experiment).to_json())
    from msg_analysis.inference.compare import compare
    from msg_analysis.twin import simulate

    return of_comparison(compare(simulate(experiment), level=job.level).to_json())


def of_prediction(document: Mapping[str, Any]) -> dict[str, Any]:
    """What is kept of a prediction, as ``predict --json`` prints it: the errors under every law, without matrices."""
    keys = ("system_error", "system_certainty", "node_errors")
    laws = {law: document[law] for law in (*_LAWS, "static") if document.get(law)}
    kept: dict[str, Any] = {law: {key: found[key] for key in keys} for law, found in laws.items()}
    return {"agents": document["agents"], "stationary": document["stationary"], **kept}


def of_comparison(document: Mapping[str, Any]) -> dict[str, Any]:
    """What is kept of a comparison, as ``compare --json`` prints it: the errors and the least p-value of its tests.

    As the p-values are adjusted, the least one is a p-value of the hypothesis that the run follows its law.
    """
    tests = document.get("tests") or []
    least = min(tests, key=lambda test: test["p_adjusted"], default=None)
    kept = {
        key: document.get(key)
        for key in (
            "verdict",
            "unpredicted",
            "steps",
            "simulated_time",
            "law",
            "system_error",
            "node_errors",
            "bag",
            "rate",
        )
    }
    causes = document.get("blame") or []
    return kept | {
        "p": least["p_adjusted"] if least else None,
        "least": least["name"] if least else None,
        "blame": "; ".join(cause["words"] for cause in causes) or None,
        "continuous": document.get("continuous"),
        "failure": "; ".join(document.get("failures") or []) or "data incomplete",
    }
