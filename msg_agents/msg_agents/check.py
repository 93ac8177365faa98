"""Does a bag hold, to the last bit, what the law and the seed say?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_analysis.model.trajectory import Trajectory
from msg_analysis.twin import simulate


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
    present = trajectory.present
    known = trajectory.modes >= 0
    wrong_mode = known & (trajectory.modes != twin.modes)
    wrong_state = present & (trajectory.states != twin.states).any(axis=2)
    names = [graph.name for graph in trajectory.record.experiment.graph_list]
    difference = None
    first_mode = int(np.argmax(wrong_mode)) if wrong_mode.any() else None
    if wrong_state.any():
        step, agent = (int(i) for i in np.argwhere(wrong_state)[0])
        logged, expected = trajectory.states[step, agent], twin.states[step, agent]
        replica = int(np.argmax(logged != expected))
        if first_mode is None or step <= first_mode:
            difference = (
                f"agent {agent + 1} at step {step}, replica {replica + 1}: logged {float(logged[replica])!r}, "
                f"the law gives {float(expected[replica])!r}"
            )
    if difference is None and first_mode is not None:
        difference = (
            f"graph of step {first_mode}: logged {names[trajectory.modes[first_mode]]}, "
            f"the seed gives {names[twin.modes[first_mode]]}"
        )
    compared = int(present.sum())
    return Check(compared, present.size - compared, difference)
