"""A fault of a run that its record does not know: to be called first in the process that all are forked from."""

from __future__ import annotations

from typing import Any


def noisy() -> None:
    """Agent 3 has 1.3 times its noise."""
    from msg_analysis.model.step.process_noise import ProcessNoise

    usual = ProcessNoise.block

    def block(noise: ProcessNoise, agent: int, *others: Any) -> Any:
        return [each * (1.3 if agent == 2 else 1.0) for each in usual(noise, agent, *others)]

    ProcessNoise.block = block  # type: ignore[method-assign]
