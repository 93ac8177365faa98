"""One prediction of many runs."""

import json

import pytest

from msg_analysis.inference import verdict
from msg_analysis.theory.prediction import predict


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

    monkeypatch.setattr(verdict, "predict_run", prediction)
