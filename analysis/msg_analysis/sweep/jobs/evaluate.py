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

"""One point of a sweep: what is done there, and what is kept of it. This is what runs on the workers.

Theory, twin and statistics are imported only in the jobs that need them.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

from msg_analysis.errors import InputError
from msg_analysis.sweep.jobs.job import DONE, FAILED, Job, NetworkStoppedError, Outcome


def evaluate(job: Job, stopping: Callable[[], bool] = lambda: False) -> Outcome:
    """Do a job. An error becomes a failed outcome, so that the other points go on.

    ``stopping`` is asked while a network runs; if the sweep is being ended, NetworkStoppedError is raised.
    """
    from msg_analysis.sweep.jobs.software import installed_software

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
    return Outcome(job.id, FAILED if reason else DONE, reason, result, seconds, place, installed_software())


def _result(job: Job, stopping: Callable[[], bool]) -> Mapping[str, Any]:
    from msg_analysis.model.experiment.experiment import ValidExperiment

    if job.kind == "network":
        from msg_analysis.sweep.jobs.network_run import run_network

        return of_comparison(run_network(job, stopping))
    experiment = ValidExperiment.parse(json.loads(job.document), source="experiment")
    if job.kind == "predict":
        from msg_analysis.theory.prediction import predict

        return of_prediction(predict(experiment).to_json())
    from msg_analysis.inference.verdict.compare import compare
    from msg_analysis.twin.simulate import simulate

    return of_comparison(compare(simulate(experiment), level=job.level).to_json())


def of_prediction(document: Mapping[str, Any]) -> dict[str, Any]:
    """What is kept of a prediction, as ``predict --json`` prints it: the errors under every law, without matrices."""
    from msg_analysis.theory.prediction import LAW_NAMES

    keys = ("system_error", "system_certainty", "node_errors")
    laws = {law: document[law] for law in LAW_NAMES if document.get(law)}
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
