# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The run record: everything that a run was started from, as one JSON document.

Every node of a run is given it, with a key that only they have; the latched topic ``experiment`` carries it, and so
does any bag of the network, whoever recorded it.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import platform
import re
import uuid
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.resources import __version__, ros_distribution
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.protocols import ProtocolInfo
from msg_analysis.model.step_model import (
    StepMatrices,
    StepModel,
    Wiring,
    build_model,
    build_step_model,
    step_noise_gain,
)

DECIDED = "decided"
DECIDED_PRECISION = 0.05  # at which ``decided`` ends a run that the evidence does not contradict


@dataclass(frozen=True, slots=True)
class Until:
    """The run ends when the interval of the system error is narrow enough, or its evidence disagrees."""

    precision: float  # half-width of the interval that holds at all times at once, over the system error
    decided: bool = False  # whether it also ends when the evidence passes 1 / level

    @classmethod
    def parse(cls, text: str, source: str = "--until") -> Self:
        """``decided``, or a precision such as ``1%``; InputError: neither."""
        if text == DECIDED:
            return cls(DECIDED_PRECISION, decided=True)
        found = re.fullmatch(r"([0-9]*\.?[0-9]+) ?%", text)
        if not found or not 0.0 < float(found[1]) < 100.0:
            raise InputError(
                f"{source}: {text!r}: expected a precision in percent, above 0 and below 100, such as 1%, or {DECIDED}"
            )
        return cls(float(found[1]) / 100.0)

    def __str__(self) -> str:
        return DECIDED if self.decided else f"{100.0 * self.precision:.12g}%"


FORMAT = 1


def software_versions() -> dict[str, str]:
    """Versions of what computes a run's numbers, and where that is."""
    import scipy  # here, since the processes of a run only read their record

    ros = {"ros_distro": distribution} if (distribution := ros_distribution()) else {}
    return {
        "msg_analysis": __version__,
        **ros,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "machine": platform.machine(),
        "system": f"{platform.system()} {platform.release()}",
        "host": platform.node(),
    }


def _now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC).replace(microsecond=0)


