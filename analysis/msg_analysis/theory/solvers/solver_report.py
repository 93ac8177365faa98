# Copyright 2026 msg_agents maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""How a solve went, and the error message if it failed; docs/accuracy.md explains the numbers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

MAX_RELATIVE_ERROR = 1e-6  # largest estimated relative error that is accepted; usual is 1e-13

Method = Literal["cg", "gmres", "direct", "dense"]

Preconditioner = Literal["two-level", "averaged", "none"]


@dataclass(frozen=True, slots=True)
class SolverReport:
    """How the coupled equations were solved."""

    # "cg" where the preconditioned equations are symmetric and positive definite (symmetric graphs, reversible chain;
    # in discrete time only with "averaged"), else "gmres"; "direct" for one graph without loss; "dense": LU.
    method: Method
    preconditioner: Preconditioner  # "two-level": every graph, then their average; "averaged": the average only
    iterations: int  # Krylov iterations, direct solves and steps of refinement
    residual: float  # norm of a graph's residual over that of its right-hand side, in the worst graph
    backward_error: float  # the same over the sum of the norms of the terms that the residual consists of
    # Estimated relative error: the larger of what rounding of the law may leave (in the report of ``MomentSolver``) and
    # the correction that one preconditioned step makes; "dense": the backward error times the condition number.
    error: float

    def to_json(self) -> dict[str, Any]:
        """As in ``msg-analysis predict --json``."""
        return asdict(self)


def singular_message(reason: str = "") -> str:
    """The error message for equations that have no solution that can be trusted; ``reason`` follows "singular"."""
    return (
        f"second moments: the equations are (nearly) singular{reason}, so the errors grow without bound or cannot be "
        "computed: check that the union of the graphs connects all agents and that the rates do not differ by many "
        "orders of magnitude"
    )
