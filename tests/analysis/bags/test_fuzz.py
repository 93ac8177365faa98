"""A share of `make fuzz`: damaged bags and experiment files give clean errors, in bounded memory and time."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[3] / "benchmarks/fuzz.py"


def test_a_share_of_the_fuzzing(tmp_path: Path) -> None:
    """Other seeds than those of `make fuzz`, which begins at 0."""
    numbers = ["--bags", "30", "--experiments", "100", "--seed", "1000000", "--jobs", "1", "--no-bombs"]
    command = [sys.executable, str(SCRIPT), *numbers, "--findings", str(tmp_path)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False, env=environment)
    assert result.returncode == 0, result.stderr + result.stdout
    bags, experiments = result.stdout.splitlines()
    assert re.search(r"^bags: 30 damaged: \d+ complete, \d+ incomplete, \d+ refused, 0 findings", bags)
    assert re.search(r"^experiments: 100 damaged: \d+ refused, \d+ valid, 0 findings", experiments)
    assert list(tmp_path.iterdir()) == []
