# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The values of an experiment file, the same experiment with others, and where its agents are in arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, Self

from msg_analysis.common.text import listed
from msg_analysis.errors import InputError
from msg_analysis.experiment.markov_chain import Time
from msg_analysis.experiment.problems import ExperimentError, show
from msg_analysis.experiment.spec import ExperimentSpec, NoiseSpec, RunSpec, SwitchingSpec


class Variants:
    """Methods of ``Experiment`` that read its document, or give another one."""

    __slots__ = ()

    if TYPE_CHECKING:
        source: str
        agents: Any
        spec: ExperimentSpec

        def to_document(self) -> dict[str, Any]:
            """See ``Experiment``."""

        @classmethod
        def parse(cls, mapping: Any, *, source: str = "experiment") -> Self:
            """See ``Experiment``."""

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.spec.name

    @property
    def problem(self) -> str:
        """Either "consensus" or "tracking"."""
        return self.spec.problem

    @property
    def time(self) -> Time:
        """Either "continuous" or "discrete"."""
        return self.spec.time

    @property
    def names(self) -> list[str] | None:
        """Names of the agents, in the order of their numbers; None where they have only numbers."""
        return self.spec.names

    @property
    def switching(self) -> SwitchingSpec:
        """Section ``switching``."""
        return self.spec.switching

    @property
    def noise(self) -> NoiseSpec:
        """Section ``noise``."""
        return self.spec.noise

    @property
    def run(self) -> RunSpec:
        """Section ``run``."""
        return self.spec.run

    @property
    def reference(self) -> float:
        """The value that tracking agents should reach; 0 for consensus."""
        return self.spec.leaders.reference if self.spec.leaders else 0.0

    @property
    def steps(self) -> int:
        """Number of steps N of a run, which has the states x(0), ..., x(N)."""
        return self.run.steps

    @property
    def step_length(self) -> float:
        """Simulated time of a step, ``run.dt`` [units of simulated time]; 1 in discrete time."""
        return self.run.dt

    def with_run(self, **changes: Any) -> Self:
        """The same experiment with other values of ``run``, checked again.

        Parameters
        ----------
        changes
            keys of ``run`` (seed, duration, pace, ...) and their new values

        Raises
        ------
        ExperimentError
            the new document is not valid; names every mistake
        """
        return self._with("run", changes)

    def with_noise(self, **changes: Any) -> Self:
        """The same experiment with other values of ``noise``; arguments and errors as in :meth:`with_run`."""
        return self._with("noise", changes)

    def with_leaders(self, *agents: int | str, **changes: Any) -> Self:
        """The same experiment with other leaders, checked again; without any argument, consensus.

        Parameters
        ----------
        agents
            the leaders, by number from 1 or name; none: those that there are
        changes
            ``gain`` and ``reference``; those that are not given stay

        Raises
        ------
        ExperimentError
            the new document is not valid; names every mistake
        """
        if not agents and not changes:
            document = self.to_document() | {"problem": "consensus"}
            document.pop("leaders", None)
            return self.parse(document, source=self.source)
        given = {"agents": list(agents), **changes} if agents else changes
        return self._with("leaders", given, problem="tracking")

    def with_graphs(self, graphs: Mapping[str, Any], *, switching: Mapping[str, Any] | None = None) -> Self:
        """The same experiment with other graphs of the same agents, checked again.

        Parameters
        ----------
        graphs
            by name: as in a document, arrays, matrices of scipy.sparse or graphs of networkx
        switching
            section ``switching``; None: that of this experiment; {}: of a single graph

        Raises
        ------
        ExperimentError
            the new document is not valid; names every mistake
        """
        document = self.to_document() | {"graphs": graphs}
        return self.parse(document if switching is None else document | {"switching": switching}, source=self.source)

    def with_switching(self, **changes: Any) -> Self:
        """The same experiment with other values of ``switching``, checked again.

        Parameters
        ----------
        changes
            keys of ``switching`` and their new values; of ``generator``, ``rates`` and ``transition``, a new one
            replaces the one that there is

        Raises
        ------
        ExperimentError
            the new document is not valid; names every mistake
        """
        kinds = dict.fromkeys(("generator", "rates", "transition"))
        if "generator" in changes or "transition" in changes:
            kinds["scale"] = 1.0
        return self._with("switching", (kinds if kinds.keys() & changes.keys() else {}) | changes)

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """The same experiment with other values at any keys, checked again.

        Parameters
        ----------
        values
            by dotted key, as in sweep files: ``{"noise.process": 2.0, "switching.scale": 0.5}``

        Raises
        ------
        ExperimentError
            a key leads nowhere, or the new document is not valid; names every mistake
        """
        from msg_analysis.sweeps.grid import KeyProblemError, put

        document = self.to_document()
        try:
            for key, value in values.items():
                document = put(document, key, value)
        except KeyProblemError as error:
            raise ExperimentError(self.source, [str(error).removeprefix("over.")]) from None
        return self.parse(document, source=self.source)

    def _with(self, section: str, changes: Mapping[str, Any], **more: Any) -> Self:
        """The same with other keys in a section, and ``more`` of the document; None removes a key."""
        document = self.to_document() | more
        values = {**document.get(section, {}), **changes}
        document[section] = {key: value for key, value in values.items() if value is not None}
        return self.parse(document, source=self.source)

    def indices(self, agents: Iterable[int | str]) -> list[int]:
        """Where agents are in arrays: ``run.states[:, experiment.indices(["north"])]``.

        Parameters
        ----------
        agents
            by number from 1, or by name

        Returns
        -------
        list
            of indices from 0

        Raises
        ------
        InputError
            there is no such agent
        """
        found = []
        for agent in agents:
            number = (self.names or []).index(agent) + 1 if agent in (self.names or []) else agent
            if isinstance(number, str) or number != int(number) or not 1 <= number <= self.agents:
                names = f", or one of the names {listed(self.names)}" if self.names else ""
                raise InputError(f"agents: {show(agent)}: expected numbers from 1 to {self.agents}{names}")
            found.append(int(number) - 1)
        return found
