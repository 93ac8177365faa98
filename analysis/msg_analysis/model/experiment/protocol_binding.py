"""Protocols of other packages: found, checked, and called so that their mistakes become errors that name them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from msg_analysis.errors import InputError
from msg_analysis.model.experiment.problems import problem, show, translate
from msg_analysis.protocol import ENTRY_POINTS, Heard, LinearProtocol, Network, Protocol
from msg_analysis.types import FloatArray

if TYPE_CHECKING:
    from msg_analysis.model.experiment.spec import ProtocolSpec, Purpose, RunSpec

Result = TypeVar("Result")
SUM_TOLERANCE = 1e-9


class ProtocolError(InputError):
    """A protocol has failed. The text names it, its package, and where; ``__cause__`` is what it raised."""


@dataclass(frozen=True, slots=True)
class ProtocolInfo:
    """What a run record says of a protocol: enough to read a bag without it.

    Attributes
    ----------
    name
        in the experiment, and of the entry point
    package, version
        that offers it
    linear
        whether it declares the matrix of a step
    states
        numbers S of an agent's state, for each replica
    hidden
        whether others hear something else than the whole state
    """

    name: str
    package: str
    version: str
    linear: bool
    states: int = 1
    hidden: bool = False

    def __str__(self) -> str:
        return f"protocol {self.name} ({self.package} {self.version})"

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Any) -> ProtocolInfo:
        """Read it back.

        Parameters
        ----------
        document
            what ``to_json`` gave

        Raises
        ------
        ValueError
            it is something else (KeyError and TypeError, too)
        """
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
    """The protocol of an experiment.

    Attributes
    ----------
    info
        what it is; of a recorded run, what it was
    kind, parameters
        its class and its own parameters; None where it is not here
    absent
        that it is not here and why, for people; None where it is
    network
        that it is for, once that is known
    """

    info: ProtocolInfo
    kind: type[LinearProtocol | Protocol] | None = None
    parameters: BaseModel | None = None
    absent: str | None = None
    network: Network | None = field(default=None, repr=False)

    @property
    def linear(self) -> bool:
        """Whether it is linear, and here to say with which matrices."""
        return self.info.linear and self.kind is not None

    def unpredictable(self) -> str | None:
        """Why there is no prediction; None where there is one."""
        if self.absent:
            return self.absent
        return None if self.info.linear else f"{self.info} is not linear, and runs without a prediction"

    def unavailable(self, purpose: Purpose) -> list[str]:
        """What stands in the way of a purpose, one line each: see ``Experiment.unavailable``.

        Parameters
        ----------
        purpose
            "run" or "predict"
        """
        name, reason = show(self.info.name), self.unpredictable()
        if self.absent:
            remedy = f"install {self.info.package} {self.info.version}"
            return [problem("protocol.name", name, f"expected one that is here: {self.absent}", remedy)]
        if purpose == "run" or not reason:
            return []
        wanted = f"expected a linear protocol, but {reason}"
        return [problem("protocol.name", name, wanted, "use `simulate` or `msg-agents run`")]

    def matrices(self) -> tuple[FloatArray, FloatArray]:
        """W_g and B_g of a linear protocol, (n, m, m) each.

        Raises
        ------
        InputError
            it is not here, or not linear; it fails, or what it says is wrong
        """
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
                f"{self.info}, {where}: weights: agent {i} uses agent {j} with {weights[i - 1, j - 1]:g}, expected 0, "
                "since it does not hear it in this graph"
            )
        sums = weights.sum(axis=1)
        wrong = np.flatnonzero(np.abs(sums - 1.0) > SUM_TOLERANCE * np.abs(weights).max(axis=1))
        if wrong.size:
            i = int(wrong[0])
            raise ProtocolError(
                f"{self.info}, {where}: weights: row of agent {i + 1} sums to {sums[i]:.12g}, expected 1"
            )

    def guard(self, where: str, call: Callable[[], Result]) -> Result:
        """What a call of the protocol's own code gives; whatever it raises becomes an error that says where.

        Parameters
        ----------
        where
            the method, for the message
        call
            of the protocol's code

        Raises
        ------
        ProtocolError
            with ``where`` ("" for nowhere in particular) and what was raised
        """
        try:
            return call()
        except Exception as error:  # of code that we know nothing about
            text = str(error) if isinstance(error, ValueError) and str(error) else f"{type(error).__name__}: {error}"
            place = f", {where}" if where else ""
            raise ProtocolError(f"{self.info}{place}: {text}") from error


class AgentProtocol:
    """One agent's protocol, with every result checked.

    Parameters
    ----------
    chosen
        a protocol that is not linear
    agent
        index from 0

    Raises
    ------
    InputError
        it is not here, or fails
    """

    def __init__(self, chosen: ChosenProtocol, agent: int) -> None:
        if chosen.absent or chosen.network is None:
            raise InputError(chosen.absent or "")
        self._guard, self._agent = chosen.guard, f"agent {agent + 1}"
        kind, network, parameters = chosen.kind, chosen.network, chosen.parameters
        made = chosen.guard(self._agent, lambda: kind(network, parameters, agent))  # type: ignore[misc,call-arg]
        assert isinstance(made, Protocol)
        self._protocol = made
        self.states = chosen.guard(self._agent, lambda: _states(made))

    def start(self, value: FloatArray) -> FloatArray:
        """(S, R): see Protocol."""
        shape = (self.states, len(value))
        return self._guard(f"{self._agent}, start", lambda: _array(self._protocol.start(value), shape))

    def publish(self, k: int, state: FloatArray) -> FloatArray:
        """(R,) of a state (S, R) of step k: see Protocol."""
        shape = state.shape[1:]
        return self._guard(f"{self._agent}, publish, step {k}", lambda: _array(self._protocol.publish(state), shape))

    def step(self, k: int, mode: int, state: FloatArray, heard: Heard, noise: FloatArray) -> FloatArray:
        """(S, R): see Protocol."""
        return self._guard(
            f"{self._agent}, step {k}",
            lambda: _array(self._protocol.step(k, mode, state, heard, noise), state.shape),
        )


def _states(protocol: Protocol) -> int:
    states = protocol.states
    if not isinstance(states, int) or states < 1:
        raise ValueError(f"states: {states!r}, expected a whole number >= 1")
    return states


def _array(value: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"result of shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError("the result is not finite")
    return array


def installed() -> dict[str, list[EntryPoint]]:
    """Protocols that packages offer, by name; more than one where packages contradict each other."""
    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=ENTRY_POINTS):
        found.setdefault(point.name, []).append(point)
    return dict(sorted(found.items()))


def find(spec: ProtocolSpec, recorded: ProtocolInfo | None = None) -> tuple[ChosenProtocol | None, list[str]]:
    """The protocol that an experiment asks for, with its parameters, and what is wrong with these.

    What depends on the network is found by ``bind``.

    Parameters
    ----------
    spec
        of the experiment
    recorded
        of a run that was recorded, what was used then: need not be here
    """
    chosen, found = _find(spec)
    if recorded is None:
        return chosen, found
    return (_absent(recorded, found), []) if chosen is None else (chosen, [])


def _absent(recorded: ProtocolInfo, problems: list[str]) -> ChosenProtocol:
    return ChosenProtocol(recorded, absent=f"{recorded} is not here ({'; '.join(problems)})")


def _find(spec: ProtocolSpec) -> tuple[ChosenProtocol | None, list[str]]:
    offers = installed()
    points = offers.get(spec.name, [])
    if len(points) != 1:
        known = ", ".join(f"{name} ({_package(point)})" for name in offers for point in offers[name])
        if points:
            wanted, remedy = "expected one package that offers it", "uninstall the others"
            return None, [problem("protocol.name", f"{show(spec.name)} of {known}", wanted, remedy)]
        wanted = f"expected one of {known}" if known else "expected a protocol, but no installed package offers any"
        return None, [problem("protocol.name", show(spec.name), wanted, "correct it, or install its package")]
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
        if "name" in parameters.model_dump(mode="json"):  # it must be possible to write them down, too
            raise ValueError("they have a field 'name', which is the protocol's own")
    except ValidationError as error:
        details = error.errors(include_url=False)
        return None, [translate(detail, kind.Parameters, "protocol") for detail in details]
    except Exception as error:
        text = f"{spec.name}: {type(error).__name__}: {error}"
        wanted = f"expected Parameters of {point.value} (package {package} {version}) that take what stands here"
        return None, [problem("protocol", text, wanted, "tell its authors")]
    info = ProtocolInfo(spec.name, package, version, issubclass(kind, LinearProtocol))
    return ChosenProtocol(info, kind, parameters), []


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist else point.value


def bind(
    chosen: ChosenProtocol, network: Network, run: RunSpec, recorded: ProtocolInfo | None = None
) -> tuple[ChosenProtocol, list[str]]:
    """The same protocol with its network, and what does not go together.

    Parameters
    ----------
    chosen
        found by ``find``
    network
        of the experiment
    run
        section of the experiment
    recorded
        see ``find``
    """
    if chosen.absent:
        return chosen, []
    bound, found = _bind(chosen, network, run)
    if recorded is None:
        return bound, found
    if found:
        return _absent(recorded, found), []
    here = bound.info
    if (here.linear, here.states, here.hidden) != (recorded.linear, recorded.states, recorded.hidden):
        other = f"{recorded} is not here, but {here.version}, whose states are of another kind"
        return ChosenProtocol(recorded, absent=other), []
    return replace(bound, info=recorded), []


def _bind(chosen: ChosenProtocol, network: Network, run: RunSpec) -> tuple[ChosenProtocol, list[str]]:
    bound = replace(chosen, network=network)
    assert chosen.kind is not None
    if bound.linear:
        return bound, _problems(lambda: bound.matrices())
    found = []
    if network.tracking and not chosen.kind.tracking:  # type: ignore[union-attr]
        wanted = f"expected consensus, since {chosen.info} knows no leaders"
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


def info_of(document: Mapping[str, Any]) -> ProtocolInfo | None:
    """Of a run record; None where the built-in law was run.

    Parameters
    ----------
    document
        of the run record
    """
    return ProtocolInfo.from_json(document["protocol"]) if document.get("protocol") is not None else None
