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

"""A job of a sweep, and its outcome: what is sent to the workers and comes back from them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self

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
        text = json.dumps(document)
        what = json.dumps([kind, None if kind == "predict" else level, document], sort_keys=True)
        # The order of the graphs, which sort_keys hides, is that of the modes.
        what += json.dumps(list(document["graphs"]))
        what += until or ""
        return cls(hashlib.sha256(what.encode()).hexdigest()[:20], kind, text, level, until)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a job, or why it failed."""

    id: str  # of the job
    status: str  # ``DONE`` or ``FAILED``
    reason: str | None  # why it failed
    result: Mapping[str, Any]  # what is kept, also of an incomplete run; empty where it failed otherwise
    seconds: float  # wall time [s]
    place: str  # host:process id
    software: str  # see ``software.installed_software``
