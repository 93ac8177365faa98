# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""From a YAML document to an experiment, section by section; memory that it needs."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from pydantic import TypeAdapter, ValidationError

from msg_analysis.common.arrays import FloatArray
from msg_analysis.common.files import StrictLoader, load_yaml, read_text
from msg_analysis.common.text import listed
from msg_analysis.errors import InputError
from msg_analysis.experiment import graph_files, graph_sources, limits, protocols, traces, validation
from msg_analysis.experiment.graph_files import ForeignGraph, GraphError
from msg_analysis.experiment.graphs import Graph
from msg_analysis.experiment.links import drawn_sojourns, law_of
from msg_analysis.experiment.markov_chain import MarkovChain, Schedule, Time
from msg_analysis.experiment.problems import WEIGHT, problem, show, translate
from msg_analysis.experiment.protocols import ChosenProtocol, ProtocolInfo
from msg_analysis.experiment.spec import BESIDE, ExperimentSpec, GraphSpec, NoiseSpec, RunSpec, SwitchingSpec
from msg_analysis.experiment.values import LossSpec, RateSpec

Values = TypeVar("Values", LossSpec, RateSpec)

_BAG_FILES = ("metadata.yaml", "*.mcap", "*.mcap.zstd", "*.db3", "*.db3.zstd")
_BAG_STARTS = (b"\x89MCAP0\r\n", b"SQLite format 3\x00")
_BAG_KEY = "rosbag2_bagfile_information"  # of its metadata.yaml
_NOT_A_BAG = (
    "expected a YAML file: give the experiment file from which it was recorded; `msg-analysis info`, `compare` and "
    "`export` read bags"
)
_HEAD = 65_536  # bytes of a file that are looked at


def is_bag(path: Path) -> bool:
    """Whether it is a bag, or a file of one, by its name or its beginning; it may be damaged."""
    if path.is_dir():
        return any(next(path.glob(pattern), None) for pattern in _BAG_FILES)
    return _head(path).startswith(_BAG_STARTS)


def no_bag_but(path: Path) -> str | None:
    """What a file is instead of one of a bag, and what to do, in words; None where that cannot be told."""
    text = _head(path).decode("utf-8", "ignore")
    if re.search(rf"^{_BAG_KEY}\s*:", text, re.MULTILINE):
        return f"is the metadata of a bag: expected a bag: give its directory, {path.parent}"
    keys = set(re.findall(r"""^[ {]*["']?(\w+)["']?\s*:""", text, re.MULTILINE))
    if "graphs" in keys:
        wanted = f"expected a bag: `msg-agents run {path}` and `msg-analysis simulate {path}` make one"
        return f"is an experiment file: {wanted}"
    if {"experiment", "over"} <= keys:
        return f"is a sweep file: expected a bag: `msg-analysis sweep {path}` runs it"
    return None


def _head(path: Path) -> bytes:
    """The beginning of a regular file; nothing of others, whose reader says what is wrong."""
    if not path.is_file():
        return b""
    try:
        with path.open("rb") as stream:
            return stream.read(_HEAD)
    except OSError:
        return b""


def other_kind(mapping: Mapping[Any, Any], wanted: str) -> str | None:
    """What a document is instead of the ``wanted`` kind (experiment, sweep), and what to do; None: not another kind."""
    if _BAG_KEY in mapping:
        return f"the metadata of a bag: {_NOT_A_BAG}"
    if wanted == "experiment" and {"experiment", "over"} <= mapping.keys() and "graphs" not in mapping:
        return "a sweep file: expected an experiment file: `msg-analysis sweep` runs sweeps"
    if wanted == "sweep" and "graphs" in mapping and not {"experiment", "over"} & mapping.keys():
        return "an experiment file: expected a sweep file: name it there as `experiment:`, and its values as `over:`"
    return None


