# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""What several keys of an experiment must satisfy together; each check returns the mistakes that it finds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from msg_analysis.common.arrays import BoolArray, FloatArray
from msg_analysis.common.text import agent_name, agent_text, listed
from msg_analysis.experiment.graphs import Graph, hops, reach, widest_reaching
from msg_analysis.experiment.markov_chain import MarkovChain, Schedule, Time
from msg_analysis.experiment.problems import problem, show
from msg_analysis.experiment.spec import ErlangSpec, LeadersSpec, NoiseGain, NoiseSpec, RunSpec, SwitchingSpec
from msg_analysis.experiment.values import LossSpec

SUM_TOLERANCE = 1e-9
STEP_TOLERANCE = 1e-9
MOST_STEPS = 1e15
"""Beyond this, a double cannot tell one step from the next."""
MOST_GIVEN_STEPS = 1e8
"""Of a run as long as its schedule: more are rather times in another unit."""
LONGEST_DURATION = 2**31 - 1
"""A message's stamp has 32 bits for the seconds of simulated time."""


SCHEDULE_KEYS = ("end", "repeat", "map", "hold", "radius", "undirected", "weight")
"""Of ``switching``, that belong to a schedule or a trace."""


def switching_of(
    switching: SwitchingSpec, names: Sequence[str], time: Time
) -> tuple[MarkovChain | Schedule | None, list[str]]:
    """What the file says that switches, and what is wrong with it (then it is None)."""
    if switching.schedule is None:
        given = [key for key in SCHEDULE_KEYS if getattr(switching, key) is not None]
        lines = [
            problem(f"switching.{key}", getattr(switching, key), "expected with a schedule or a trace", "remove it")
            for key in given
        ]
        if switching.links is not None:
            lines += _alone(switching, "links that switch by themselves")
            if len(names) > 1:
                wanted = "expected one graph, with all links that switch by themselves"
                lines.append(problem("graphs", listed(names), wanted, "remove the others"))
            return None, lines
        chain, found = _chain_of(switching, names, time)
        if chain and switching.sojourn:
            lines += _shape_problems(switching.sojourn, chain, names)
        return (None if lines else chain), lines + found
    found = _alone(switching, "a schedule", "links", "map", "hold", "radius", "undirected", "weight")
    before = -1.0
    for place, (start, name) in enumerate(switching.schedule, start=1):
        key = f"switching.schedule[{place}]"
        if name not in names:
            found.append(problem(key, show(name), f"expected one of the graphs {', '.join(names)}", "correct it"))
        if place == 1 and start != 0.0:
            found.append(problem(key, start, "expected 0, the start of the run", "say which graph is first"))
        elif start <= before:
            found.append(problem(key, start, f"expected more than {before:g}, the time before", "sort them"))
        before = start
    end = math.inf if switching.end is None else switching.end
    if end <= before:
        found.append(problem("switching.end", end, f"expected more than {before:g}, the last time", "raise it"))
    if switching.repeat and math.isinf(end):
        found.append(problem("switching.repeat", True, "expected with the end of the schedule", "add `end` or `hold`"))
    if found:
        return None, found
    starts, order = zip(*switching.schedule, strict=True)
    numbers = {name: mode for mode, name in enumerate(names)}
    path = np.array(starts), np.array([numbers[name] for name in order])
    return Schedule(*path, len(names), end, bool(switching.repeat)), []


def _shape_problems(sojourn: Mapping[str, ErlangSpec], chain: MarkovChain, names: Sequence[str]) -> list[str]:
    """Graphs with Erlang holding times that are not there, or are left faster than a phase in a step."""
    found = []
    for name, erlang in sojourn.items():
        key = f"switching.sojourn.{name}"
        if name not in names or len(names) == 1:
            wanted = f"expected one of several graphs: {', '.join(names)}"
            found.append(problem(key, "unknown graph", wanted, "correct the name"))
        elif chain.time == "discrete":
            leaving = 1.0 - float(chain.matrix[names.index(name), names.index(name)])
            if erlang.shape * leaving > 1.0:
                wanted = f"expected at most {math.floor(1.0 / leaving)}, since a phase takes a step at least"
                found.append(problem(f"{key}.shape", erlang.shape, wanted, "lower it"))
    return found


