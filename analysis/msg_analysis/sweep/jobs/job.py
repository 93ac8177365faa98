"""A job of a sweep, and its outcome: what is sent to the workers and comes back from them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

Kind = Literal["predict", "simulate", "network"]
DONE, FAILED = "done", "failed"


class NetworkStoppedError(Exception):
    """A run was ended because the sweep was: it is no result."""


@dataclass(frozen=True, slots=True)
class NetworkOptions:
    """How runs of networks are made.

    Attributes
    ----------
    program
        msg-agents
    directory
        where the bags are made
    keep
        whether bags are kept of runs that agree with the prediction, too
    at_once
        most networks of sweeps at a time on one machine
    """

    program: str
    directory: str
    keep: bool = False
    at_once: int = 1


@dataclass(frozen=True, slots=True)
class Job:
    """Something to be done, self-contained: a worker needs no file for it.

    Attributes
    ----------
    id
        the same for the same thing to be done
    kind
        what
    document
        the experiment, as JSON
    level
        of the comparison
    network
        how runs of networks are made
    """

    id: str
    kind: Kind
    document: str
    level: float
    network: NetworkOptions | None = field(default=None, compare=False)

    @classmethod
    def of(cls, kind: Kind, document: Mapping[str, Any], level: float = 0.01) -> Self:
        """The job for an experiment.

        Parameters
        ----------
        kind
            what is to be done with it
        document
            the experiment, as in its file
        level
            of the tests of a run
        """
        text = json.dumps(document)
        what = json.dumps([kind, None if kind == "predict" else level, document], sort_keys=True)
        # The order of the graphs is that of the modes.
        what += json.dumps(list(document["graphs"]))
        return cls(hashlib.sha256(what.encode()).hexdigest()[:20], kind, text, level)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a job.

    Attributes
    ----------
    id
        of the job
    status
        ``DONE`` or ``FAILED``
    reason
        why it failed; None where it did not
    result
        what is kept: a document; empty where it failed
    seconds
        that it took [s]
    place
        host and process that did it
    software
        that it was done with
    """

    id: str
    status: str
    reason: str | None
    result: Mapping[str, Any]
    seconds: float
    place: str
    software: str
