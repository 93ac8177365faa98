# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Protocols of other packages: find them, check them, and call them.

Whatever a protocol raises or returns wrongly becomes an error that names the protocol and its package.
"""

from __future__ import annotations

import difflib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.text import agent_text
from msg_analysis.errors import InputError
from msg_analysis.experiment.problems import problem, show, translate
from msg_analysis.experiment.validation import wrong_sums
from msg_analysis.protocol import ENTRY_POINTS, Heard, LinearProtocol, Network, Protocol

if TYPE_CHECKING:
    from msg_analysis.experiment.spec import ProtocolSpec, Purpose, RunSpec


Result = TypeVar("Result")
PACKAGE = Path(__file__).parents[1]


class ProtocolError(InputError):
    """A protocol has failed. The text names it, its package, and where; ``__cause__`` is what it raised."""


@dataclass(frozen=True, slots=True)
class ProtocolInfo:
    """What a run record says about a protocol: enough to read a bag without the protocol."""

    name: str  # in the experiment, and of the entry point
    package: str
    version: str  # of the package
    linear: bool  # declares the matrix of a step
    states: int = 1  # S: numbers in an agent's state, for each replica
    hidden: bool = False  # agents publish something else than their whole state

    def __str__(self) -> str:
        return f"protocol {self.name} ({self.package} {self.version})"

    def to_json(self) -> dict[str, Any]:
        """The document in the run record."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Any) -> ProtocolInfo | None:
        """Read what ``to_json`` gave, or None; ValueError, KeyError or TypeError if it is something else."""
        if document is None:
            return None
        if int(document["states"]) < 1:
            raise ValueError(f"protocol: states {document['states']}, expected a number >= 1")
        return cls(
            name=str(document["name"]),
            package=str(document["package"]),
            version=str(document["version"]),
            linear=bool(document["linear"]),
            states=int(document["states"]),
            hidden=bool(document["hidden"]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class ChosenProtocol:
    """The protocol of an experiment."""

    info: ProtocolInfo  # for a recorded run, what was used then
    kind: type[LinearProtocol | Protocol] | None = None  # None if ``absent``
    parameters: BaseModel | None = None  # None if ``absent``
    absent: str | None = None  # why it cannot be used here, for messages; None if it can
    network: Network | None = field(default=None, repr=False)  # set by ``bind``
    names: Sequence[str] | None = field(default=None, repr=False)  # of the agents, for messages; set by ``bind``

    @property
    def linear(self) -> bool:
        """Whether it is linear and installed, so that its matrices are available."""
        return self.info.linear and self.kind is not None

    def unpredictable(self) -> str | None:
        """Why there is no prediction; None where there is one."""
        if self.absent:
            return self.absent
        return None if self.info.linear else f"{self.info} is not linear, and runs without a prediction"

    def unavailable(self, purpose: Purpose) -> list[str]:
        """Why it cannot be used for a purpose, one line each."""
        name, reason = show(self.info.name), self.unpredictable()
        if self.absent:
            remedy = f"install {self.info.package} {self.info.version}"
            return [problem("protocol.name", name, f"expected an available protocol: {self.absent}", remedy)]
        if purpose == "run" or not reason:
            return []
        wanted = f"expected a linear protocol, but {reason}"
        return [problem("protocol.name", name, wanted, "use `simulate` or `msg-agents run`")]

    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """W_g and B_g, (n, m, m) each. InputError: not installed, not linear, fails, or returns something wrong."""
        reason = self.unpredictable()
        if reason:
            raise InputError(reason)
        assert self.kind is not None
        assert self.network is not None
        network, parameters, kind = self.network, self.parameters, self.kind
        made = self.guard("", lambda: kind(network, parameters))  # type: ignore[call-arg]  # a linear one
        assert isinstance(made, LinearProtocol)
        weights, gains = [], []
        for mode, graph in enumerate(network.graphs):
            where = f"graph {graph.name}"
            weights.append(self._matrix(f"{where}: weights", lambda mode=mode: made.weights(mode)))  # type: ignore[misc]
            gains.append(self._matrix(f"{where}: noise_gain", lambda mode=mode: made.noise_gain(mode)))  # type: ignore[misc]
            self._check_weights(where, weights[-1], graph.adjacency)
        return np.array(weights), np.array(gains)

    def _matrix(self, where: str, compute: Callable[[], Any]) -> FloatArray:
        assert self.network is not None
        return self.guard(where, lambda: _array(compute(), (self.network.agents,) * 2))  # type: ignore[union-attr]

    def _check_weights(self, where: str, weights: FloatArray, adjacency: FloatArray) -> None:
        deaf = (weights != 0.0) & (adjacency == 0.0) & ~np.eye(len(weights), dtype=bool)
        if deaf.any():
            i, j = (int(index) + 1 for index in np.argwhere(deaf)[0])
            raise ProtocolError(
                f"{self.info}, {where}: weights: {agent_text(i, self.names)} uses {agent_text(j, self.names)} with "
                f"{weights[i - 1, j - 1]:g}, expected 0, since it does not hear it in this graph"
            )
        for i, total in wrong_sums(weights, 1.0):
            row = f"row of {agent_text(i + 1, self.names)}"
            raise ProtocolError(f"{self.info}, {where}: weights: {row} sums to {total:.12g}, expected 1")

    def guard(self, where: str, call: Callable[[], Result]) -> Result:
        """The result of a call of the protocol's code; what it raises becomes a ProtocolError that says ``where``."""
        try:
            with np.errstate(all="ignore"), _KeptAlive():  # results are checked: numpy need not warn of an overflow
                return call()
        except (Exception, SystemExit) as error:  # of code that we know nothing about
            said = isinstance(error, ValueError) and bool(str(error))
            text = str(error) if said else f"{type(error).__name__}: {error}"
            place = f", {where}" if where else ""
            # Before the first step, what it says is of the user's parameters.
            line = "" if said and "step" not in where else _line_of(error)
            raise ProtocolError(f"{self.info}{place}: {text}{line}") from error


def _line_of(error: BaseException) -> str:
    """The line of the protocol's file at which it raised, in brackets; empty where its result was refused."""
    frames = traceback.extract_tb(error.__traceback__)
    files = [frame.filename for frame in frames if not Path(frame.filename).is_relative_to(PACKAGE)]
    lines = [frame.lineno for frame in frames if files and frame.filename == files[0]]
    return f" ({files[0]}, line {lines[-1]})" if files else ""


class _KeptAlive:
    """``os._exit`` raises SystemExit meanwhile: it would end the program without a word."""

    __slots__ = ("_token",)

    def __enter__(self) -> None:
        os._exit = _exit
        self._token = _inside.set(os.getpid())

    def __exit__(self, *raised: object) -> None:
        _inside.reset(self._token)


_inside: ContextVar[int] = ContextVar("inside", default=0)  # of a call of a protocol: the process that made it
_leave = os._exit


def _exit(status: int) -> NoReturn:
    """``os._exit``, but in calls of a protocol; other threads, and processes that it has forked, end as ever."""
    if _inside.get() == os.getpid():
        raise SystemExit(f"os._exit({status})")
    _leave(status)


class AgentProtocol:
    """The nonlinear protocol of one agent (from 0), with every result checked. InputError: not installed, or fails."""

    def __init__(self, chosen: ChosenProtocol, agent: int) -> None:
        if chosen.absent or chosen.network is None:
            raise InputError(chosen.absent or "")
        self._guard, self._agent = chosen.guard, agent_text(agent + 1, chosen.names)
        kind, network, parameters = chosen.kind, chosen.network, chosen.parameters
        made = chosen.guard(self._agent, lambda: kind(network, parameters, agent))  # type: ignore[misc,call-arg]
        assert isinstance(made, Protocol)
        self._protocol = made
        self.states = chosen.guard(self._agent, lambda: _states(made))

    def start(self, value: FloatArray) -> FloatArray:
        """State (S, R) at step 0: see ``Protocol.start``."""
        shape = (self.states, len(value))
        return self._guard(f"{self._agent}, start", lambda: _array(self._protocol.start(value), shape))

    def publish(self, k: int, state: FloatArray) -> FloatArray:
        """What others hear, (R,), of a state (S, R) of step k: see ``Protocol.publish``."""
        shape = state.shape[1:]
        return self._guard(f"{self._agent}, publish, step {k}", lambda: _array(self._protocol.publish(state), shape))

    def step(self, k: int, mode: int, state: FloatArray, heard: Heard, noise: FloatArray) -> FloatArray:
        """State (S, R) after step k: see ``Protocol.step``."""
        step, place = self._protocol.step, f"{self._agent}, step {k}"
        return self._guard(place, lambda: _array(step(k, mode, state, heard, noise), state.shape))


def _states(protocol: Protocol) -> int:
    states = protocol.states
    if not isinstance(states, int) or states < 1:
        raise ValueError(f"states: {states!r}, expected a whole number >= 1")
    return states


def _array(value: Any, shape: tuple[int, ...]) -> FloatArray:
    if np.iscomplexobj(value):
        raise ValueError("the result is complex, expected real numbers")
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"result of shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError("the result is not finite")
    return array


def installed_protocols() -> dict[str, list[EntryPoint]]:
    """Entry points of the installed protocols, by name; several where packages offer the same name."""
    found: dict[str, list[EntryPoint]] = {}
    for point in offered():
        found.setdefault(point.name, []).append(point)
    return dict(sorted(found.items()))


def offered() -> tuple[EntryPoint, ...]:
    """What the packages on the path offer; read again only where one was installed or removed meanwhile."""
    return _offered(tuple((place, _changed(place)) for place in sys.path))


@lru_cache(maxsize=1)
def _offered(_places: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=ENTRY_POINTS))


def _changed(place: str) -> int:
    """When something was last added to a directory, or removed [ns]; 0 where it is not there."""
    try:
        return os.stat(place or ".").st_mtime_ns  # noqa: PTH116 # twenty of these for each experiment
    except OSError:
        return 0


def find(spec: ProtocolSpec, recorded: ProtocolInfo | None = None) -> tuple[ChosenProtocol | None, list[str]]:
    """The protocol of an experiment and its parameters (None if unusable), and what is wrong, before ``bind``."""
    chosen, found = _find(spec)
    if recorded is None:
        return chosen, found
    # The protocol that a recorded run used need not be installed.
    return (_absent(recorded, found), []) if chosen is None else (chosen, [])


def _absent(recorded: ProtocolInfo, problems: list[str]) -> ChosenProtocol:
    return ChosenProtocol(recorded, absent=f"{recorded} is not available here ({'; '.join(problems)})")


def _find(spec: ProtocolSpec) -> tuple[ChosenProtocol | None, list[str]]:
    offers = installed_protocols()
    points = offers.get(spec.name, [])
    if len(points) != 1:
        known = ", ".join(f"{name} ({_package(point)})" for name in offers for point in offers[name])
        if points:
            wanted, remedy = "expected one package that offers it", "uninstall the others"
            return None, [problem("protocol.name", f"{show(spec.name)} of {known}", wanted, remedy)]
        wanted = f"expected one of {known}" if known else "expected a protocol, but no installed package offers any"
        close = difflib.get_close_matches(spec.name, offers, 1)
        remedy = f"did you mean {close[0]}?" if close else "correct it, or install its package"
        return None, [problem("protocol.name", show(spec.name), wanted, remedy)]
    point = points[0]
    dist = point.dist
    package, version = (dist.name, dist.version) if dist else ("?", "?")
    try:
        kind = point.load()
    except Exception as error:  # of code that we know nothing about
        text = f"cannot be imported ({type(error).__name__}: {error})"
        wanted = f"expected {point.value} of package {package} {version}"
        return None, [problem("protocol.name", f"{spec.name}: {text}", wanted, "repair or reinstall the package")]
    if not (isinstance(kind, type) and issubclass(kind, LinearProtocol | Protocol)):
        text = f"{point.value} of package {package} {version} is {type(kind).__name__} {getattr(kind, '__name__', '')}"
        wanted = "expected a class derived from LinearProtocol or Protocol of msg_analysis.protocol"
        return None, [problem("protocol.name", f"{spec.name}: {text}", wanted, "tell its authors")]
    try:
        parameters = kind.Parameters.model_validate(spec.model_extra or {})
        if "name" in parameters.model_dump(mode="json"):  # this also checks that they can be written as JSON
            raise ValueError("they have a field 'name', which is the protocol's own")
    except ValidationError as error:
        details = error.errors(include_url=False)
        return None, [translate(detail, kind.Parameters, "protocol") for detail in details]
    except Exception as error:
        text = f"{spec.name}: {type(error).__name__}: {error}"
        wanted = f"expected Parameters of {point.value} (package {package} {version}) that accept these values"
        return None, [problem("protocol", text, wanted, "tell its authors")]
    info = ProtocolInfo(spec.name, package, version, issubclass(kind, LinearProtocol))
    return ChosenProtocol(info, kind, parameters), []


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else point.value


def bind(
    chosen: ChosenProtocol,
    network: Network,
    run: RunSpec,
    names: Sequence[str] | None = None,  # of the agents
    recorded: ProtocolInfo | None = None,  # as in ``find``
) -> tuple[ChosenProtocol, list[str]]:
    """The same protocol with its network, and what does not fit together."""
    if chosen.absent:
        return chosen, []
    bound, found = _bind(replace(chosen, names=names), network, run)
    if recorded is None:
        return bound, found
    if found:
        return _absent(recorded, found), []
    here = bound.info
    if (here.linear, here.states, here.hidden) != (recorded.linear, recorded.states, recorded.hidden):
        other = f"{recorded} is not available here: the states of version {here.version} are of another kind"
        return ChosenProtocol(recorded, absent=other), []
    return replace(bound, info=recorded), []


def _bind(chosen: ChosenProtocol, network: Network, run: RunSpec) -> tuple[ChosenProtocol, list[str]]:
    bound = replace(chosen, network=network)
    assert chosen.kind is not None
    if bound.linear:
        return bound, _problems(lambda: bound.matrices())
    found = []
    if network.tracking and not chosen.kind.tracking:  # type: ignore[union-attr]
        wanted = f"expected consensus, since {chosen.info} does not support leaders"
        found.append(problem("problem", "'tracking'", wanted, "use another protocol, or consensus"))
    if run.start == "stationary":
        wanted = f"expected 'zero' or one value per agent, since {chosen.info} has no prediction to start from"
        found.append(problem("run.start", "'stationary'", wanted, "for example start: zero"))

    def layout() -> None:
        nonlocal bound
        agents = [AgentProtocol(bound, i) for i in range(network.agents)]
        states = {agent.states for agent in agents}
        if len(states) > 1:
            raise ProtocolError(f"{bound.info}: agents with {sorted(states)} states: expected as many for every agent")
        count = states.pop()
        agents[0].publish(0, agents[0].start(np.zeros(run.replicas)))
        hidden = count > 1 or chosen.kind.publish is not Protocol.publish  # type: ignore[union-attr]
        bound = replace(bound, info=replace(bound.info, states=count, hidden=hidden))

    found += _problems(layout)
    return bound, found


def _problems(check: Callable[[], object]) -> list[str]:
    try:
        check()
    except ProtocolError as error:
        return [f"{error}: correct the parameters, or tell the authors of the package"]
    return []
