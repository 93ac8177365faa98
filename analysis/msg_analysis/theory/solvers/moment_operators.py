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

"""The operators of second moments as matrices on packed moments, mode by mode: for closed forms and transients.

Dense, so for small systems. Symmetric matrices are vectors of their p = d (d + 1) / 2 free entries
(``packed_symmetric``).
They are the paper's M and N (Proposition 1), in discrete time its A and H (Proposition 6).
"""

from __future__ import annotations

import numpy as np

from msg_analysis.theory.solvers.propagator import Propagator
from msg_analysis.theory.system import packed_symmetric
from msg_analysis.theory.system.jump_system import JumpSystem
from msg_analysis.types import FloatArray


def mode_operators(system: JumpSystem) -> FloatArray:
    """(n, p, p) matrices of C -> Z_i C + C Z_i^T (continuous time) or of C -> C - K_i[C] (discrete time)."""
    if system.time == "continuous":
        return np.stack([packed_symmetric.lyapunov(z) for z in system.matrices])
    p = packed_symmetric.size(system.dimension)
    operators = np.zeros((system.modes, p, p))
    for k, entry in enumerate(np.eye(p)):
        basis = np.broadcast_to(packed_symmetric.unpack(entry, system.dimension), system.matrices.shape)
        operators[:, :, k] = entry - packed_symmetric.pack(system.propagate(basis))
    return operators


def second_moment_propagator(system: JumpSystem) -> Propagator:
    """Of the stack (n, p + 1) of packed C_i beside pi_i: the equations for c(t) and pi(t) in one, noise included."""
    n, p = system.modes, packed_symmetric.size(system.dimension)
    local = np.zeros((n, p + 1, p + 1))
    local[:, :p, :p] = -mode_operators(system)
    local[:, :p, p] = packed_symmetric.pack(system.noise)
    return Propagator(system.time, system.chain, system.stationary, local)


def homogeneous_propagator(system: JumpSystem) -> Propagator:
    """Of the stack (n, p) of packed C_i without noise: exp(-M t), or A^k."""
    return Propagator(system.time, system.chain, system.stationary, -mode_operators(system))


def mean_propagator(system: JumpSystem) -> Propagator:
    """Of the stack nu (n, d) of means: exp(-N t), or H^k."""
    discrete = system.time == "discrete"
    local = system.matrices - np.eye(system.dimension) if discrete else -system.matrices
    return Propagator(system.time, system.chain, system.stationary, local)
