"""The agents of one process: what they share, and how they hear each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from msg_agents_interfaces.msg import ActiveGraph as ActiveGraphMsg
from msg_agents_interfaces.msg import Progress as ProgressMsg
from rclpy.publisher import Publisher

from msg_agents.nodes.agents.agent import Agent
from msg_agents.nodes.agents.lockstep_agent import LockstepAgent
from msg_agents.nodes.agents.realtime_agent import RealtimeAgent
from msg_agents.nodes.network_node import GRAPH_TOPIC, OTHER_RUN, PROGRESS_TOPIC, RESEND_TOPIC, UNDECODABLE
from msg_agents.nodes.ros.qos import LATCHED
from msg_agents.stepping.synchronizer import AGAIN, Refusal
from msg_agents.stepping.turn_queue import Turns
from msg_analysis.model.run.record import RunRecord
from msg_analysis.model.step.step_model import Wiring
from msg_analysis.wire.cdr_fields import CdrError
from msg_analysis.wire.messages import ActiveGraph

AGENTS: dict[str, type[Agent]] = {"lockstep": LockstepAgent, "realtime": RealtimeAgent}  # by pace
PROGRESS_PERIOD = 0.2  # s of wall time between two Progress messages of an agent, in a small network
MOST_REPORTS = 250.0  # of them a second from a whole network: the switcher reads them all


class AgentGroup:
    """Agents as nodes of one process.

    Every endpoint has to be made known to every process. So what an agent need not have for itself the group has once,
    on the node of its first agent: graph, progress, end, resend. And states go from one to the other directly, as in
    ROS's own communication within a process, and on their topics to everybody else.

    Parameters
    ----------
    record
        of the run
    model
        its step model, or wiring
    agents
        indices from 0, at least one
    readers
        names of the nodes, besides the other agents, that must read the states before the run starts
    checkpoints
        directory that keeps what the agents have published, from which they go on if they have been there before

    Attributes
    ----------
    nodes
        the agents, in this order
    turns
        of the agents
    progress_period
        s of wall time between two Progress messages of an agent
    """

    def __init__(
        self,
        *,
        record: RunRecord,
        model: Wiring,
        agents: Sequence[int],
        readers: Sequence[str],
        checkpoints: Path | None = None,
    ) -> None:
        self.turns = Turns(len(agents), self._defer)
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
        self.nodes = list(self._agents.values())
        for agent in self.nodes:
            agent.meet(self._agents)
        self._host = self.nodes[0]
        self._host.host(self.nodes)
        self._progress = self._host.create_publisher(ProgressMsg, PROGRESS_TOPIC, LATCHED)
        self._resend: Publisher | None = None
        self._sojourns: dict[int, tuple[int, int, int]] = {}  # taken: what they said, by sequence number
        self._host.create_subscription(ActiveGraphMsg, GRAPH_TOPIC, self._receive_graph, LATCHED, raw=True)
        self._host.create_subscription(ProgressMsg, RESEND_TOPIC, self._receive_resend, LATCHED, raw=True)
        self._host.leave_at_end(self.nodes)

    def _defer(self, callback: Callable[[], None]) -> None:
        self._host.executor.create_task(callback)

    def fail(self, error: Exception) -> None:
        """End the process because an agent cannot go on.

        Parameters
        ----------
        error
            that the agent ended with
        """
        for agent in self.nodes:
            agent.fail(error)

    def report(self, agent: int, step: int) -> None:
        """Tell the switcher how far an agent is.

        Parameters
        ----------
        agent
            index from 0
        step
            that it has reached
        """
        self._host.publish(self._progress, self._host.progress(agent + 1, step))

    def ask_again(self, agent: int, step: int) -> None:
        """Ask an agent of another process for its states from a step on.

        Parameters
        ----------
        agent
            index from 0
        step
            first step that is wanted
        """
        if self._resend is None:  # hardly ever needed; latched, so that it does not matter when it is matched
            self._resend = self._host.create_publisher(ProgressMsg, RESEND_TOPIC, LATCHED)
        self._host.publish(self._resend, self._host.progress(agent + 1, step))

    def _receive_resend(self, data: bytes) -> None:
        request = self._host.decode_progress(data, RESEND_TOPIC)
        agent = request and self._agents.get(request.agent - 1)
        if request and agent:
            agent.send_again(request.step)

    def _receive_graph(self, data: bytes) -> None:
        try:
            graph = ActiveGraph.decode(data)
        except CdrError:
            self._host.refuse(UNDECODABLE, GRAPH_TOPIC)
            return
        if graph.run != self._host.run:
            self._host.refuse(OTHER_RUN, GRAPH_TOPIC)
            return
        # Agents that take over are at different steps: what is new to one may be known to another.
        reasons = {agent.learn(graph) for agent in self.nodes}
        claim = (graph.mode, graph.first_step, graph.last_step)
        if None in reasons:
            self._sojourns[graph.sequence] = claim
            self._sojourns.pop(graph.sequence - AGAIN, None)
        elif self._sojourns.get(graph.sequence, claim) != claim:
            reasons = {Refusal.CONTRADICTION}
        for reason in reasons:
            if reason:
                self._host.refuse(reason, GRAPH_TOPIC)
