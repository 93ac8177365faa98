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

"""States as messages carry them: bytes of little-endian doubles, and the update law on such bytes.

The compiled kernel and numpy give the same bits. The kernel is used where it was built, because it is faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from msg_analysis.model.arithmetic.update_law import step
from msg_analysis.types import FloatArray

_DOUBLE = np.dtype("<f8")


def to_payload(state: FloatArray) -> bytes:
    """Bytes of a state (replicas,) of float64."""
    return state.astype(_DOUBLE, copy=False).tobytes()


def from_payload(payload: bytes) -> FloatArray:
    """State (replicas,) of a payload of 8 bytes for each number; read-only."""
    return np.frombuffer(payload, _DOUBLE)


def combine_with_numpy(weights: Sequence[float], payloads: Sequence[bytes], drive: bytes) -> bytes:
    """``law.step`` on payloads of equal size: sum_j weights[j] payloads[j], term after term, plus the drive.

    The kernel accepts only a tuple of weights (at least one) and a list of payloads.
    """
    return to_payload(step(weights, [from_payload(payload) for payload in payloads], from_payload(drive)))


def all_finite_with_numpy(payload: bytes) -> bool:
    """Whether all numbers of a payload are finite."""
    return bool(np.isfinite(from_payload(payload)).all())


combine: Callable[[Sequence[float], Sequence[bytes], bytes], bytes]
"""The update law on payloads: the kernel's, or ``combine_with_numpy``."""

all_finite: Callable[[bytes], bool]
"""Whether all numbers of a payload are finite: the kernel's, or ``all_finite_with_numpy``."""

try:
    from msg_analysis.model.arithmetic import _kernel
except ImportError:  # there was no compiler when this was installed
    COMPILED, combine, all_finite = False, combine_with_numpy, all_finite_with_numpy
else:
    COMPILED, combine, all_finite = True, _kernel.combine, _kernel.all_finite
