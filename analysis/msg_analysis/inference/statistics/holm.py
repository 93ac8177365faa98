"""Many tests, one level: Holm's step-down adjustment."""

from __future__ import annotations

import numpy as np

from msg_analysis.types import FloatArray


def holm(p_values: FloatArray) -> FloatArray:
    """Adjusted p-values: rejecting those below a level keeps the chance of any false rejection below it.

    Holds whatever the dependence between the tests (Holm 1979).

    Parameters
    ----------
    p_values
        (q,)

    Returns
    -------
    FloatArray
        (q,) in the order given
    """
    order = np.argsort(p_values)
    stepped = p_values[order] * np.arange(len(p_values), 0, -1)
    adjusted = np.empty_like(p_values)
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return adjusted
