"""Runs in real time with late agents, from the benchmarks."""

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "late_timers.py"


@pytest.fixture(scope="session")
def late_timers():
    spec = importlib.util.spec_from_file_location("late_timers", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["late_timers"] = module
    spec.loader.exec_module(module)
    return module