def _alone(switching: SwitchingSpec, beside: str, *more: str) -> list[str]:
    """Keys of a chain, and ``more``, which cannot be given with something else."""
    keys = ("generator", "rates", "transition", "scale", "sojourn", "initial", *more)
    given = [key for key in keys if getattr(switching, key) != type(switching).model_fields[key].default]
    return [problem(f"switching.{key}", "given", f"expected without {beside}", "remove one of them") for key in given]


def scheduled_run(run: RunSpec, switching: SwitchingSpec) -> tuple[RunSpec, list[str]]:
    """A run of a schedule, which begins at known places and ends with it at the latest; and what is wrong with it."""
    changes, found = dict[str, Any](), []
    if run.start == "stationary":
        changes["start"] = "zero"
        if "start" in run.model_fields_set:
            wanted = "expected 'zero' or values, since a stationary start needs a Markov chain of graphs"
            found.append(problem("run.start", "stationary", wanted, "say where the agents are"))
    if switching.end is not None and not switching.repeat:
        if "duration" not in run.model_fields_set and switching.end / run.dt > MOST_GIVEN_STEPS:
            wanted = f"expected at most {MOST_GIVEN_STEPS:.0e} steps, and until {switching.end:.6g} there are more"
            remedy = "raise it, or divide the times, if they are milli- or nanoseconds"
            found.append(problem("run.dt", run.dt, wanted, remedy))
        elif "duration" not in run.model_fields_set:
            changes["duration"] = max(1, math.floor(switching.end / run.dt * (1.0 + STEP_TOLERANCE))) * run.dt
        elif run.duration > switching.end * (1.0 + STEP_TOLERANCE):
            wanted = f"expected at most {switching.end:.12g}, where the schedule ends"
            found.append(problem("run.duration", run.duration, wanted, "lower it, or add `repeat: true`"))
    return run.model_copy(update=changes), found


def _chain_of(switching: SwitchingSpec, names: Sequence[str], time: Time) -> tuple[MarkovChain | None, list[str]]:
    """The chain that the file describes, and what is wrong with it (then the chain is None)."""
    found = []
    if switching.initial not in ("stationary", *names):
        wanted = f"expected 'stationary' or one of the graphs {', '.join(names)}"
        found.append(problem("switching.initial", show(switching.initial), wanted, "use one of them"))
    given = [key for key in ("generator", "rates", "transition") if getattr(switching, key) is not None]
    wanted = "generator or rates" if time == "continuous" else "transition"
    if not given:
        if len(names) == 1:
            return MarkovChain(time, np.array([[0.0 if time == "continuous" else 1.0]])), found
        why = f"expected {wanted}, since there are {len(names)} graphs"
        return None, [*found, problem("switching", "missing", why, f"add {wanted}")]
    if len(given) > 1:
        return None, [*found, problem("switching", " and ".join(given), "expected one of them", "remove the others")]
    key = given[0]
    if (key == "transition") != (time == "discrete"):
        remedy = f"give {wanted}, or change `time`"
        return None, [*found, problem(f"switching.{key}", f"given in {time} time", f"expected {wanted}", remedy)]
    if switching.scale != 1.0 and key != "rates":
        found.append(problem("switching.scale", switching.scale, "expected with rates only", "remove it"))
    if switching.rates is not None:
        matrix, more = _from_rates(switching.rates, switching.scale, names)
    else:
        matrix, more = _from_matrix(key, switching.generator or switching.transition or [], names)
    if matrix is None:
        return None, found + more
    chain = MarkovChain(time, matrix)
    found += _ergodicity_problems(chain, names, f"switching.{key}")
    return (None if found else chain), found