@dataclass(frozen=True, eq=False)
class RunRecord:
    """One run of an experiment."""

    # Start and matrices are computed once, when the record is made: every process, the twin and the check use the same
    # numbers, whatever their machines.

    run: uuid.UUID
    experiment: Experiment
    start: FloatArray  # (m, width) x(0)
    versions: dict[str, str] = field(default_factory=software_versions)  # of the software that started the run
    matrices: StepMatrices | None = None  # in discrete time or of a linear protocol; else the experiment gives them
    key: bytes | None = field(default=None, repr=False)  # with which nodes sign what steers the run; not in bags
    started: datetime.datetime = field(default_factory=_now)
    until: Until | None = None  # when the run may end before its duration
    planned: int | None = None  # steps that were planned, of a run that has ended before: ``experiment`` has those made

    @cached_property
    def model(self) -> Wiring:
        """What a step of this run does: a ``StepModel`` where the law is linear, else its wiring alone."""
        return build_model(self.experiment, self.matrices)

    @property
    def step_model(self) -> StepModel:
        """What a step of this run does. InputError: it has a protocol that is not linear, or not here."""
        return self.model if isinstance(self.model, StepModel) else build_step_model(self.experiment)

    @property
    def planned_steps(self) -> int:
        """Number of steps that were planned before the run."""
        return self.planned or self.experiment.steps

    @cached_property
    def digest(self) -> int:
        """A number below 2**60 that two records share only if nodes with them can make one run together.

        Process noise is left out: it is an agent's own, and a fault may be made with it on purpose.
        """
        document = self.experiment.to_document()
        noise = {key: value for key, value in document["noise"].items() if key != "process"}
        shared = [str(self.run), document | {"noise": noise}, str(self.until), self.planned]
        found = hashlib.sha256(json.dumps(shared, sort_keys=True).encode() + self.start.tobytes())
        return int.from_bytes(found.digest()[:8]) >> 4

    def ended(self, step: int) -> RunRecord:
        """The record of this run, which has ended at a step before its last one: that of a complete, shorter run."""
        experiment = self.experiment
        document = experiment.to_document()
        document["run"]["duration"] = step * experiment.step_length
        info = experiment.protocol.info if experiment.protocol else None
        shorter = Experiment.parse(document, source=experiment.source, recorded=info)
        return replace(self, experiment=shorter, planned=self.planned_steps)

    def to_json(self, *, with_key: bool = False) -> str:
        """The document, for the nodes of the run with its key; numbers survive the round trip to the last bit."""
        document: dict[str, Any] = {
            "format": FORMAT,
            "run": str(self.run),
            "experiment": self.experiment.to_document(),
            "start": self.start.tolist(),
            "versions": self.versions,
            "started": self.started.isoformat(),
        }
        if self.until:
            document["until"] = str(self.until)
        if self.planned:
            document["planned_steps"] = self.planned
        if self.experiment.protocol:
            document["protocol"] = self.experiment.protocol.info.to_json()
        if self.matrices:
            document["step"] = {"weights": [_entries(matrix) for matrix in self.matrices.weights]}
            if self.experiment.protocol:
                document["step"]["noise_gain"] = [_entries(matrix) for matrix in self.matrices.noise_gain]
        if with_key and self.key:
            document["key"] = self.key.hex()
        return json.dumps(document)

    @classmethod
    def from_json(cls, text: str, source: str) -> RunRecord:
        """Read what ``to_json`` wrote; ``source`` is for messages. InputError: it is something else, or not valid."""
        try:
            document: Any = json.loads(text)
            if document["format"] != FORMAT:
                raise InputError(
                    f"{source}: run record of format {document['format']}, expected {FORMAT}: "
                    "read it with the version of msg_analysis that wrote it"
                )
            protocol = ProtocolInfo.from_json(document.get("protocol"))
            experiment = Experiment.parse(document["experiment"], source=source, recorded=protocol)
            start = np.array(document["start"], dtype=float)
            step = document.get("step")
            matrices = None if step is None else _matrices(step, experiment, source)
            if matrices is None and experiment.time == "discrete" and not experiment.protocol:
                raise InputError(f"{source}: step: missing: expected the matrices of a step: record the run again")
            run, versions = uuid.UUID(document["run"]), dict(document["versions"])
            key = bytes.fromhex(document["key"]) if "key" in document else None
            until = Until.parse(document["until"], f"{source}: until") if "until" in document else None
            planned = int(document["planned_steps"]) if "planned_steps" in document else None
            if planned is not None and planned <= experiment.steps:
                raise InputError(f"{source}: planned_steps: {planned}: expected more than the {experiment.steps} made")
            record = cls(run, experiment, start, versions, matrices, key, _started(document), until, planned)
        except InputError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise InputError(f"{source}: not a run record ({type(error).__name__}: {error})") from error
        expected = (experiment.agents, experiment.width)
        if start.shape != expected or not np.isfinite(start).all():
            raise InputError(f"{source}: start has shape {start.shape}, expected finite numbers of shape {expected}")
        return record


def _started(document: dict[str, Any]) -> datetime.datetime:
    found = datetime.datetime.fromisoformat(document["started"])
    return (found if found.tzinfo else found.replace(tzinfo=datetime.UTC)).astimezone(datetime.UTC)


def _entries(matrix: FloatArray) -> list[list[float]]:
    """[i, j, value] of all that is not 0, agents from 1."""
    return [[int(i) + 1, int(j) + 1, float(matrix[i, j])] for i, j in np.argwhere(matrix)]


def _matrices(document: Any, experiment: Experiment, source: str) -> StepMatrices:
    stacks = {"noise_gain": step_noise_gain(experiment)}
    for key in ("weights", "noise_gain")[: 2 if experiment.protocol else 1]:
        stack = np.zeros((len(experiment.graph_list), experiment.agents, experiment.agents))
        if len(document[key]) != len(stack):
            raise InputError(f"{source}: step.{key} has {len(document[key])} graphs, expected {len(stack)}")
        for mode, listed in enumerate(document[key]):
            entries = np.array(listed, dtype=float).reshape(-1, 3)
            agents = entries[:, :2].astype(np.int64) - 1
            if (agents < 0).any() or (agents >= experiment.agents).any() or not np.isfinite(entries).all():
                wanted = f"[agent, agent, finite number], agents from 1 to {experiment.agents}"
                raise InputError(f"{source}: step.{key} of graph {mode + 1}: expected entries {wanted}")
            stack[mode, agents[:, 0], agents[:, 1]] = entries[:, 2]
        stacks[key] = stack
    return StepMatrices(**stacks)
