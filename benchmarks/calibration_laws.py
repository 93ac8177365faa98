"""The laws of the calibration: right ones, short runs, messages that are noisy and lost, and laws with one fault."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LINE = [(1, 2), (2, 3), (3, 4), (4, 5)]
RING = [*LINE, (5, 1)]


def line_ring(rate: float = 0.5, *, dt: float = 0.1, duration: float = 400.0, replicas: int = 1) -> dict[str, Any]:
    """Example 1 of the paper."""
    return {
        "name": "line_ring",
        "graphs": {"line": {"edges": [list(e) for e in LINE]}, "ring": {"edges": [list(e) for e in RING]}},
        "switching": {"generator": [[-rate, rate], [rate, -rate]]},
        "noise": {"process": 1.0},
        "run": {"dt": dt, "duration": duration, "replicas": replicas},
    }


def three_lines() -> dict[str, Any]:
    """Example 2 of the paper, at epsilon = 5."""
    return {
        "name": "three_lines",
        "graphs": {
            "line_1": {"path": [2, 3, 4, 5, 1]},
            "line_2": {"path": [1, 2, 3, 4, 5]},
            "line_3": {"path": [5, 1, 2, 3, 4]},
        },
        "switching": {"generator": [[-1.0, 1.0, 0.0], [0.25, -0.5, 0.25], [0.0, 1.0, -1.0]]},
        "noise": {"process": 1.0},
        "run": {"dt": 0.1, "duration": 400.0},
    }


def tracking() -> dict[str, Any]:
    """One leader of finite gain."""
    leaders = {"agents": [3], "gain": 1.0, "reference": 2.0}
    return line_ring() | {"name": "tracking", "problem": "tracking", "leaders": leaders}


def discrete() -> dict[str, Any]:
    """Consensus in discrete time with three graphs."""
    return {
        "name": "discrete",
        "time": "discrete",
        "agents": 4,
        "graphs": {"path": {"path": [1, 2, 3, 4]}, "complete": {"complete": True}, "star": {"star": {"center": 1}}},
        "switching": {"transition": [[0.8, 0.1, 0.1], [0.3, 0.5, 0.2], [0.2, 0.2, 0.6]]},
        "noise": {"process": 1.0},
        "run": {"duration": 1000},
    }


TRUE: dict[str, Mapping[str, Any]] = {
    "line/ring, rate 0.5": line_ring(),
    "line/ring, rate 0.02, 1000 units": line_ring(0.02, dt=0.2, duration=1000.0),
    "three lines": three_lines(),
    "tracking, one leader": tracking(),
    "discrete time, three graphs, 1000 steps": discrete(),
}

FAR = [50.0, -30.0, 20.0, -40.0]


def line_pairs(
    duration: float, start: str | list[float] = "stationary", rate: float = 0.5, replicas: int = 1, **more: Any
) -> dict[str, Any]:
    """Four agents on a line, of which sometimes only the pairs at the ends hear each other."""
    return {
        "name": "line_pairs",
        "graphs": {"line": {"path": [1, 2, 3, 4]}, "pairs": {"edges": [[1, 2], [3, 4]]}},
        "switching": {"generator": [[-rate, rate], [rate, -rate]]},
        "noise": {"process": 1.0},
        "run": {"dt": 0.05, "duration": duration, "start": start, "replicas": replicas},
    } | more


def short(duration: float) -> dict[str, Mapping[str, Any]]:
    """Laws under which a few holding periods, or the start, decide the errors of a short run."""
    leader: dict[str, Any] = {"problem": "tracking", "leaders": {"agents": [1], "gain": 1.0}}
    three: dict[str, Any] = {"graphs": {"line": {"path": [1, 2, 3]}, "pair": {"edges": [[1, 2]]}}, "agents": 3}
    return {
        "steady start": line_pairs(duration),
        "start at zero": line_pairs(duration, "zero"),
        "far start": line_pairs(duration, FAR),
        "far start, 30 units, two replicas": line_pairs(30.0, FAR, replicas=2),
        "far start, tracking": line_pairs(duration, FAR, **leader),
        "far start, 20 % of the messages lost": line_pairs(duration, FAR, noise={"process": 1.0, "loss": 0.2}),
        "far start, no noise": line_pairs(duration, [1.0, 0.0, -3.0], noise={"process": 0.0}, **three),
        "noise common to all agents": line_pairs(duration, noise={"process": [[1.0, 0.0, 0.0, 0.0]] * 4}),
        "rate 0.001": line_pairs(duration, rate=1e-3),
        "rate 0.001, far start": line_pairs(duration, FAR, rate=1e-3),
    }


DURATIONS = (10.0, 20.0, 100.0)
SHORT: dict[str, Mapping[str, Any]] = {
    name if "units" in name else f"{name}, {duration:g} units": law
    for duration in DURATIONS
    for name, law in short(duration).items()
}

NOISY = {"process": 1.0, "broadcast": 0.2, "link": 0.3, "loss": 0.3}


def messages(noise: Mapping[str, Any], pace: str) -> dict[str, Any]:
    """Example 1 of the paper, with messages that are noisy and lost."""
    law = line_ring(duration=100.0) | {"name": "messages", "noise": noise}
    return law | {"run": law["run"] | {"pace": pace}}


MESSAGES: dict[str, Mapping[str, Any]] = {
    "real time, own value in place of a lost one": messages(NOISY, "realtime"),
    "real time, last value held": messages(NOISY | {"on_loss": "hold"}, "realtime"),
    "lockstep, last value held": messages(NOISY | {"on_loss": "hold"}, "lockstep"),
    "lockstep, two links, bursts of 5": messages(NOISY | {"loss": {"edges": [[1, 2, 0.3]]}, "burst": 5}, "lockstep"),
}

LONG: dict[str, Any] = {"duration": 1000.0, "replicas": 16}


def arcs(gain: Mapping[tuple[int, int], float], without: int | None = None) -> dict[str, Any]:
    """The line and the ring arc by arc: gains of (sender, receiver) other than 1, and who hears nobody."""
    found = {}
    for name, edges in (("line", LINE), ("ring", RING)):
        both = [arc for i, j in edges for arc in ((i, j), (j, i)) if arc[1] != without]
        found[name] = {"arcs": [[i, j, gain.get((i, j), 1.0)] for i, j in both]}
    return found


#: What is wrong; and the kind, agent, link and graph of the cause that should be blamed first
FALSE: dict[str, tuple[Mapping[str, Any], tuple[str, int | None, list[int] | None]]] = {
    "one agent's noise variance 5 % larger": (
        line_ring(**LONG) | {"noise": {"process": [1.0, 1.0, 1.05**0.5, 1.0, 1.0]}},
        ("noise", 3, None),
    ),
    "one link's gain 10 % smaller": (line_ring(**LONG) | {"graphs": arcs({(2, 3): 0.9})}, ("gain", None, [2, 3])),
    "switching 40 % faster": (line_ring(0.7, **LONG), ("switching", None, None)),
    "2 % of the messages ignored": (
        line_ring(**LONG) | {"noise": {"process": 1.0, "loss": 0.02}},
        ("ignored", None, None),
    ),
    "one agent frozen": (
        line_ring(**LONG) | {"graphs": arcs({}, without=3), "noise": {"process": [1.0, 1.0, 0.0, 1.0, 1.0]}},
        ("frozen", 3, None),
    ),
}
