"""Runs in real time with late agents, from the benchmarks; one prediction of many runs."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from msg_analysis.inference import verdict
from msg_analysis.theory.prediction import predict

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "late_timers.py"


@pytest.fixture(scope="session")
def late_timers():
    spec = importlib.util.spec_from_file_location("late_timers", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["late_timers"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def predicted_once(monkeypatch):
    """Comparisons compute one prediction for all runs in lockstep that differ in nothing but their seeds."""
    known = {}

    def prediction(experiment, step=None):
        document = experiment.to_document()
        assert experiment.run.pace == "lockstep"
        del document["run"]["seed"]
        key = json.dumps(document)
        if key not in known:
            known[key] = predict(experiment, step)
            assert known[key].fourth_moment  # computed once, as what the copies keep
        return known[key].for_run(experiment)

    monkeypatch.setattr(verdict, "predict", prediction)
