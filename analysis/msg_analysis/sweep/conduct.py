"""Conducting a sweep: what is there already is kept, the rest is done, and all of it is judged together."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from msg_analysis.errors import InputError
from msg_analysis.inference.statistics.holm import holm
from msg_analysis.sweep.jobs.evaluate import evaluate
from msg_analysis.sweep.jobs.job import DONE, FAILED, Job, NetworkOptions, Outcome
from msg_analysis.sweep.jobs.software import installed
from msg_analysis.sweep.jobs.workers import Lost, Workers
from msg_analysis.sweep.outcome_store import Store

OtherSoftware = Literal["refuse", "redo", "keep"]
NETWORK_PATIENCE = 60.0
"""Seconds that running networks have to end in order."""

Watch = Callable[[int, int, int], None]
"""Told of progress: outcomes that are there, of how many, and how many of them failed."""


@dataclass(frozen=True, slots=True)
class Conducted:
    """What was done.

    Attributes
    ----------
    outcomes
        in the order of the jobs
    kept
        how many of the jobs had been done before
    others
        outcomes in the same directory that are of none of the jobs
    """

    outcomes: tuple[Outcome, ...]
    kept: int
    others: int


def conduct(
    jobs: Sequence[Job],
    store: Store,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    network: NetworkOptions | None = None,
    other_software: OtherSoftware = "refuse",
    retry: bool = False,
    watch: Watch = lambda _done, _total, _failed: None,
) -> Conducted:
    """Do all jobs that have not been done.

    Parameters
    ----------
    jobs
        Sequence[Job] what to do; what is there twice is done once
    store
        where outcomes are kept, and taken from
    workers
        processes of this machine; by default as many as it has CPUs, or one where networks run
    scheduler
        of a Dask cluster, whose workers are used instead
    network
        needed where jobs run networks
    other_software
        what becomes of outcomes that other software made: "refuse" to go on, "redo" or "keep" them
    retry
        whether what has failed is tried again
    watch
        told of progress

    Raises
    ------
    InputError
        outcomes of other software, or the workers cannot be had
    WorkersLostError
        the cluster went away; what was done is kept
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
                store.add(found)
                done += len(found)
                failed += sum(outcome.status == FAILED for outcome in found)
                watch(done, total, failed)
    outcomes = tuple(store.outcomes[job.id] for job in jobs)
    return Conducted(outcomes, kept, len(store.outcomes.keys() - {job.id for job in jobs}))


def _todo(jobs: Sequence[Job], store: Store, other_software: OtherSoftware, retry: bool) -> dict[str, Job]:
    """The jobs that have to be done, by id."""
    todo, others = {}, {}
    for job in jobs:
        known = store.outcomes.get(job.id)
        if known is None or (retry and known.status == FAILED):
            todo[job.id] = job
        elif known.software != installed() and other_software != "keep":
            others[job.id] = known.software
            todo[job.id] = job
    if others and other_software == "refuse":
        was = " and ".join(sorted(set(others.values())))
        raise InputError(
            f"{store.directory}: {len(others)} results are of other software ({was}): expected {installed()}: choose "
            "another --out, or say with --other-software whether to redo or to keep them"
        )
    return todo


def _lost(job: Job, lost: Lost) -> Outcome:
    return Outcome(job.id, FAILED, lost.reason, {}, 0.0, "", installed())


@dataclass(frozen=True, slots=True)
class Judgement:
    """What the runs of a sweep say together.

    Attributes
    ----------
    p_holm
        of every outcome: its p-value, adjusted over all of them (Holm); None where it has none
    verdicts
        of every outcome: "agrees", "disagrees", "unpredicted"; None for predictions and what failed
    verdict
        "agrees"; "disagrees" if any does; "incomplete" if none does and something failed; None for predictions
    """

    p_holm: tuple[float | None, ...]
    verdicts: tuple[str | None, ...]
    verdict: str | None

    @property
    def exit_code(self) -> int:
        """0 fine, 1 disagrees, 3 something failed."""
        return {"disagrees": 1, "incomplete": 3}.get(self.verdict or "", 0)


def judge(outcomes: Sequence[Outcome], level: float) -> Judgement:
    """Hold all runs together against their predictions: a false "disagrees" anywhere has at most this chance.

    Parameters
    ----------
    outcomes
        Sequence[Outcome] of predictions or runs
    level
        the chance
    """
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