def _from_rates(
    rates: Mapping[str, Mapping[str, float]], scale: float, names: Sequence[str]
) -> tuple[FloatArray | None, list[str]]:
    found = []
    index = {name: mode for mode, name in enumerate(names)}
    matrix = np.zeros((len(names), len(names)))
    for source, row in rates.items():
        for name, key in [(source, "switching.rates"), *((target, f"switching.rates.{source}") for target in row)]:
            if name not in index:
                wanted = f"expected one of the graphs {', '.join(names)}"
                found.append(problem(f"{key}.{name}", "unknown graph", wanted, "correct the name"))
        if source in row:
            key = f"switching.rates.{source}.{source}"
            found.append(problem(key, row[source], "expected rates to other graphs only", "remove it"))
        for target, rate in row.items():
            if source in index and target in index:
                matrix[index[source], index[target]] = rate * scale
    return (None if found else matrix - np.diag(matrix.sum(axis=1))), found


def _from_matrix(
    key: str, rows: Sequence[Sequence[float]], names: Sequence[str]
) -> tuple[FloatArray | None, list[str]]:
    n = len(names)
    generator = key == "generator"
    if len(rows) != n or any(len(row) != n for row in rows):
        shape = f"{len(rows)} rows of {' or '.join(sorted({str(len(row)) for row in rows})) or 'no'} entries"
        wanted = f"expected {n} x {n}, one row and column for each graph"
        return None, [problem(f"switching.{key}", shape, wanted, "rows and columns are the graphs in file order")]
    matrix = np.array(rows, dtype=float)
    found = []
    for i, j in np.ndindex(n, n):
        value = float(matrix[i, j])
        place = f"switching.{key}[{i + 1}][{j + 1}]"
        if generator and i != j and value < 0:
            found.append(problem(place, value, "expected a rate >= 0", f"rate from {names[i]} to {names[j]}"))
        elif not generator and not 0 <= value <= 1:
            wanted = "expected a probability between 0 and 1"
            found.append(problem(place, value, wanted, f"probability from {names[i]} to {names[j]}"))
    target = 0.0 if generator else 1.0
    for i, total in wrong_sums(matrix, target):
        remedy = "the diagonal is minus the sum of the others" if generator else "correct the row"
        where = f"row {i + 1} ({names[i]}) sums to {total:.12g}"
        found.append(problem(f"switching.{key}[{i + 1}]", where, f"expected {target:g}", remedy))
    if found:
        return None, found
    if generator:
        np.fill_diagonal(matrix, 0.0)
        np.fill_diagonal(matrix, 0.0 - matrix.sum(axis=1))
        return matrix, []
    return np.asarray(matrix / matrix.sum(axis=1, keepdims=True)), []


def wrong_sums(matrix: FloatArray, target: float) -> Iterator[tuple[int, float]]:
    """The rows (from 0) whose sum is not ``target``, apart from rounding, and their sums."""
    for i, row in enumerate(matrix):
        total = math.fsum(row)
        if abs(total - target) > SUM_TOLERANCE * float(np.abs(row).max()):
            yield i, total


def _ergodicity_problems(chain: MarkovChain, names: Sequence[str], key: str) -> list[str]:
    """Graphs that cannot be reached, or a period of the chain (assumption 1 of the paper); ``key`` is for messages."""
    if chain.ergodic:
        return []
    for source in range(chain.modes):
        unreached = np.flatnonzero(hops(chain.matrix > 0, [source]) < 0).tolist()
        if unreached:
            text = f"{', '.join(names[mode] for mode in unreached)} cannot be reached from {names[source]}"
            return [problem(key, text, "expected an ergodic chain", "let every graph lead to every other one")]
    text = f"the chain has period {chain.period}"
    return [problem(key, text, "expected an ergodic chain", "give some graph a probability > 0 to stay")]


def connection_problems(
    graphs: Sequence[Graph], leaders: LeadersSpec | None, names: Sequence[str] | None = None, *, sparse: bool = False
) -> list[str]:
    """Agents that are not connected in the union of all graphs; ``leaders`` is None in consensus."""
    # Mean-square stability of the disagreement (tracking: of the deviation from the reference) needs a union in which
    # some agent (tracking: the leaders together) reaches every other one.
    sources = None if leaders is None else [label - 1 for label in leaders.agents]
    if sparse:
        sources, reached = reach(graphs, sources)
    else:
        union = union_of(graphs).T
        sources = widest_reaching(union) if sources is None else sources
        reached = hops(union, sources) >= 0
    lost = np.flatnonzero(~reached).tolist()
    if not lost:
        return []
    start = "a leader" if leaders is not None else f"agent{_list(sources, names)}"
    text = f"agent{_list(lost, names)} cannot be reached from {start} in the union of all graphs"
    return [problem("graphs", text, "expected a union that connects all agents", "add an edge, or lower `agents`")]


