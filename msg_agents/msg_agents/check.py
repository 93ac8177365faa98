"""Does a bag hold, to the last bit, what the law and the seed say?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from msg_analysis.model.step import build_model
from msg_analysis.model.trajectory import Trajectory
from msg_analysis.twin import simulate
from msg_analysis.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Check:
    """What came of it.

    Attributes
    ----------
    compared : states that were there to compare
    missing : states that were not
    difference : the first one in words (steps first, then agents from 1), or None
    """

    compared: int
    missing: int
    difference: str | None


def check(trajectory: Trajectory) -> Check:
    """Compute a lockstep run again with the offline twin and compare every state and every graph.

    Parameters
    ----------
    trajectory : of the bag

    Raises
    ------
    NotAvailableError : the run was not of a kind that the twin repeats
    """
    twin = simulate(trajectory.record.experiment, record=trajectory.record)
    known = trajectory.modes >= 0
    graphs = [graph.name for graph in trajectory.record.experiment.graph_list]
    # What is there at step k comes out of the graph and the losses of the steps before. First come, first named.
    found = [
        _first_state(trajectory, trajectory.states, twin.states, "logged"),
        _first_state(trajectory, trajectory.published, twin.published, "published"),
        _first_loss(trajectory, twin),
        _first(
            known & (trajectory.modes != twin.modes),
            lambda step: (
                f"graph of step {step}: logged {graphs[trajectory.modes[step]]}, "
                f"the seed gives {graphs[twin.modes[step]]}"
            ),
        ),
    ]
    differences = [difference for difference in found if difference is not None]
    first = min(differences, key=lambda difference: difference[0])[1] if differences else None
    compared = trajectory.completeness.received
    return Check(compared, trajectory.completeness.missing, first)


def _first(wrong: BoolArray, describe: Callable[..., str]) -> tuple[float, str] | None:
    """When the first of some things was wrong (steps come first), and a description of it; None if none is."""
    if not wrong.any():
        return None
    where = [int(i) for i in np.argwhere(wrong)[0]]
    return where[0], describe(*where)


def _first_state(
    trajectory: Trajectory, logged: FloatArray | None, law: FloatArray | None, what: str
) -> tuple[float, str] | None:
    if logged is None or law is None:
        return None
    there = ~np.isnan(logged).any(axis=2)

    def describe(step: int, agent: int) -> str:
        here, expected = logged[step, agent], law[step, agent]
        where = int(np.argmax(here != expected))
        row, replica = divmod(where, trajectory.record.experiment.run.replicas)
        number = f", number {row + 1} of the state" if row else ""
        return (
            f"agent {agent + 1} at step {step}, replica {replica + 1}{number}: {what} {float(here[where])!r}, "
            f"the law gives {float(expected[where])!r}"
        )

    return _first(there & (logged != law).any(axis=2), describe)


def _first_loss(trajectory: Trajectory, twin: Trajectory) -> tuple[float, str] | None:
    if trajectory.lost is None or twin.lost is None or trajectory.agent_modes is None:
        return None
    model = build_model(trajectory.record.experiment)
    # Of states that are there, and came out of the right graph: without it the neighbours are others.
    comparable = trajectory.agent_modes[1:] == twin.modes[:, None]
    logged, law = trajectory.lost, twin.lost

    def describe(step: int, agent: int, which: int) -> str:
        sender = int(model.neighbours(int(twin.modes[step]), agent)[which]) + 1
        words = ("heard", "lost")
        return (
            f"the message of agent {sender} to agent {agent + 1} in step {step}: logged as "
            f"{words[int(logged[step, agent, which])]}, the seed gives {words[int(law[step, agent, which])]}"
        )

    # The step has used its graph by then; the states that come out of it are of the next one.
    found = _first(comparable[:, :, None] & (logged != law), describe)
    return found and (found[0] + 0.5, found[1])
