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

"""Conducting a sweep: outcomes that are there are kept, the other jobs are done, and all are judged together.

``jobs.workers`` decides where a job runs, ``jobs.evaluate`` what is done in it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from msg_analysis.common.exit_codes import ExitCode
from msg_analysis.errors import InputError
from msg_analysis.inference.statistics.holm import holm
from msg_analysis.sweep.jobs.evaluate import evaluate
from msg_analysis.sweep.jobs.job import DONE, FAILED, Job, NetworkOptions, Outcome
from msg_analysis.sweep.jobs.software import installed_software
from msg_analysis.sweep.jobs.workers import Lost, Workers, deferring_interrupts
from msg_analysis.sweep.outcome_store import OutcomeStore

OtherSoftware = Literal["refuse", "redo", "keep"]
NETWORK_PATIENCE = 60.0  # s that running networks have to end in order

SweepProgress = Callable[[int, int, int], None]  # outcomes available, total, how many of them failed


@dataclass(frozen=True, slots=True)
class Conducted:
    """What was done."""

    outcomes: tuple[Outcome, ...]  # in the order of the jobs
    kept: int  # jobs that had been done before
    others: int  # outcomes in the store that belong to none of the jobs


def conduct(
    jobs: Sequence[Job],  # equal ones are done once
    store: OutcomeStore,
    *,
    workers: int | None = None,  # processes here; None: one per CPU, or a single one where networks run
    scheduler: str | None = None,  # of a Dask cluster, whose workers are used instead
    network: NetworkOptions | None = None,  # needed where jobs run networks
    other_software: OtherSoftware = "refuse",  # what to do with outcomes that other software made
    retry: bool = False,  # whether failed jobs are done again
    watch: SweepProgress = lambda _done, _total, _failed: None,
) -> Conducted:
    """Do all jobs that have not been done; outcomes are kept in ``store`` as soon as they come.

    InputError: outcomes of other software ("refuse"), or no workers. WorkersLostError: the cluster went away.
    """
    todo = _todo(jobs, store, other_software, retry)
    kept = len(jobs) - sum(job.id in todo for job in jobs)
    total = len({job.id for job in jobs})
    failed = sum(store.outcomes[job.id].status == FAILED for job in jobs if job.id not in todo)
    done = total - len(todo)
    watch(done, total, failed)
    if todo:
        runs_networks = any(job.kind == "network" for job in todo.values())
        if runs_networks and not scheduler:
            workers = workers or 1
        items = [dataclasses.replace(job, network=network) for job in todo.values()]
        patience = {"patience": NETWORK_PATIENCE} if runs_networks else {}
        with Workers(workers, scheduler) as pool, closing(pool.outcomes(evaluate, items, **patience)) as batches:
            for batch in batches:
                found = [_lost(job, result) if isinstance(result, Lost) else result for job, result in batch]
                with deferring_interrupts():  # what is said to be kept is what is on the disk
                    store.add(found)
                done += len(found)
                failed += sum(outcome.status == FAILED for outcome in found)
                watch(done, total, failed)
    outcomes = tuple(store.outcomes[job.id] for job in jobs)
    return Conducted(outcomes, kept, len(store.outcomes.keys() - {job.id for job in jobs}))


def _todo(jobs: Sequence[Job], store: OutcomeStore, other_software: OtherSoftware, retry: bool) -> dict[str, Job]:
    """The jobs that have to be done, by id."""
    todo, others = {}, {}
    for job in jobs:
        known = store.outcomes.get(job.id)
        if known is None or (retry and known.status == FAILED):
            todo[job.id] = job
        elif known.software != installed_software() and other_software != "keep":
            others[job.id] = known.software
            todo[job.id] = job
    if others and other_software == "refuse":
        was = " and ".join(sorted(set(others.values())))
        raise InputError(
            f"{store.directory}: {len(others)} results were made with other software ({was}), not "
            f"{installed_software()}: choose another --out, or use --other-software redo or keep"
        )
    return todo


def _lost(job: Job, lost: Lost) -> Outcome:
    return Outcome(job.id, FAILED, lost.reason, {}, 0.0, "", installed_software())


@dataclass(frozen=True, slots=True)
class Judgement:
    """What the runs of a sweep say together; the tuples are in the order of the outcomes."""

    p_holm: tuple[float | None, ...]  # p-values, adjusted over all of them (Holm); None where there is none
    verdicts: tuple[str | None, ...]  # "agrees", "disagrees", "unpredicted"; None for predictions and failures
    # "disagrees" if any run does; else "incomplete" if anything failed; else "agrees", or None for predictions. Runs
    # that are all "unpredicted" count as "agrees".
    verdict: str | None

    @property
    def exit_code(self) -> int:
        """0 agrees or only predictions, 1 disagrees, 3 something failed."""
        if self.verdict == "disagrees":
            return ExitCode.DISAGREES
        return ExitCode.INCOMPLETE if self.verdict == "incomplete" else ExitCode.FINE


def judge_sweep(outcomes: Sequence[Outcome], level: float) -> Judgement:
    """Judge all runs together (Holm): the chance of any false "disagrees" is at most ``level``."""
    p_values: list[float | None] = [outcome.result.get("p") if outcome.status == DONE else None for outcome in outcomes]
    tested = [place for place, p in enumerate(p_values) if p is not None]
    adjusted: list[float | None] = [None] * len(outcomes)
    if tested:
        for place, p in zip(tested, holm(np.array([p_values[place] for place in tested], dtype=float)), strict=True):
            adjusted[place] = float(p)
    verdicts = tuple(_verdict(outcome, p, level) for outcome, p in zip(outcomes, adjusted, strict=True))
    whole: str | None = "agrees" if any(verdicts) else None
    if any(outcome.status == FAILED for outcome in outcomes):
        whole = "incomplete"
    if "disagrees" in verdicts:
        whole = "disagrees"
    return Judgement(tuple(adjusted), verdicts, whole)


def _verdict(outcome: Outcome, p_holm: float | None, level: float) -> str | None:
    result: Mapping[str, Any] = outcome.result
    if outcome.status == FAILED or "verdict" not in result:
        return None
    if p_holm is not None and p_holm < level:
        return "disagrees"
    return "unpredicted" if result.get("unpredicted") else "agrees"