def read_yaml(path: Path) -> Any:
    """The content of a YAML (or JSON) file in UTF-8. InputError: it cannot be read, or is something else."""
    if is_bag(path):
        raise InputError(f"{path}: is a bag: {_NOT_A_BAG}")
    try:
        text = read_text(path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file: check the path") from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: is a directory: expected an experiment file (YAML)") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start}: not UTF-8 text: expected an experiment file (YAML)") from error
    return parse_yaml(text, str(path))


def parse_yaml(text: str, source: str) -> Any:
    """The content of a text in YAML (or JSON); errors as of ``read_yaml``, ``source`` in the place of the file."""
    try:
        return load_yaml(text, StrictLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise InputError(f"{source}: {line}{', '.join(filter(None, (error.context, error.problem)))}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{source}: not YAML: {' '.join(str(error).split())}") from error


@functools.cache
def _adapter(key: str) -> TypeAdapter[Any]:
    """The validator of one section; cached, since making it takes longer than using it."""
    annotation: Any = ExperimentSpec.model_fields[key].annotation
    return TypeAdapter(annotation)


def _section(key: str, mapping: Mapping[Any, Any]) -> Any:
    """One valid section of a document with mistakes in others."""
    if key in mapping:
        return _adapter(key).validate_python(mapping[key])
    return ExperimentSpec.model_fields[key].get_default(call_default_factory=True, validated_data={})


class Sections:
    """A document that is being checked: a section is None as long as it is not known to be valid."""

    def __init__(self, mapping: Mapping[Any, Any], recorded: ProtocolInfo | None = None) -> None:
        self.problems: list[str] = []
        document, self._networkx = graph_sources.plain_document(mapping)
        self._foreign: dict[str, ForeignGraph] = {}  # read, but not numbered yet
        self._named_by_files = False
        self._numbers_are_names = False
        self.notes: list[str] = []  # what was not read of files with graphs, or might be understood in another way
        self.keys: dict[str, str] = {}  # of the graphs, for messages
        bad: set[str] = set()
        try:
            spec = ExperimentSpec.model_validate(document)
            self.values = {key: getattr(spec, key) for key in ExperimentSpec.model_fields}
        except ValidationError as error:
            self.problems += [translate(detail) for detail in error.errors(include_url=False)]
            bad = {str(detail["loc"][0]) for detail in error.errors(include_url=False)}
            self.values = {key: None if key in bad else _section(key, document) for key in ExperimentSpec.model_fields}
        self.known = set(self.values) - bad
        run = self.values["run"]
        if run is not None and self.values["time"] == "discrete" and "dt" not in run.model_fields_set:
            self.values["run"] = run.model_copy(update={"dt": 1.0})
        self.agents: int | None = None
        self.graphs: tuple[Graph, ...] = ()
        self.switching: MarkovChain | Schedule | None = None
        self.noise_gain: FloatArray | None = None
        self.loss: FloatArray | None = None
        self._sparse = False  # no matrices, which do not fit in memory
        self._recorded = recorded  # the protocol of a recorded run need not be installed
        self.protocol: ChosenProtocol | None = None

    def resolve(self, directory: Path) -> None:
        """Check what several keys say together; paths in the document are relative to ``directory``."""
        time = self.values["time"]
        self._find_protocol()
        self._read_trace(directory)
        self._count_agents(directory)
        self._name_leaders()
        self._name_start()
        self._name_external()
        run = self.values["run"]
        leaders = self.values["leaders"]
        leaders_good = self.values["problem"] is not None and "leaders" in self.known
        if leaders_good:
            found = validation.leader_problems(self.values["problem"], leaders, self.agents, self.values["names"])
            leaders_good = not found
            self.problems += found
        if self.values["graphs"] and self.values["switching"] and time:
            self.switching, found = validation.switching_of(self.values["switching"], list(self.values["graphs"]), time)
            self.problems += found
        whole_steps = False
        if run and time:
            found = validation.run_problems(run, time, self.agents)
            found += validation.external_problems(run, self.agents, protocol=self.values["protocol"] is not None)
            whole_steps = not found
            self.problems += found
        if self.agents is None or not self._fits(run if whole_steps else None):
            return
        if self.values["noise"] and not self._sparse:
            names = list(self.values["graphs"])
            self.noise_gain, found = validation.noise_gain_of(self.values["noise"], names, self.agents)
            self.problems += found
        self._build_graphs()
        if not self.graphs or not leaders_good:
            return
        names, sparse = self.values["names"], self._sparse
        self.problems += validation.connection_problems(self.graphs, leaders, names, sparse=sparse)
        if self.values["noise"] and time and not sparse:
            self._resolve_losses(self.values["noise"], time)
        built_in = "protocol" in self.known and self.values["protocol"] is None
        if time == "continuous" and run and built_in:
            gains = validation.leader_gains(leaders, self.agents)
            self.problems += validation.stability_problems(self.graphs, gains, run.dt, sparse=sparse)
        if self._drawn and time and run and not self.problems:
            self._draw(self.values["switching"], time, run)

    @property
    def _drawn(self) -> bool:
        """Whether the graphs of a run are drawn from another law than a chain of the graphs of the file."""
        switching, noise = self.values["switching"], self.values["noise"]
        return bool((switching and (switching.links or switching.sojourn)) or (noise and noise.leaves_out_steps))

    def _draw(self, switching: SwitchingSpec, time: Time, run: RunSpec) -> None:
        """The graphs of a run, from the seed, in place of those of the file."""
        if switching.links:
            rates = {
                kind: self._numbered(f"switching.links.{kind}", getattr(switching.links, kind))
                for kind in ("up", "down")
            }
            switching = switching.model_copy(update={"links": switching.links.model_copy(update=rates)})
            self.values["switching"] = switching
        if self.problems:
            return
        assert self.noise_gain is not None
        given = switching, self.values["noise"], self.graphs, time, run.dt, self.values["names"]
        law, self.problems = law_of(*given, protocol=self.protocol is not None)
        if law:
            self.problems += limits.path_problems(len(law.link_of), len(law), run.steps)
        if law and not self.problems:
            graphs, self.switching = law.drawn(run.seed, run.steps)
            self.graphs = tuple(graphs)
            self.noise_gain = np.broadcast_to(self.noise_gain[0], (len(graphs), *self.noise_gain.shape[1:]))
        elif isinstance(self.switching, MarkovChain) and not self.problems:
            self.switching = drawn_sojourns(self.switching, switching, list(self.values["graphs"]), run)

    def parts(self) -> dict[str, Any]:
        """The fields of an ``Experiment``, once there are no problems."""
        return {
            "spec": ExperimentSpec.model_construct(**(self.values | {"agents": self.agents})),
            "graph_list": self.graphs,
            "switching_law": self.switching,
            "noise_gain": self.noise_gain,
            "loss": self.loss,
            "protocol": self.protocol,
        }

    def _find_protocol(self) -> None:
        """The protocol and its parameters, with their defaults written out."""
        spec = self.values["protocol"]
        if spec is None:
            return
        self.protocol, found = protocols.find(spec, self._recorded)
        self.problems += found
        if self.protocol and self.protocol.parameters is not None:
            parameters = self.protocol.parameters.model_dump(mode="json")
            self.values["protocol"] = type(spec).model_validate({"name": spec.name, **parameters})

    def _read_trace(self, directory: Path) -> None:
        """The graphs and the schedule of a trace, in place of it."""
        switching: SwitchingSpec | None = self.values["switching"]
        graphs: dict[str, GraphSpec] | None = self.values["graphs"]
        if switching is None or graphs is None:
            self.values["graphs"] = graphs or None  # none are known where a section with a trace has mistakes
            return
        try:
            if switching.trace is not None:
                switching, self._foreign, notes = traces.resolved(switching, graphs, directory)
                self.notes += notes
                graphs |= {name: GraphSpec.model_construct(edges=[]) for name in self._foreign}
                self.keys |= dict.fromkeys(self._foreign, "switching.trace")
            if not graphs:
                raise GraphError(
                    "graphs", "missing", "expected named graphs, or a trace", "add line: {path: [1, 2, 3]}"
                )
        except GraphError as error:
            self.problems.append(str(error))
            switching = graphs = None
        self.values |= {"switching": switching, "graphs": graphs}
        if self.values["run"] and switching and (switching.schedule or self._drawn):
            self.values["run"], found = validation.scheduled_run(self.values["run"], switching)
            self.problems += found

    def _count_agents(self, directory: Path) -> None:
        """The number of agents and their names, if every graph is valid; files with graphs are read here."""
        graphs: dict[str, GraphSpec] | None = self.values["graphs"]
        if graphs is None or not {"agents", "names"} <= self.known:
            return
        before = len(self.problems)
        for name, spec in graphs.items():
            if name in self._foreign:  # of a trace
                continue
            if name == "stationary":
                wanted = "expected another name, since switching.initial uses this one"
                self.problems.append(problem("graphs", "'stationary'", wanted, "rename the graph"))
            if len(spec.kinds) != 1:
                given = " and ".join(spec.kinds) or "nothing"
                wanted = f"expected one of {', '.join(key for key in GraphSpec.model_fields if key not in BESIDE)}"
                self.problems.append(problem(f"graphs.{name}", given, wanted, "give exactly one"))
                continue
            for beside, kinds in BESIDE.items():
                if (value := getattr(spec, beside)) is not None and spec.kinds[0] not in kinds:
                    remedy = WEIGHT if beside == "weight" else "remove it"
                    wanted = f"expected with {', '.join(kinds)} only"
                    self.problems.append(problem(f"graphs.{name}.{beside}", value, wanted, remedy))
            self.keys[name] = key = f"graphs.{name}" if name in self._networkx else f"graphs.{name}.{spec.kinds[0]}"
            try:
                self._read(name, key, spec, directory)
            except GraphError as error:
                self.problems.append(str(error))
        if len(self.problems) > before or not self._number_nodes(graphs):
            return
        declared, names = self.values["agents"], self.values["names"]
        largest = max(map(graph_sources.largest_label, graphs.values()))
        untold = all(spec.complete or spec.star for spec in graphs.values())
        if declared is None and names is None and (untold or largest < 2):
            wanted = "expected the number of agents, since the graphs do not give it"
            self.problems.append(problem("agents", "missing", wanted, "for example agents: 5"))
        elif names is not None and len(names) != (declared or max(largest, len(names))):
            shown = f"{len(names)} names" if len(names) > 1 else "1 name"
            whose = " from the files of the graphs" if self._named_by_files else ""
            wanted = f"expected one for each of the {declared or largest} agents"
            self.problems.append(problem("names", shown + whose, wanted, "name the others, or correct `agents`"))
        else:
            self.agents = declared or (len(names) if names else largest)

    def _read(self, name: str, key: str, spec: GraphSpec, directory: Path) -> None:
        """Read a graph that is not given by numbers of agents. GraphError: its mistake."""
        if name in self._networkx:
            self._foreign[name] = graph_sources.from_networkx(key, self._networkx[name])
        elif spec.graphml is not None:
            self._foreign[name] = graph_files.read_graphml(key, directory / spec.graphml)
        elif spec.csv is not None:
            self._foreign[name] = graph_files.read_csv(key, directory / spec.csv)
        elif spec.adjacency is not None:
            rows = spec.adjacency
            if isinstance(rows, str):
                rows = graph_files.read_matrix(key, directory / rows)
            self.values["graphs"][name] = graph_sources.from_adjacency(key, rows)
        if name in self._foreign:
            self._foreign[name] = self._foreign[name].joined(spec.parallel)
            self.notes += [f"{key}: {note}" for note in self._foreign[name].notes]

    def _number_nodes(self, graphs: dict[str, GraphSpec]) -> bool:
        """Numbers instead of nodes in ``graphs``, and the names of the agents; False where these have mistakes."""
        given: list[str] | None = self.values["names"]
        twice = sorted({name for name in given or [] if (given or []).count(name) > 1})
        if twice:
            self.problems.append(problem("names", show(twice[0]), "expected different names", "rename one"))
            return False
        named = {
            name: ForeignGraph(nodes, [], directed=False)
            for name, spec in graphs.items()
            if name not in self._foreign
            and (nodes := [agent for agent in graph_sources.written_agents(spec) if isinstance(agent, str)])
        }
        if not self._foreign and not named:
            return True
        sources = {name: graph for name in graphs if (graph := self._foreign.get(name) or named.get(name))}
        others = [spec for name, spec in graphs.items() if name not in self._foreign]
        try:
            numbers, names = graph_sources.numbered(sources.values(), given, others, self.values["agents"])
        except KeyError as error:
            node, wanted = error.args[0], f"expected one of the names {listed(given or [])}"
            place = next(self.keys[name] for name, graph in sources.items() if node in graph.nodes)
            self.problems.append(problem(place, f"node {show(node)}", wanted, "correct it, or add it to `names`"))
            return False
        self._named_by_files = given is None and bool(self._foreign)
        self._numbers_are_names = self._named_by_files and all(map(graph_files.is_whole, names or ["no"]))
        places: dict[int | str, int] = dict(numbers.items())
        if self._numbers_are_names:
            places |= {int(node): number for node, number in numbers.items()}
        graphs |= {
            name: graph_sources.as_spec(self._foreign[name], numbers)
            if name in self._foreign
            else graph_sources.with_numbers(spec, places)
            for name, spec in graphs.items()
        }
        self.values["names"] = names
        self._note_nodes(names or [])
        return True

    def _note_nodes(self, names: Sequence[str]) -> None:
        """Say which agent a node is, where it might be another one."""
        made = [self.keys[name] for name, graph in self._foreign.items() if graph.made_ids]
        if self._numbers_are_names:
            self.notes.append(
                f"the nodes {listed(names, 3)} are not numbered from 1 to {len(names)}: these are the agents' names"
            )
        elif made and len(self._foreign) > 1:
            words = "the nodes have no names that are all different: nodes with the same id are the same agent"
            self.notes.append(f"{listed(made)}: {words}")

    def _number(self, key: str, agent: int | str, *others: str) -> int | None:
        """The number of an agent that is given by number or name; None, and a mistake: an unknown name."""
        names = self.values["names"] or []
        written = str(agent) if self._numbers_are_names else agent  # of the nodes in files
        if written in names:
            return int(names.index(written)) + 1
        if not isinstance(written, str):
            return written
        if self.agents is not None:
            self.problems.append(validation.unknown_name(key, written, names, *others))
        return None

    def _name_leaders(self) -> None:
        """Numbers instead of names in ``leaders``; what is not a name of an agent is a mistake."""
        leaders = self.values["leaders"]
        if leaders is None:
            return
        numbers = [self._number("leaders.agents", agent) for agent in leaders.agents]
        self.values["leaders"] = leaders.model_copy(update={"agents": [n for n in numbers if n is not None]})
        if None in numbers:
            self.known.discard("leaders")

    def _name_start(self) -> None:
        """One number for each agent in ``run.start`` in place of numbers by agent; 0 for those that are not there."""
        run = self.values["run"]
        if self.agents is None or run is None or not isinstance(run.start, dict):
            return
        values, others = [0.0] * self.agents, f"expected agents 1 to {self.agents}"
        for agent, value in run.start.items():
            number = self._number("run.start", agent, others)
            if number is not None and number > self.agents:
                self.problems.append(validation.unknown_name("run.start", number, self.values["names"] or [], others))
            elif number is not None:
                values[number - 1] = value
        self.values["run"] = run.model_copy(update={"start": values})

    def _name_external(self) -> None:
        """Numbers instead of names in ``run.external``."""
        run = self.values["run"]
        if run is not None and run.external:
            numbers = [self._number("run.external", agent) for agent in run.external]
            self.values["run"] = run.model_copy(update={"external": [n for n in numbers if n is not None]})

    def _numbered(self, key: str, given: Values) -> Values:
        """Numbers instead of names of agents in values by link."""
        links: dict[str, Any] = {}
        for kind in ("edges", "arcs"):
            for i, j, value in getattr(given, kind):
                place = f"{key}.{kind}"
                links.setdefault(kind, []).append((self._number(place, i), self._number(place, j), value))
        return given.model_copy(update=links)

    def _resolve_losses(self, noise: NoiseSpec, time: Time) -> None:
        """Numbers instead of names in ``noise.loss``, and the probability of every link."""
        before = len(self.problems)
        loss = self._numbered("noise.loss", noise.loss)
        if len(self.problems) > before:
            return
        self.values["noise"] = noise.model_copy(update={"loss": loss})
        self.loss, found = validation.loss_matrix(loss, self.graphs, time, self.values["names"])
        if noise.whole_link and not found:
            found = validation.whole_link_problems(self.loss, noise)
        if noise.burst is not None and not found:
            found = validation.burst_problems(noise.burst, loss)
        self.problems += found

    def _fits(self, run: RunSpec | None) -> bool:
        assert self.agents is not None
        steps, replicas = (run.steps, run.replicas) if run else (1, 1)
        noise: NoiseSpec | None = self.values["noise"]
        delay, truth = (noise.delay, noise.broadcast > 0) if noise else (0, False)
        switching, modes = self.values["switching"], len(self.values["graphs"])
        if switching and switching.schedule and not (noise and isinstance(noise.process, dict)):
            modes = 1  # matrices of all are made by some commands only
        found = limits.memory_problems(self.agents, modes, steps, replicas, delay, truth)
        states = limits.memory_problems(self.agents, 0, steps, replicas, delay, truth)
        matrices = limits.memory_problems(self.agents, modes, -1, replicas, delay)
        if matrices and not states and noise and self._does_without_matrices(noise):
            self._sparse, found = True, []
            self.noise_gain = np.broadcast_to(np.nan, (modes, self.agents, self.agents))
            self.loss = np.broadcast_to(noise.loss.default, (self.agents, self.agents))
        self.problems += found
        return not found

    def _does_without_matrices(self, noise: NoiseSpec) -> bool:
        """Whether nothing but the number of agents needs matrices, so that errors can be sampled."""
        sizes = ("by graph",) if isinstance(noise.process, dict) else np.shape(noise.process)
        plain = sizes in ((), (self.agents,)) and not (noise.loss.edges or noise.loss.arcs or noise.delay)
        return plain and self.values["time"] == "continuous" and self.values["protocol"] is None

    def _build_graphs(self) -> None:
        assert self.agents is not None
        graphs: dict[str, GraphSpec] = self.values["graphs"]
        found: list[str] = []
        for name, spec in graphs.items():
            key = self.keys[name]
            remedy = "remove the duplicate"
            if key.endswith(tuple(f".{kind}" for kind in BESIDE["parallel"])) and name not in self._networkx:
                remedy += ", or give `parallel: sum` or `parallel: first` beside the file"
            found += graph_sources.link_problems(key, spec, self.agents, self.values["names"], remedy)
        self.problems += found
        if not found:
            self.graphs = tuple(graph_sources.build_graph(name, spec, self.agents) for name, spec in graphs.items())
