# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The channel file: which agents are on which host, and what happens to the packets between two hosts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from msg_agents.channel.links import LinkSettings, LossModel
from msg_agents.process_layout import agent_numbers, assignment_problems, process_name, split_agents, validated
from msg_analysis.common.arrays import BoolArray, FloatArray
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.loading import read_yaml
from msg_analysis.experiment.problems import ExperimentError, problem
from msg_analysis.experiment.values import expected, is_number

BASE = "base"  # the host of recorder and switcher
MOST_HOSTS = 250  # of agents
MTU = 65535  # bytes; every message of a run is then one packet
SECOND = 1e3  # ms


def _number(wanted: str, fits: Callable[[float], bool]) -> BeforeValidator:
    def check(value: object) -> object:
        if not is_number(value) or not fits(float(value)):
            raise expected(wanted)
        return float(value)

    return BeforeValidator(check)


Probability = Annotated[float, _number("a number >= 0 and < 1", lambda p: 0 <= p < 1)]
AnyProbability = Annotated[float, _number("a number from 0 to 1", lambda p: 0 <= p <= 1)]
Milliseconds = Annotated[float, _number("a number of milliseconds from 0 to 60000", lambda t: 0 <= t <= 60_000)]
Rate = Annotated[float, _number("a number of Mbit/s > 0", lambda r: r > 0)]
BurstLength = Annotated[float, _number("a number >= 1", lambda n: n >= 1)]


class TwoStates(BaseModel):
    """Gilbert-Elliott: losses come in bursts, since the link is in a good or in a bad state."""

    model_config = ConfigDict(extra="forbid")
    good: AnyProbability = Field(0.0, description="probability of a loss in the good state", examples=[0.0])
    bad: AnyProbability = Field(1.0, description="probability of a loss in the bad state", examples=[1.0])
    to_bad: AnyProbability = Field(description="probability per packet of good to bad", examples=[0.02])
    to_good: AnyProbability = Field(description="probability per packet of bad to good", examples=[0.2])


def _loss(value: object) -> object:
    if isinstance(value, dict | TwoStates):
        return value
    if not is_number(value) or not 0 <= value < 1:
        raise expected("a number >= 0 and < 1, or {good, bad, to_bad, to_good}")
    return TwoStates(good=value, bad=value, to_bad=0.0, to_good=1.0)


class LinkSpec(BaseModel):
    """What happens to the packets from one host to another; what is not given is that of ``default``."""

    model_config = ConfigDict(extra="forbid")
    loss: Annotated[TwoStates | None, BeforeValidator(_loss, json_schema_input_type=Probability | TwoStates)] = Field(
        None, description="probability that a packet is lost; or two states, for bursts", examples=[0.2]
    )
    burst: BurstLength | None = Field(
        None, description="packets that are lost in a row, on average; only beside a number as loss", examples=[5]
    )
    delay_ms: Milliseconds | None = Field(None, description="how long a packet takes [ms]", examples=[2])
    jitter_ms: Milliseconds | None = Field(
        None, description="the delay is uniform between delay_ms - jitter_ms and delay_ms + jitter_ms", examples=[1]
    )
    rate_mbit: Rate | None = Field(None, description="Mbit/s; no limit if left out", examples=[6])
    queue: Annotated[int, Field(strict=True, ge=0, le=1_000_000)] | None = Field(
        None, description="packets that wait while one is sent, at a limited rate; 100 if left out", examples=[100]
    )


class PairSpec(LinkSpec):
    """The same for one pair of hosts: one direction (sender, receiver), or both (between)."""

    sender: str | None = Field(None, description="the host that sends", examples=["left"])
    receiver: str | None = Field(None, description="the host that receives", examples=["right"])
    between: Annotated[list[str], Field(min_length=2, max_length=2)] | None = Field(
        None,
        description="both directions between two hosts, instead of sender and receiver",
        examples=[["left", "right"]],
    )

    @property
    def directions(self) -> list[tuple[str, str]]:
        """Sender and receiver; empty where neither form is given whole."""
        if self.between and self.sender is None and self.receiver is None:
            first, second = self.between
            return [(first, second), (second, first)]
        if self.sender is not None and self.receiver is not None and not self.between:
            return [(self.sender, self.receiver)]
        return []


class ChannelHostSpec(BaseModel):
    """One host."""

    model_config = ConfigDict(extra="forbid")
    agents: Annotated[list[int], BeforeValidator(agent_numbers, json_schema_input_type=list[int | str])] = Field(
        description="the agents that run there", examples=[[1, "3-5"]]
    )


