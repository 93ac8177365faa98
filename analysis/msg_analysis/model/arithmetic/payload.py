"""States as they travel: bytes of little-endian doubles, one per replica, and the update law on them.

The compiled kernel, where it was built, and numpy give the same bits; the first costs an agent a tenth of the second.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from msg_analysis.model.arithmetic.update_law import step
from msg_analysis.types import FloatArray

_DOUBLE = np.dtype("<f8")


def to_payload(state: FloatArray) -> bytes:
    """Bytes of (replicas,) numbers.

    Parameters
    ----------
    state
        (replicas,) float64
    """
    return state.astype(_DOUBLE, copy=False).tobytes()


def from_payload(payload: bytes) -> FloatArray:
    """(replicas,) numbers, read-only.

    Parameters
    ----------
    payload
        8 bytes for each number, little-endian
    """
    return np.frombuffer(payload, _DOUBLE)


def combine_with_numpy(weights: Sequence[float], payloads: Sequence[bytes], drive: bytes) -> bytes:
    """The update law (``law.step``) on payloads: sum_j weights[j] payloads[j], term after term, plus the drive.

    Parameters
    ----------
    weights
        a tuple of numbers, at least one
    payloads
        a list, one for each weight, all of the size of the drive
    drive
        payload of noise and offset
    """
    return to_payload(step(weights, [from_payload(payload) for payload in payloads], from_payload(drive)))


def all_finite_with_numpy(payload: bytes) -> bool:
    """Whether no entry is infinite or undefined.

    Parameters
    ----------
    payload
        8 bytes for each number, little-endian
    """
    return bool(np.isfinite(from_payload(payload)).all())


combine: Callable[[Sequence[float], Sequence[bytes], bytes], bytes]
"""The update law on payloads: the kernel's, or ``combine_with_numpy``."""

all_finite: Callable[[bytes], bool]
"""Whether no entry is infinite or undefined: the kernel's, or ``all_finite_with_numpy``."""

try:
    from msg_analysis.model.arithmetic import _kernel
except ImportError:  # there was no compiler when this was installed
    COMPILED, combine, all_finite = False, combine_with_numpy, all_finite_with_numpy
else:
    COMPILED, combine, all_finite = True, _kernel.combine, _kernel.all_finite
