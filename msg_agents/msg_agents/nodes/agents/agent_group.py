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

"""The agents of one process: what they share, and how they hear each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from rclpy.publisher import Publisher

from msg_agents.nodes.agents.agent import Agent
from msg_agents.nodes.agents.batch_links import BatchLinks, Listener, hears_most
from msg_agents.nodes.agents.lockstep_agent import LockstepAgent
from msg_agents.nodes.agents.realtime_agent import RealtimeAgent
from msg_agents.nodes.agents.state_batches import StateBatches
from msg_agents.nodes.network_node import NOT_AN_AGENT
from msg_agents.processes.process_plan import RECORDER
from msg_agents.stepping.turn_queue import TurnQueue
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.wire import topics
from msg_analysis.wire.messages import with_state

AGENTS: dict[str, type[Agent]] = {"lockstep": LockstepAgent, "realtime": RealtimeAgent}  # by pace
PROGRESS_PERIOD = 0.2  # s of wall time between two Progress messages of an agent, in a small network
MOST_REPORTS = 250.0  # Progress messages a second from a whole network: the switcher reads all of them


class AgentGroup:
    """Agents as nodes of one process: states pass directly between them, and on topics to all other nodes."""

    # Every endpoint is announced to every process. So what agents can share exists once per group, on the node of its
    # first agent: graph, progress, end, resend.

    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        agents: Sequence[int],  # indices from 0, at least one
        readers: Sequence[str],  # other nodes that must read the states before the run starts
        checkpoints: Path | None = None,  # directory of the published states, from which agents resume
    ) -> None:
        self.turns = TurnQueue(len(agents), self._defer, self._end_turns)
        self.progress_period = max(PROGRESS_PERIOD, model.agents / MOST_REPORTS)
        listens = model.listens()
        exchanges = listens | listens.T
        self._agents: dict[int, Agent] = {}
        kind = AGENTS[record.experiment.run.pace]
        for i in agents:
            self._agents[i] = kind(
                record=record,
                model=model,
                agent=i,
                peers=[int(j) for j in exchanges[i].nonzero()[0]],
                colleagues=agents,
                readers=readers,
                checkpoints=checkpoints,
                group=self,
            )
        self.nodes = list(self._agents.values())  # in the order of ``agents``
        self._host = self.nodes[0]
        self._states = StateBatches(self._host, topics.STATES)
        self._links = BatchLinks(self._host, self._states.publisher, agents)
        self._connect()
        self._host.create_shared(self.nodes)
        self._progress = self._host.publisher_of(topics.PROGRESS)
        self._awaits_recorder = RECORDER in readers
        self._truths = StateBatches(self._host, topics.TRUTHS) if record.experiment.truth else None
        self._resend: Publisher | None = None
        self._sending = False  # whether ``_send_states`` will be called
        self._asked: dict[int, int] = {}  # agents (from 0) that are to be asked for their states from a step on
        if any(agent.resumed for agent in self.nodes):  # which will ask: in time to be discovered with the rest
            self._resend = self._host.publisher_of(topics.RESEND)
        self._host.subscribe(topics.GRAPH, self._receive_graph)
        self._host.subscribe(topics.RESEND, self._receive_resend)
        if record.until:
            self._host.subscribe(topics.STOP, self._receive_stop)
        self._host.finish_at_end(self.nodes)

    def _connect(self) -> None:
        listeners: dict[int, list[Listener]] = {}
        for agent in self.nodes:
            agent.connect(self._agents)
            for j in agent.far:
                listeners.setdefault(j, []).append(Listener(agent.hear, agent.refuse))
        if not (self._host.hears_batches and self._links.listen(listeners)):
            for agent in self.nodes:
                agent.subscribe_to_far()

    def _end_turns(self) -> None:
        if self._links.heard and not self._sending:  # other processes wait for these states
            self._sending = True
            self._defer(self._send_states)  # after what has come meanwhile, which may let others step

    def _send_states(self) -> None:
        self._sending = False
        self._states.send()

    def _defer(self, callback: Callable[[], None]) -> None:
        self._host.executor.create_task(callback)

    def fail(self, error: Exception) -> None:
        """End the process with the error of an agent."""
        for agent in self.nodes:
            agent.fail(error)

    def record_state(self, message: bytes) -> None:
        """Send a state as other agents hear it to the recorder."""
        self._states.add(message)

    def record_truth(self, message: bytes) -> None:
        """Send the exact state, where that is another one."""
        assert self._truths is not None
        self._truths.add(message)

    def record_contradiction(self, message: bytes, state: bytes) -> None:
        """Tell the recorder that an agent has heard two states of one step, this message and another ``state``.

        One of them is forged, and nobody can know which: in the bag are both, so that nothing is concluded from them.
        """
        self._states.add(with_state(message, state))
        self._states.add(message)

    def send_batches(self) -> None:
        """Send to the recorder at once what has been collected for it."""
        for batches in (self._states, self._truths):
            if batches is not None:
                batches.send()

    def missing_recorder(self) -> list[str]:
        """The recorder, if it is awaited and has not been discovered."""
        if not self._awaits_recorder:
            return []
        return self._states.missing_nodes() + (self._truths.missing_nodes() if self._truths else [])

    def report(self, agent: int, step: int) -> None:
        """Tell the switcher which step an agent (index from 0) has reached."""
        self._host.publish(self._progress, self._host.progress(topics.PROGRESS, agent + 1, step))

    def ask_again(self, agent: int, step: int) -> None:
        """Ask an agent of another process (index from 0) for its states from a step on, once for all that hear it."""
        if not self._asked:
            self._defer(self._send_requests)
        self._asked[agent] = min(step, self._asked.get(agent, step))

    def _send_requests(self) -> None:
        asked, self._asked = self._asked, {}
        if self._resend is None:  # rarely needed; latched, so a late discovery only takes its time
            self._resend = self._host.publisher_of(topics.RESEND)
        if hears_most(len(asked), self._host.record.experiment.agents - len(self.nodes)):
            self._host.publish(self._resend, self._host.progress(topics.RESEND, NOT_AN_AGENT, min(asked.values())))
            return
        for agent, step in asked.items():
            self._host.publish(self._resend, self._host.progress(topics.RESEND, agent + 1, step))

    def reached(self) -> frozenset[str]:
        """Names of the agents of other processes that hear those of this one by batches."""
        return self._links.reached()

    def hears_all(self) -> bool:
        """Whether all processes that this one hears by batches have been discovered."""
        return self._links.hears_all()

    def _receive_resend(self, data: bytes) -> None:
        request = self._host.decode_progress(data, topics.RESEND)
        if request is None:
            return
        for agent in self.nodes:
            if request.agent in (NOT_AN_AGENT, agent.number):
                agent.send_again(request.step)

    def _receive_stop(self, data: bytes) -> None:
        stop = self._host.decode_progress(data, topics.STOP)
        if stop is not None:
            for agent in self.nodes:
                agent.end_at(stop.step)

    def _receive_graph(self, data: bytes) -> None:
        self._host.rules.forget(min(agent.step for agent in self.nodes))
        graph = self._host.decode_graph(data)
        if graph is None:
            return
        # Agents that take over are at different steps: what is new to one may be known to another.
        for reason in {agent.learn(graph) for agent in self.nodes}:
            if reason:
                self._host.refuse(reason, topics.GRAPH.name)