class ChannelSpec(BaseModel):
    """The channel file as data."""

    model_config = ConfigDict(extra="forbid")
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**64)] = Field(
        0, description="of losses and delays", examples=[7]
    )
    hosts: dict[str, ChannelHostSpec] | None = Field(
        None,
        description=f"the hosts of the agents, by name; one for each process if left out. Recorder and switcher are on "
        f"another one, {BASE}",
        examples=[{"left": {"agents": [1, 2]}, "right": {"agents": ["3-5"]}}],
    )
    default: LinkSpec = Field(
        LinkSpec(), description="what happens to packets from any host to any other", examples=[{"loss": 0.2}]
    )
    pairs: list[PairSpec] = Field(
        [], description="pairs of hosts with settings of their own", examples=[[{"between": ["left", "right"]}]]
    )
    recorder: Literal["clean", "default"] = Field(
        "default",
        description=f"clean: packets from and to {BASE}, where recorder and switcher are, are neither lost nor delayed",
        examples=["clean"],
    )
    graph: bool = Field(
        False,
        strict=True,
        description="whether only hosts that a link of the active graph joins reach each other, once the run has begun",
        examples=[True],
    )
    mtu: Annotated[int, Field(strict=True, ge=576, le=MTU)] = Field(
        MTU, description="bytes of the largest packet; a larger message is several packets", examples=[1500]
    )


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel file that fits an experiment."""

    seed: int
    hosts: dict[str, tuple[int, ...]]  # agents, from 0, by host; the first host is that of recorder and switcher
    links: dict[tuple[str, str], LinkSettings]  # of all ordered pairs of hosts, by sender and receiver
    graph: bool  # whether hosts that no active link joins do not reach each other
    mtu: int

    @classmethod
    def load(cls, path: Path, experiment: Experiment) -> Channel:
        """Read a channel file (YAML); InputError if it cannot be read or does not fit the experiment."""
        return cls.parse(read_yaml(path), experiment, source=str(path))

    @classmethod
    def parse(cls, document: Any, experiment: Experiment, source: str = "channel") -> Channel:
        """Check a document from a YAML reader; the ExperimentError lists the mistakes, with ``source`` as place."""
        keys = f"expected some of the keys {', '.join(ChannelSpec.model_fields)}: see `msg-agents run --help`"
        spec = validated(ChannelSpec, document, source, keys)
        hosts, problems = _hosts(spec, experiment)
        default = _settings(spec.default, LinkSpec(), "default", problems)
        own = _pairs(spec, [BASE, *hosts], problems)
        if problems:
            raise ExperimentError(source, problems)
        links = {
            (sender, receiver): LinkSettings()
            if spec.recorder == "clean" and BASE in (sender, receiver)
            else own.get((sender, receiver), default)
            for sender in (BASE, *hosts)
            for receiver in (BASE, *hosts)
            if sender != receiver
        }
        return cls(spec.seed, {BASE: (), **hosts}, links, spec.graph, spec.mtu)

    def host_of(self, agents: Sequence[int]) -> str:
        """The host of a process with these agents; of recorder and switcher without any."""
        return next((name for name, there in self.hosts.items() if agents and agents[0] in there), BASE)

    def joined(self, used: BoolArray) -> BoolArray:
        """(n, H, H) whether a link joins two hosts in each graph, by who uses whose states, ``used`` (n, m, m)."""
        there = np.zeros((len(self.hosts), used.shape[1]), dtype=bool)
        for place, agents in enumerate(self.hosts.values()):
            there[place, list(agents)] = True
        links = np.einsum("hi,gij,kj->ghk", there, used, there) > 0
        joined: BoolArray = links | links.transpose(0, 2, 1)
        joined[:, 0, :] = joined[:, :, 0] = True  # the host of recorder and switcher
        return joined

    def agent_loss(self, agents: int) -> FloatArray:
        """(m, m) probability that a packet from agent j to agent i is lost; 0 on one host."""
        loss = np.zeros((agents, agents))
        for (sender, receiver), settings in self.links.items():
            loss[np.ix_(self.hosts[receiver], self.hosts[sender])] = settings.loss.mean
        return loss


def _hosts(spec: ChannelSpec, experiment: Experiment) -> tuple[dict[str, tuple[int, ...]], list[str]]:
    """Agents, from 0, by host, and the mistakes."""
    if spec.hosts is None:
        return {process_name(agents): agents for agents in split_agents(experiment)}, []
    problems = assignment_problems({name: host.agents for name, host in spec.hosts.items()}, experiment.agents)
    if BASE in spec.hosts:
        problems.append(problem("hosts", BASE, "is the host of recorder and switcher", "choose another name"))
    if len(spec.hosts) >= MOST_HOSTS:
        problems.append(problem("hosts", f"{len(spec.hosts)} hosts", f"expected fewer than {MOST_HOSTS}", "join some"))
    problems += [
        problem(f"hosts.{name}.agents", "[]", "expected at least one agent", "remove the host")
        for name, host in spec.hosts.items()
        if not host.agents
    ]
    return {name: tuple(sorted(number - 1 for number in host.agents)) for name, host in spec.hosts.items()}, problems


def _pairs(spec: ChannelSpec, hosts: Sequence[str], problems: list[str]) -> Mapping[tuple[str, str], LinkSettings]:
    """Settings of the pairs that have their own; mistakes are added to ``problems``."""
    found: dict[tuple[str, str], LinkSettings] = {}
    for number, pair in enumerate(spec.pairs, start=1):
        key = f"pairs[{number}]"
        if not pair.directions:
            wanted = "expected sender and receiver, or between"
            problems.append(problem(key, "which pair", wanted, "between: [left, right]"))
        settings = _settings(pair, spec.default, key, problems)
        for direction in pair.directions:
            words = f"from {direction[0]} to {direction[1]}"
            unknown = [name for name in direction if name not in hosts]
            if unknown:
                problems.append(problem(key, unknown[0], f"expected one of {', '.join(hosts)}", "name one of them"))
            elif direction[0] == direction[1]:
                problems.append(problem(key, words, "expected two hosts", "a host reaches itself without the channel"))
            elif direction in found:
                problems.append(problem(key, words, "a pair that is there already", "remove one"))
            elif spec.recorder == "clean" and BASE in direction:
                problems.append(problem(key, words, "contradicts recorder: clean", "remove one"))
            found[direction] = settings
    return found


def _settings(spec: LinkSpec, default: LinkSpec, key: str, problems: list[str]) -> LinkSettings:
    """Of a link; what is not given is that of ``default``. Mistakes are added to ``problems``, at the keys given."""
    given = {name: value for name in LinkSpec.model_fields if (value := getattr(spec, name)) is not None}
    link = default.model_copy(update=given)
    settings = LinkSettings(
        delay=(link.delay_ms or 0.0) / SECOND,
        jitter=(link.jitter_ms or 0.0) / SECOND,
        rate=inf if link.rate_mbit is None else link.rate_mbit,
        queue=LinkSettings().queue if link.queue is None else link.queue,
    )
    loss, burst = link.loss, link.burst
    if loss is not None:
        settings = replace(settings, loss=LossModel(loss.good, loss.bad, loss.to_bad, loss.to_good))
    if "loss" in given and loss is not None and not loss.to_good:
        problems.append(problem(f"{key}.loss.to_good", "0", "expected a number > 0", "or give a number as loss"))
    if loss is None or loss.good != loss.bad:
        if "burst" in given:
            wanted, remedy = "expected a number as loss beside it", "give one, or remove burst"
            problems.append(problem(f"{key}.burst", burst, wanted, remedy))
    elif burst is not None and burst >= (least := loss.good / (1 - loss.good)):
        settings = replace(settings, loss=LossModel.bursts(loss.good, burst))
    elif "burst" in given:
        wanted, remedy = f"expected at least {least:.4g}", f"with loss {loss.good:g} bursts are longer"
        problems.append(problem(f"{key}.burst", burst, wanted, remedy))
    elif burst is not None and "loss" in given:
        wanted = f"expected at most {burst / (1 + burst):.4g} with burst {burst:g}, which is that of `default`"
        problems.append(problem(f"{key}.loss", loss.good, wanted, "give a longer burst beside it"))
    if settings.jitter > settings.delay and given.keys() & {"jitter_ms", "delay_ms"}:
        jitter, delay, late = settings.jitter * SECOND, settings.delay * SECOND, "no packet arrives before it is sent"
        if "jitter_ms" in given:
            problems.append(problem(f"{key}.jitter_ms", jitter, f"expected at most delay_ms, {delay:g}", late))
        else:
            wanted = f"expected at least {jitter:g}, the jitter_ms of `default`"
            problems.append(problem(f"{key}.delay_ms", delay, wanted, late))
    if "queue" in given and settings.rate == inf:
        without = "has no effect without rate_mbit"
        problems.append(problem(f"{key}.queue", spec.queue, without, "give one, or remove it"))
    return settings


def json_schema() -> dict[str, Any]:
    """JSON Schema of the channel file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | ChannelSpec.model_json_schema()
