# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""An agent of a run in a program of its user: the step is the user's, all that a run asks of an agent is done here."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from rclpy.node import Node

from msg_agents.environment import DISCOVERY_TIMEOUT
from msg_agents.nodes.agent import Agent
from msg_agents.nodes.agent_group import AgentGroup
from msg_agents.nodes.process import run_nodes
from msg_agents.process_layout import RECORDER
from msg_analysis.arithmetic.update_law import from_payload, to_payload
from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.files import read_text
from msg_analysis.errors import InputError
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.protocols import ProtocolError
from msg_analysis.model.reception import AgentAir
from msg_analysis.model.run_record import RunRecord
from msg_analysis.model.step_model import Wiring


def _read(file: str | Path) -> RunRecord:
    try:
        return RunRecord.from_json(read_text(Path(file)), str(file))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read ({error}): expected what `msg-agents prepare` prints") from error


class ExternalAgent:
    """The base class. Subclass it, write ``step``, and call ``run``; the other nodes are started as usual.

    Parameters
    ----------
    record
        the run record, or its file, of ``msg-agents prepare`` or as ``msg-agents run`` says
    agent
        number of this agent, from 1; the agents of other programs run beside it
    readers
        other nodes that must be there before the run starts; by default the recorder

    Attributes
    ----------
    experiment
        what is run: ``graph_list``, ``step_length``, ``run``, ...
    number
        of this agent, from 1

    Raises
    ------
    InputError
        a record that cannot be read, an agent that it does not have, or a protocol
    """

    def __init__(self, record: str | Path | RunRecord, agent: int, *, readers: Sequence[str] = (RECORDER,)) -> None:
        self._record = record if isinstance(record, RunRecord) else _read(record)
        self.experiment, self.number, self._readers = self._record.experiment, agent, readers
        if not 1 <= agent <= self.experiment.agents:
            raise InputError(f"agent: {agent}: expected a number from 1 to {self.experiment.agents}")
        if self.experiment.protocol:
            raise InputError("protocol: expected the built-in law: agents of a protocol are in its package")

    def step(self, k: int, graph: Graph, own: FloatArray, heard: Mapping[int, FloatArray]) -> ArrayLike:
        """The next state: x(k+1), its own noise included.

        Parameters
        ----------
        k
            number of the step, from 0
        graph
            the active one: ``name``, ``adjacency`` (weights in the row of this agent), ``arcs``
        own
            (R,) x(k), one value for each replica, read-only
        heard
            (R,) of each neighbour in this graph, by number, what was received of it; without those whose message
            was lost (``noise.on_loss: own``)

        Returns
        -------
        ArrayLike
            (R,), or one number for all replicas
        """
        raise NotImplementedError

    def connected(self, node: Node) -> None:
        """Called once with the node of the agent, for topics of one's own, before others are looked for."""

    def missing(self) -> list[str]:
        """What must be there before the run starts, beside its nodes; asked again and again until it is empty."""
        return []

    def started(self, first: int) -> None:
        """In real time: called once, when it is known that the first step is due at this time of the clock [ns]."""

    def waiting_for(self) -> str | None:
        """In real time: called about once a second; what it lacks, in words, for who watches the run."""

    def make_nodes(self, checkpoints: Path | None = None) -> Sequence[Agent]:
        """Its node, once ROS is there; ``checkpoints``: where its states are kept for who watches the run."""
        law = ExternalLaw(self._record, self._record.model, self)
        group = AgentGroup(
            record=self._record,
            model=self._record.model,
            agents=[self.number - 1],
            readers=list(self._readers),
            checkpoints=checkpoints,
            law=lambda _record, _model, _agent: law,
            program=self,
        )
        self.connected(group.nodes[0])
        return group.nodes

    def run(self, *, discovery_timeout: float = DISCOVERY_TIMEOUT) -> bool:
        """Take part in the run, to its end; False if it was stopped before, by a signal.

        Raises
        ------
        InputError
            the other nodes were not found within ``discovery_timeout`` [s], or ``step`` has failed: ``__cause__``
        """
        executor = os.environ.get("MSG_AGENTS_EXECUTOR") or "events"
        throughput = self.experiment.run.pace == "lockstep"
        return run_nodes(
            self.make_nodes,
            executor=executor,
            throughput=throughput,
            discovery_timeout=discovery_timeout,
            one_record=False,
        )


class ExternalLaw:
    """The step of an external agent, with the interface of ``AgentLaw``."""

    def __init__(self, record: RunRecord, model: Wiring, owner: ExternalAgent) -> None:
        self.agent, self.step = owner.number - 1, 0
        self.state = to_payload(record.start[self.agent])
        self.heard: tuple[int, ...] = ()
        self.air = AgentAir(record.experiment, model, self.agent)
        self._owner, self._graphs = owner, record.experiment.graph_list
        self._neighbours = [model.neighbours(mode, self.agent).tolist() for mode in range(model.modes)]

    def resume(self, step: int, state: bytes) -> None:
        """See AgentLaw."""
        self.step, self.state = step, state

    def neighbours(self, mode: int) -> list[int]:
        """See AgentLaw."""
        return list(self._neighbours[mode])

    def published(self, step: int, state: bytes) -> bytes:
        """See AgentLaw."""
        return self.air.published(step, from_payload(state)) if self.air.broadcast else state

    def advance(self, mode: int, heard: list[bytes], steps: Sequence[int] | None = None) -> bytes:
        """See AgentLaw. ProtocolError: the step of the user has failed."""
        senders, own = self._neighbours[mode], from_payload(self.state)
        values, self.heard = self.air.receive(senders, self.step, heard, steps)
        received = {j + 1: from_payload(value) for j, value in zip(senders, values, strict=True) if value is not None}
        place = f"{type(self._owner).__name__} of agent {self.agent + 1}, step {self.step}"
        try:
            found = np.asarray(self._owner.step(self.step, self._graphs[mode], own, received), dtype=float)
            state = np.broadcast_to(found, own.shape)
        except Exception as error:
            raise ProtocolError(f"{place}: {type(error).__name__}: {error}") from error
        if not np.isfinite(state).all():
            raise ProtocolError(f"{place}: {state.tolist()}: expected finite numbers")
        self.state = to_payload(np.ascontiguousarray(state))
        self.step += 1
        return self.state