def _list(agents: Sequence[int], names: Sequence[str] | None) -> str:
    """`` 3`` or ``s 1, 2, 3``: agents (from 0) as texts count or name them, after the word "agent"."""
    shown = ", ".join(agent_name(agent + 1, names) for agent in agents[:8])
    more = f" and {len(agents) - 8} more" if len(agents) > 8 else ""
    return ("s " if len(agents) > 1 else " ") + shown + more


def noise_gain_of(noise: NoiseSpec, names: Sequence[str], agents: int) -> tuple[FloatArray, list[str]]:
    """(n, m, m) F of every graph as ``noise.process`` has it, and what is wrong with it."""
    if not isinstance(noise.process, dict):
        gain, found = _gain_of("noise.process", noise.process, agents)
        return np.broadcast_to(gain, (len(names), *gain.shape)), found  # stored once
    found = []
    for name in noise.process:
        if name not in names:
            wanted = f"expected one of the graphs {', '.join(names)}"
            found.append(problem(f"noise.process.{name}", "unknown graph", wanted, "correct the name"))
    gains = np.zeros((len(names), agents, agents))
    for mode, name in enumerate(names):
        key = f"noise.process.{name}"
        if name not in noise.process:
            found.append(problem(key, "missing", "expected the noise of every graph", f"for example {name}: 1.0"))
            continue
        gain, faults = _gain_of(key, noise.process[name], agents)
        found += faults
        if not faults:
            gains[mode] = gain
    return gains, found


def _gain_of(key: str, value: NoiseGain, agents: int) -> tuple[FloatArray, list[str]]:
    """(m, m) F, and what is wrong with its shape."""
    rows = value if isinstance(value, list) else []
    ragged = len({len(row) for row in rows if isinstance(row, list)}) > 1
    f = np.empty((0, 0)) if ragged else np.array(value, dtype=float)
    if f.ndim == 0:
        return np.eye(agents) * f, []
    if f.shape == (agents,):
        return np.diag(f), []
    if f.shape == (agents, agents):
        return f, []
    shape = "rows of different lengths"
    if f.size:
        shape = f"{len(f)} entries" if f.ndim == 1 else f"{f.shape[0]} x {f.shape[1]}"
    wanted = f"expected a number, {agents} numbers or a {agents} x {agents} matrix F"
    return f, [problem(key, shape, wanted, f"there are {agents} agents")]


def burst_problems(burst: float, loss: LossSpec) -> list[str]:
    """Losses so likely that they cannot come in bursts as short as this."""
    found = []
    for key, probability in [("", loss.default), *((f" of {i} to {j}", p) for i, j, p in (*loss.edges, *loss.arcs))]:
        shortest = probability / (1.0 - probability)
        if burst <= shortest:
            wanted = f"expected more than p / (1 - p) = {shortest:.6g}, with the loss{key} p = {probability:g}"
            found.append(problem("noise.burst", burst, wanted, "raise it, or lower noise.loss"))
    return found


def whole_link_problems(loss: FloatArray, noise: NoiseSpec) -> list[str]:
    """Losses (m, m) that cannot take both directions of a link."""
    if not noise.loss.any:
        return [problem("noise.whole_link", True, "expected with noise.loss", "add it, or remove this")]
    if np.array_equal(loss, loss.T):
        return []
    i, j = (np.argwhere(loss != loss.T)[0] + 1).tolist()
    wanted = f"expected one probability for both directions, not two between the agents {i} and {j}"
    return [problem("noise.whole_link", True, wanted, "give noise.loss.edges in place of arcs")]


