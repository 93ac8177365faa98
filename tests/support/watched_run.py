"""A run given to a watcher message by message, as its topics would."""

import random

from msg_analysis.bags import writing
from msg_analysis.inference.evidence_sums import EvidenceSums
from msg_analysis.inference.observation import Observation
from msg_analysis.inference.online_errors import LiveEstimate, LiveReport
from msg_analysis.messages.acceptance import state_frame
from msg_analysis.messages.messages import ActiveGraph
from msg_analysis.model.run import Run
from msg_analysis.theory.prediction import Prediction


def messages_of(trajectory: Run) -> list[tuple[str, bytes]]:
    """(topic, message) in the order of time, as a bag has them (``test_messages_are_those_of_the_bag``)."""
    return [(topic, content) for topic, content, _, _ in writing._messages(trajectory, writing.BLOCK_NUMBERS)]


def watch(
    live: LiveEstimate, messages: list[tuple[str, bytes]], *, disorder: float = 0.0, every: int = 200
) -> LiveReport:
    """Give the messages to a watcher, which looks from time to time; ``disorder``: steps by which states are late."""
    experiment, rng = live.record.experiment, random.Random(1)
    whole, said = state_frame(live.record, whole=True), state_frame(live.record, whole=False)
    states = []
    for topic, data in messages:
        kind = topic.rsplit("/", 1)[1]
        if kind == "graph":
            graph = ActiveGraph.decode(data)
            live.add_holding_period(graph.first_step, graph.last_step, graph.mode - 1)
        elif kind in ("state", "truth"):
            published = kind == "state" and experiment.truth
            found = (said if published else whole).unwrap(data)
            if not published or live.needs_published:
                states.append((found[1] + disorder * rng.random(), found, data, published))
    for number, (_, found, data, published) in enumerate(sorted(states, key=lambda state: state[0])):
        agent, step, mode, payload = found
        live.add(agent - 1, step, mode, payload, data, published=published)
        if number % every == every - 1:
            live.report()
    return live.report()


def watched(trajectory: Run, *, disorder: float = 0.0, every: int = 200) -> LiveEstimate:
    """A watcher that has seen a whole run."""
    live = LiveEstimate(trajectory.record)
    watch(live, messages_of(trajectory), disorder=disorder, every=every)
    return live


def whole_sums(trajectory: Run, prediction: Prediction) -> EvidenceSums:
    """The sums of a comparison, without diagnostics."""
    return sums_of(Observation.of(trajectory, prediction), 400)


def sums_of(observation: Observation, size: int = 10**9, *, in_detail: bool = False) -> EvidenceSums:
    """The sums of a run, in blocks of so many steps."""
    sums = EvidenceSums(observation.prediction, observation.replicas, in_detail=in_detail)
    for first in range(0, observation.steps, size):
        sums.add(observation, first, min(first + size, observation.steps))
    return sums
