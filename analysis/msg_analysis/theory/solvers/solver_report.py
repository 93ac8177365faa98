"""How a solve went, and what is said if it did not go well.

docs/accuracy.md says what the numbers mean.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

MAX_RELATIVE_ERROR = 1e-6
"""Largest estimated relative error that is let through; usual is 1e-13."""

Method = Literal["cg", "gmres", "direct", "dense"]

Preconditioner = Literal["two-level", "averaged", "none"]


@dataclass(frozen=True, slots=True)
class SolverReport:
    """How the coupled equations were solved.

    Attributes
    ----------
    method
        "cg" (reversible chain, symmetric graphs, continuous time) or "gmres", "direct" for one graph alone, "dense" (LU
        of the half-vectorised equations)
    preconditioner
        "two-level" (every graph alone, then their average), "averaged" (the average in place of every graph), "none"
    iterations
        applications of the preconditioner; for "dense", steps of refinement
    residual
        largest norm of a graph's residual, over that of its right-hand side
    backward_error
        largest norm of a graph's residual, over the sum of the norms of the terms that it consists of
    error
        estimated relative error: size of the correction that one more step would make; for "dense", the backward error
        times the condition number
    """

    method: Method
    preconditioner: Preconditioner
    iterations: int
    residual: float
    backward_error: float
    error: float

    def to_json(self) -> dict[str, Any]:
        """As in ``msg-analysis predict --json``."""
        return asdict(self)


def singular_message(reason: str = "") -> str:
    """What is said of equations that have no solution, or none that can be trusted.

    Parameters
    ----------
    reason
        what is known of it, put behind "singular"
    """
    return (
        f"second moments: the equations are (nearly) singular{reason}, so the errors grow without bound or cannot be "
        "computed: check that the union of the graphs connects everybody and that the rates do not differ by many "
        "orders of magnitude"
    )
