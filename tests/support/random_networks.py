"""Random experiments: valid, of every kind that runs in lockstep, and the same for a seed on every machine."""

import random
from collections.abc import Sequence
from decimal import Decimal
from typing import Any

MOST_AGENTS, MOST_GRAPHS = 12, 4
STATES = (15_000, 45_000)  # of all agents together: a few seconds
SHARE_OF_LIMIT = (0.05, 0.9)  # dt, relative to a lower bound of the stability limit
EVENTS_PER_STEP = (-3.0, 0.3)  # exponents of 10: holding periods from a thousand steps down to half of one
GRAPH_NAMES = ("north", "line_2", "at night", "β")

Document = dict[str, Any]


def random_document(seed: int) -> Document:
    """An experiment file as data; ``docs/experiment.md`` describes the keys."""
    draw = random.Random(f"network {seed}")
    agents = draw.randint(2, MOST_AGENTS)
    names = GRAPH_NAMES[: draw.randint(1, MOST_GRAPHS)]
    document: Document = {
        "name": f"network_{seed}",
        "problem": draw.choice(["consensus", "tracking"]),
        "time": draw.choice(["continuous", "continuous", "discrete"]),
        "agents": agents,
    }
    leaders: list[int] = []
    pull = 0.0
    if document["problem"] == "tracking":
        leaders = sorted(draw.sample(range(1, agents + 1), draw.randint(1, max(1, agents // 3))))
        pull = draw.choice([0.0, _rounded(draw.uniform(0.2, 5.0))])  # 0: held at the reference
        document["leaders"] = {"agents": leaders, "gain": pull or "inf", "reference": _rounded(draw.uniform(-5.0, 5.0))}
    graphs = _graphs(draw, agents, len(names), leaders[0] if leaders else draw.randint(1, agents))
    document["graphs"] = dict(zip(names, graphs, strict=True))
    step = 1.0
    if document["time"] == "continuous":
        # By Gershgorin's theorem the eigenvalues are at most twice the largest in-degree, plus the pull.
        bound = 1.0 / (max(_largest_degree(graph, agents) for graph in graphs) + pull)
        step = _rounded(draw.uniform(*SHARE_OF_LIMIT) * bound)
    if len(names) > 1:
        document["switching"] = _switching(draw, names, step, discrete=document["time"] == "discrete")
    document["noise"] = _noise(draw, agents, names)
    steps = draw.randint(*STATES) // agents
    document["run"] = {
        "dt": step,
        "duration": float(Decimal(str(step)) * steps),
        "replicas": draw.randint(1, 6),
        "seed": draw.randrange(2**31),
        "start": draw.choice(["stationary", "zero", [_rounded(draw.uniform(-9.0, 9.0)) for _ in range(agents)]]),
        "processes": draw.choice(["auto", "one_per_agent", draw.randint(1, agents)]),
    }
    _complicate(random.Random(f"links {seed}"), document)
    return document


def _rounded(value: float) -> float:
    """To three digits: what C libraries differ in, in the last digit of a power for example, is gone."""
    return float(f"{value:.3g}")


def _graphs(draw: random.Random, agents: int, count: int, root: int) -> list[Document]:
    """Graphs in whose union the root reaches all agents: in one graph, or only in all together."""
    if draw.random() < 0.5:
        graphs = [_any_graph(draw, agents) for _ in range(count - 1)]
        graphs.insert(draw.randrange(count), _connected_graph(draw, agents, root))
        return graphs
    parts: list[list[list[float]]] = [[] for _ in range(count)]
    for link in _tree(draw, agents, root):
        draw.choice(parts).append(link)
    return [{"edges": part} if part else _any_graph(draw, agents) for part in parts]


def _connected_graph(draw: random.Random, agents: int, root: int) -> Document:
    kind = draw.choice(["path", "cycle", "star", "complete", "grid", "arcs", "edges"])
    order = draw.sample(range(1, agents + 1), agents)
    if kind == "star":
        return {"star": {"center": root}}
    if kind == "complete":
        return {"complete": True}
    if kind == "grid":
        rows = draw.choice([rows for rows in range(1, agents + 1) if agents % rows == 0])
        return {"grid": [rows, agents // rows]}
    if kind in ("arcs", "edges"):
        return {kind: _tree(draw, agents, root)}
    return {"cycle": order} if kind == "cycle" and agents > 2 else {"path": order}


def _any_graph(draw: random.Random, agents: int) -> Document:
    """One that may leave agents out."""
    some = draw.sample(range(1, agents + 1), draw.randint(2, agents))
    kind = draw.choice(["path", "cycle", "edges", "arcs"])
    if kind == "cycle" and len(some) > 2:
        return {"cycle": some}
    if kind in ("edges", "arcs"):
        pairs = [[i, j] for i in some for j in some if (i < j if kind == "edges" else i != j)]
        return {kind: [_weighted(draw, pair) for pair in draw.sample(pairs, draw.randint(1, len(pairs)))]}
    return {"path": some}


def _tree(draw: random.Random, agents: int, root: int) -> list[list[float]]:
    """Links from agents that the root reaches to those that it does not reach yet."""
    rest = [agent for agent in range(1, agents + 1) if agent != root]
    draw.shuffle(rest)
    reached = [root]
    links = []
    for agent in rest:
        links.append(_weighted(draw, [draw.choice(reached), agent]))
        reached.append(agent)
    return links


def _weighted(draw: random.Random, pair: Sequence[int]) -> list[float]:
    return [*pair, _rounded(draw.uniform(0.1, 3.0))] if draw.random() < 0.7 else list(pair)


def _largest_degree(graph: Document, agents: int) -> float:
    """Largest sum of the weights of what one agent listens to, or more."""
    ((kind, content),) = graph.items()
    if kind in ("edges", "arcs"):
        degrees = [0.0] * (agents + 1)
        for first, second, *weight in content:
            degrees[second] += weight[0] if weight else 1.0
            if kind == "edges":
                degrees[first] += weight[0] if weight else 1.0
        return max(degrees)
    return {"path": 2.0, "cycle": 2.0, "grid": 4.0}.get(kind, agents - 1.0)


def _switching(draw: random.Random, names: Sequence[str], step: float, *, discrete: bool) -> Document:
    """A chain that goes around all graphs, and along some other transitions."""
    count = len(names)
    there = [[j == (i + 1) % count or draw.random() < 0.4 for j in range(count)] for i in range(count)]
    section: Document = {"initial": draw.choice(["stationary", *names])}
    expected = [[_rounded(10 ** draw.uniform(*EVENTS_PER_STEP)) for _ in names] for _ in names]
    if discrete:
        stay = [draw.uniform(0.3, 10.0) for _ in names]  # one that is above 0 makes the chain aperiodic
        rows = [[stay[i] if i == j else expected[i][j] * there[i][j] for j in range(count)] for i in range(count)]
        return section | {"transition": [[entry / sum(row) for entry in row] for row in rows]}
    rates = [
        [_rounded(expected[i][j] / step) if there[i][j] and i != j else 0.0 for j in range(count)] for i in range(count)
    ]
    if draw.random() < 0.5:
        return section | {
            "generator": [[-sum(row) if i == j else row[j] for j in range(count)] for i, row in enumerate(rates)]
        }
    named = {names[i]: {names[j]: rate for j, rate in enumerate(row) if rate} for i, row in enumerate(rates)}
    return section | {"rates": named, "scale": draw.choice([1.0, _rounded(draw.uniform(0.2, 1.5))])}


def _noise(draw: random.Random, agents: int, names: Sequence[str]) -> Document:
    section: Document = {"process": _gain(draw, agents)}
    if draw.random() < 0.25:
        section["process"] = {name: _gain(draw, agents) for name in names}
    for kind, most in (("broadcast", 2.0), ("link", 2.0), ("loss", 0.6)):
        if draw.random() < 0.25:
            section[kind] = _rounded(draw.uniform(0.01, most))
    return section


def _complicate(draw: random.Random, document: Document) -> None:
    """Delays, and losses in bursts or replaced by the last value heard, in some of the networks."""
    noise, run = document["noise"], document["run"]
    if draw.random() < 0.25:
        noise["delay"] = draw.choice([1, 2, 3, 20])
    if "loss" not in noise or draw.random() < 0.25:
        return
    if draw.random() < 0.6:
        noise["on_loss"] = "hold"
    if draw.random() < 0.5:
        noise["burst"] = _rounded(1.0 + 1.1 * noise["loss"] / (1.0 - noise["loss"]) + 10 ** draw.uniform(0.0, 2.3))
    if run["start"] == "stationary":  # a past may be too long, and there need not be a prediction in its place
        run["start"] = "zero"


def _gain(draw: random.Random, agents: int) -> Any:
    kind = draw.choice(["number", "none", "agents", "agents", "matrix"])
    if kind == "matrix":
        return [[_rounded(draw.gauss(0.0, 1.0)) for _ in range(agents)] for _ in range(agents)]
    if kind == "agents":
        return [_rounded(draw.uniform(0.0, 2.0)) for _ in range(agents)]
    return 0.0 if kind == "none" else _rounded(draw.uniform(0.1, 2.0))
