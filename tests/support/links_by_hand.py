"""Runs with noise, loss and delay on the air, from the definitions in docs/network.md alone: numbers, lists, loops."""

from bisect import bisect_right
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Run
from msg_analysis.model.step_model import StepModel, phases, step_noise_gain

BLOCK = 256
PROCESS, BROADCAST, LINK, LOSS = 3, 4, 5, 6  # numbers of the streams
FORGOTTEN = 4  # blocks after which no burst of these tests goes on


class Links:
    """Noise and loss of every message of a run; who hears whom under each graph."""

    def __init__(self, what: Experiment, model: Any) -> None:
        self._noise, self._loss, self._replicas = what.noise, what.loss.tolist(), what.run.replicas
        self._key = np.random.SeedSequence(what.run.seed).generate_state(2, np.uint64)
        self.normal, self._uniform, self._chain = cache(self._normals), cache(self._uniforms), cache(self._fates)
        gain = model.noise_gain if isinstance(model, StepModel) else step_noise_gain(what)
        self.sources = cache(lambda g, i: [(j, w) for j, w in enumerate(gain[g][i].tolist()) if w])
        self.senders = cache(lambda g, i: model.neighbours(g, i).tolist())
        self.inputs = cache(lambda g, i: [(j, float(model.nominal[g, i, j])) for j in model.inputs(g, i).tolist()])

    def _philox(self, stream: int, number: int, block: int) -> np.random.Generator:
        counter = [0, block % 2**64, number, stream]
        return np.random.Generator(np.random.Philox(key=self._key, counter=np.array(counter, dtype=np.uint64)))

    def _normals(self, stream: int, number: int, block: int) -> list[list[float]]:
        return self._philox(stream, number, block).standard_normal((BLOCK, self._replicas)).tolist()

    def _uniforms(self, i: int, j: int, block: int) -> list[float]:
        return self._philox(LOSS, i * 2**32 + j, block).random(BLOCK).tolist()

    def _fates(self, i: int, j: int, block: int) -> list[bool]:
        """Of the messages of a block, from long before it on."""
        p, burst = self._loss[i][j], self._noise.burst
        after_kept, after_lost = (p, p) if burst is None else (p / (burst * (1 - p)), 1 - 1 / burst)
        lost, fates = False, []
        for number in range(block - FORGOTTEN if burst else block, block + 1):
            fates = []
            for u in self._uniform(i, j, number):
                lost = p > 0 and u < (after_lost if lost else after_kept)
                fates.append(lost)
        return fates

    def lost(self, i: int, j: int, k: int) -> bool:
        """Whether the message of step k from j to i is lost."""
        return self._chain(i, j, k // BLOCK)[k % BLOCK] and not (k == 0 and self._noise.on_loss == "hold")

    def said(self, j: int, k: int, value: list[float]) -> list[float]:
        """What j publishes of its value."""
        s = self._noise.broadcast
        return [v + s * b for v, b in zip(value, self.of(BROADCAST, j, k), strict=True)] if s else value

    def received(self, i: int, j: int, k: int, said: list[float]) -> list[float]:
        """The same as i receives it."""
        s = self._noise.link
        return [v + s * n for v, n in zip(said, self.of(LINK, i * 2**32 + j, k), strict=True)] if s else said

    def of(self, stream: int, number: int, k: int) -> list[float]:
        return self.normal(stream, number, k // BLOCK)[k % BLOCK]


def choose(what: Experiment, inbox: list[int], lost: Callable[[int], bool]) -> int | None:
    """The step of the message that is used, of those that came (ascending); None: the own value."""
    usable = max(0, inbox[-1] - what.noise.delay) if inbox else 0
    for place in reversed(range(bisect_right(inbox, usable))):
        if not lost(inbox[place]):
            return inbox[place]
        if what.noise.on_loss != "hold":
            return None
    return None


def assert_by_hand(trajectory: Run) -> None:
    """Compute a run of the twin again: every state, publication and log entry, to the last bit."""
    what, model = trajectory.record.experiment, trajectory.record.model
    links, m, real_time = Links(what, model), what.agents, what.run.pace == "realtime"
    step_of = STEPS[what.protocol.info.name if what.protocol and not isinstance(model, StepModel) else ""]
    x: list[Any] = trajectory.states[0].tolist()
    values = [row[: what.run.replicas] for row in x]
    published: list[list[list[float]]] = [[links.said(j, 0, value)] for j, value in enumerate(values)]
    order = np.argsort(phases(what)).tolist() if real_time else list(range(m))
    inbox = [[0] for _ in range(m)]  # steps published by each agent, and received by all others
    for k, g in enumerate(trajectory.modes.tolist()):
        after: list[Any] = [None] * m
        for i in order:
            heard: dict[int, list[float]] = {}
            for d, j in enumerate(links.senders(g, i)):
                step = choose(what, inbox[j], lambda step, i=i, j=j: links.lost(i, j, step))
                newest = max(0, inbox[j][-1] - what.noise.delay)
                if trajectory.used is not None:
                    assert trajectory.used[k, i, d] == (-1 if step is None else step)
                if trajectory.lost is not None:
                    assert trajectory.lost[k, i, d] == (step != newest) == links.lost(i, j, newest)
                if step is not None:
                    heard[j] = links.received(i, j, step, published[j][step])
            after[i] = step_of(what, model, links, k, g, i, x[i], heard)
            assert after[i] == trajectory.states[k + 1, i].tolist(), (k, i)
            if real_time:
                published[i].append(links.said(i, k + 1, after[i][: what.run.replicas]))
                inbox[i].append(k + 1)
        if not real_time:
            for i in range(m):
                published[i].append(links.said(i, k + 1, after[i][: what.run.replicas]))
                inbox[i].append(k + 1)
        x = after
    if trajectory.published is not None:
        assert trajectory.published.transpose(1, 0, 2).tolist() == published
    assert (trajectory.published is not None) == what.truth
    assert (trajectory.lost is not None) == (not real_time and what.noise.loss.any)
    assert (trajectory.used is not None) == bool(real_time or what.noise.delay or what.noise.holds)


def _noise(what: Experiment, links: Links, k: int, g: int, i: int) -> list[float]:
    """Row i of the noise gain (m, m) times the sources, in ascending order."""
    total = [0.0] * what.run.replicas
    for number, (j, weight) in enumerate(links.sources(g, i)):
        source = links.of(PROCESS, j, k)
        total = [weight * s if number == 0 else t + weight * s for t, s in zip(total, source, strict=True)]
    return total


def _linear(what: Experiment, model: Any, links: Links, k: int, g: int, i: int, x: Any, heard: Any) -> list[float]:
    noise, offset = _noise(what, links, k, g, i), float(model.offsets[g, i])
    following = []
    for r in range(what.run.replicas):
        total = None
        for j, weight in links.inputs(g, i):
            term = weight * heard.get(j, x)[r]
            total = term if total is None else total + term
        following.append(total + (noise[r] + offset))
    return following


def _pull(what: Experiment, g: int, i: int, felt: dict[int, list[float]]) -> list[float]:
    total = [0.0] * what.run.replicas
    for number, (j, values) in enumerate(sorted(felt.items())):
        weight = float(what.graph_list[g].adjacency[i, j])
        total = [weight * v if number == 0 else t + weight * v for t, v in zip(total, values, strict=True)]
    return total


def _saturated(what: Experiment, model: Any, links: Links, k: int, g: int, i: int, x: Any, heard: Any) -> list[float]:
    felt = {j: [min(max(v - o, -1.0), 1.0) for v, o in zip(values, x, strict=True)] for j, values in heard.items()}
    noise, pull = _noise(what, links, k, g, i), _pull(what, g, i, felt)
    return [o + what.step_length * u + n for o, u, n in zip(x, pull, noise, strict=True)]


def _integral_action(
    what: Experiment, model: Any, links: Links, k: int, g: int, i: int, x: Any, heard: Any
) -> list[float]:
    replicas, dt = what.run.replicas, what.step_length
    own, integral = x[:replicas], x[replicas:]
    pull = _pull(what, g, i, {j: [v - o for v, o in zip(values, own, strict=True)] for j, values in heard.items()})
    noise = _noise(what, links, k, g, i)
    return [
        *(o + dt * (u + 1.0 * z + 0.0) + n for o, u, z, n in zip(own, pull, integral, noise, strict=True)),
        *(z + dt * u for z, u in zip(integral, pull, strict=True)),
    ]


STEPS: dict[str, Callable[..., list[float]]] = {
    "": _linear,
    "saturated": _saturated,
    "integral_action": _integral_action,
}