def listed_problems(
    key: str, numbers: Sequence[int], what: str, agents: int | None, names: Sequence[str] | None = None
) -> list[str]:
    """Agents that a list has twice, or that are not there; ``agents``: None if unknown."""
    found = []
    for label in sorted(label for label in set(numbers) if numbers.count(label) > 1):
        who = agent_text(label, names)
        found.append(problem(key, f"{who} twice", f"expected every {what} once", "remove one"))
    for label in numbers:
        if agents is not None and label > agents:
            found.append(problem(key, f"agent {label}", f"expected agents 1 to {agents}", "correct it"))
    return found


def leader_problems(
    problem_kind: str, leaders: LeadersSpec | None, agents: int | None, names: Sequence[str] | None = None
) -> list[str]:
    """Leaders that are forbidden, missing, duplicate, unknown or without followers; ``agents``: None if unknown."""
    if problem_kind == "consensus":
        if leaders is None:
            return []
        return [problem("leaders", "given with problem: consensus", "expected none", "set problem: tracking")]
    if leaders is None:
        wanted = "expected leaders, since problem is tracking"
        return [problem("leaders", "missing", wanted, "for example leaders: {agents: [1], gain: 1.0}")]
    found = []
    found += listed_problems("leaders.agents", leaders.agents, "leader", agents, names)
    if agents is None:
        return found
    if math.isinf(leaders.gain) and len(set(leaders.agents)) >= agents:
        wanted = "expected at least one agent that follows"
        found.append(problem("leaders.agents", "all agents, with gain inf", wanted, "remove a leader"))
    return found


def stability_limit(graph: Graph, gains: FloatArray) -> float:
    """Limit of dt: I - dt Z, Z = L + diag(gains), is stable below min 2 Re(lambda) / |lambda|^2 over lambda != 0 of Z.

    Rows and columns of agents with infinite gain are deleted; ``gains`` (m,) kappa. inf for a graph without links.
    """
    moved = np.isfinite(gains) & (graph.degrees + gains > 0.0)  # the others have rows of zeros
    z = (graph.laplacian + np.diag(np.where(moved, gains, 0.0)))[np.ix_(moved, moved)]
    values = np.linalg.eigvalsh(z) if np.array_equal(z, z.T) else np.linalg.eigvals(z)
    size = np.abs(values)
    moving = size > 1e-9 * size.max(initial=np.finfo(float).tiny)
    values, size = values[moving], size[moving]
    return float(np.min(2.0 * (values.real / size) / size, initial=np.inf))


def stability_problems(graphs: Iterable[Graph], gains: FloatArray, dt: float, *, sparse: bool = False) -> list[str]:
    """Graphs for which an Euler step of dt is unstable; ``gains`` (m,) kappa, inf for grounded leaders."""
    found = []
    for graph in graphs:
        pull = (graph.degrees + gains)[np.isfinite(gains)].max(initial=0.0)
        if dt * pull < 1.0:
            continue  # no agent overshoots (Gershgorin)
        # Without matrices no eigenvalues are known, and steps with which an agent overshoots are refused.
        limit = 1.0 / pull if sparse else stability_limit(graph, gains)
        if dt >= limit:
            wanted = f"expected less than {limit:.6g}, the stability limit of graph {graph.name}"
            found.append(problem("run.dt", dt, wanted, "lower run.dt"))
    return found


def run_problems(run: RunSpec, time: Time, agents: int | None) -> list[str]:
    """Steps, durations and starting values that do not fit; ``agents`` is None where unknown."""
    found = []
    if run.pace == "lockstep" and run.delivery == "best_effort":
        wanted = "in lockstep expected reliable, since every value is needed"
        found.append(problem("run.delivery", "best_effort", wanted, "remove it, or use run.pace: realtime"))
    if time == "discrete" and run.dt != 1.0:
        found.append(problem("run.dt", run.dt, "expected 1 in discrete time", "remove run.dt"))
    else:
        steps = run.duration / run.dt
        if steps > MOST_STEPS:
            wanted = f"expected at most {MOST_STEPS:.0e} steps"
            found.append(problem("run.dt", run.dt, wanted, "raise run.dt, or lower run.duration"))
        elif round(steps) < 1 or abs(steps - round(steps)) > STEP_TOLERANCE * steps:
            near = max(round(steps), 1) * run.dt
            wanted = f"expected a whole number of steps of {run.dt:g}"
            found.append(problem("run.duration", run.duration, wanted, f"for example {near:.12g}"))
    if run.duration > LONGEST_DURATION:
        wanted = f"expected at most {LONGEST_DURATION}, the largest stamp of a message"
        found.append(problem("run.duration", run.duration, wanted, "lower run.duration"))
    if isinstance(run.start, list) and agents is not None and len(run.start) != agents:
        wanted = f"expected one value for each of the {agents} agents"
        found.append(problem("run.start", f"{len(run.start)} values", wanted, "give as many as there are agents"))
    return found


