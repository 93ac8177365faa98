"""A package with a protocol, which only the processes of one test have."""

from pathlib import Path

import pytest

# The built-in law, in at most 500 steps a second in the process of an agent: a test can do something in the middle of
# a run of a few thousand steps, on any machine.
SLOW = """
import sys
import time
from msg_analysis.protocol import Protocol

class Law(Protocol):
    def step(self, k, mode, state, heard, noise):
        if sys.argv[1:2] == ["agent"]:
            time.sleep(0.002)
        return state + self.network.dt * heard.weighted_sum(heard.values - state[0]) + noise
"""


def install(name: str, code: str, folder: Path, patch: pytest.MonkeyPatch) -> dict[str, str]:
    """Offer the class ``Law`` of this code, here and to what is started; the section ``protocol`` of experiments."""
    package = folder / "packages"
    info = package / f"{name}_package-0.3.dist-info"
    info.mkdir(parents=True)
    (package / f"{name}_module.py").write_text(code)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}_package\nVersion: 0.3\n")
    (info / "entry_points.txt").write_text(f"[msg_agents.protocols]\n{name} = {name}_module:Law\n")
    patch.setenv("PYTHONPATH", str(package))
    return {"name": name}