def external_problems(run: RunSpec, agents: int | None, *, protocol: bool) -> list[str]:
    """External agents that are not there, or twice, or of a protocol; a frame without poses."""
    external = run.external or []
    found = listed_problems("run.external", external, "agent", agents)
    if external and protocol:
        wanted = "expected none with a protocol: its agents are in its package"
        found.append(problem("run.external", show(external), wanted, "remove run.external, or the protocol"))
    if run.publish and run.publish.count("pose") > 1:
        found.append(problem("run.publish", show(run.publish), "expected each once", "remove one"))
    if run.frame is not None and not run.publish:
        found.append(problem("run.frame", show(run.frame), "expected with run.publish only", "remove it"))
    return found


def leader_gains(leaders: LeadersSpec | None, agents: int) -> FloatArray:
    """(m,) kappa; 0 for followers, inf for grounded leaders."""
    gains = np.zeros(agents)
    if leaders:
        gains[np.array(leaders.agents) - 1] = leaders.gain
    return gains


def union_of(graphs: Sequence[Graph]) -> BoolArray:
    """(m, m) whether agent i listens to agent j in some graph."""
    union = np.zeros((graphs[0].agents,) * 2, dtype=np.bool_)
    for graph in graphs:
        union[graph.targets, graph.sources] = True
    return union


def heard_links(graphs: Sequence[Graph], time: Time) -> BoolArray:
    """(m, m) whether agent i hears agent j in some graph: in discrete time, with exp(-Z), over many arcs, too."""
    heard = union_of(graphs)
    if time == "discrete":
        heard = np.any([[hops(graph.adjacency > 0, [i]) > 0 for i in range(graph.agents)] for graph in graphs], axis=0)
    return np.asarray(heard)


def unknown_name(
    key: str, agent: int | str, names: Sequence[str], others: str = "expected a number, since no agent is named"
) -> str:
    """The mistake of an agent that is not there; ``others``: what was expected where no agent has a name."""
    return problem(key, show(agent), f"expected one of the names {listed(names)}" if names else others, "correct it")


def loss_matrix(
    loss: LossSpec, graphs: Sequence[Graph], time: Time, names: Sequence[str] | None
) -> tuple[FloatArray, list[str]]:
    """(m, m) probability that a message from agent j (column) to agent i (row) is lost, and what is wrong with it."""
    agents, found = graphs[0].agents, []
    heard = heard_links(graphs, time)
    matrix = np.where(np.eye(agents, dtype=np.bool_), 0.0, loss.default)
    seen: set[tuple[int, int]] = set()
    directed = [("arcs", int(i), int(j), p) for i, j, p in loss.arcs]
    directed += [("edges", *ends, p) for i, j, p in loss.edges for ends in ((int(i), int(j)), (int(j), int(i)))]
    for kind, i, j, probability in directed:
        key, ends = f"noise.loss.{kind}", show([i, j] if names is None else [agent_name(a, names) for a in (i, j)])
        if max(i, j) > agents or not heard[j - 1, i - 1]:
            wanted = f"expected agents of which {agent_name(j, names)} hears {agent_name(i, names)} in some graph"
            found.append(problem(key, ends, wanted, "correct it"))
        elif (i, j) in seen:
            found.append(problem(key, ends, "expected every link once, in each direction", "remove one"))
        else:
            matrix[j - 1, i - 1] = probability
        seen.add((i, j))
    return matrix, found
