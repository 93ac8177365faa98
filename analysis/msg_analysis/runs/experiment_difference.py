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

"""What differs between two experiments: keys, predictions, decay, leaders. Differences are relative to the first."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from msg_analysis.errors import InputError
from msg_analysis.inference.verdict.law_identity import flat
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.runs.pairs import differing, relative
from msg_analysis.theory.decay_rates import asymptotic_rates
from msg_analysis.theory.leaders.search import SearchProgress, ignore
from msg_analysis.theory.leaders.selection import AUTO_SETS, select_leaders
from msg_analysis.theory.prediction import Moments, Prediction, predict

MOST_AGENTS = 100  # with which leaders are searched: each set takes up to half a second
_RATES = ("mean", "second_moment", "graph")


def experiment_difference(a: ValidExperiment, b: ValidExperiment, watch: SearchProgress = ignore) -> dict[str, Any]:
    """The document of ``msg-analysis diff`` of two experiments; keys in docs/commands.md.

    An experiment without a prediction has the reason instead. ``watch``: of the search of leaders.
    """
    pair = (a, b)
    found = [_prediction(experiment) for experiment in pair]
    laws = [_laws(prediction) if isinstance(prediction, Prediction) else {} for prediction in found]
    rates = [_rates(prediction) if isinstance(prediction, Prediction) else {} for prediction in found]
    return {
        "kind": "experiments",
        "a": _side(a, found[0]),
        "b": _side(b, found[1]),
        "keys": differing(*(flat(experiment.to_document()) for experiment in pair)),
        "predictions": {law: _errors(*(side.get(law) for side in laws)) for law in {**laws[0], **laws[1]}},
        "rates": {key: relative(*(side.get(key) for side in rates)) for key in _RATES},
        "leaders": dict(zip("ab", _leaders(a, b, found, watch), strict=True)),
    }


def _side(experiment: ValidExperiment, prediction: Prediction | str) -> dict[str, Any]:
    return {
        "file": experiment.source,
        "name": experiment.name,
        "problem": experiment.problem,
        "time": experiment.time,
        "agents": experiment.agents,
        "names": experiment.names,
        "unpredicted": prediction if isinstance(prediction, str) else None,
    }


def _prediction(experiment: ValidExperiment) -> Prediction | str:
    """The prediction, or why there is none."""
    try:
        experiment.require_available("predict")
        return predict(experiment)
    except InputError as error:
        return str(error)


def _laws(prediction: Prediction) -> dict[str, Moments]:
    """By their names in ``msg-analysis predict --json``."""
    steps = "discrete" if prediction.experiment.time == "discrete" else "emulated"
    laws = {
        "continuous": prediction.continuous_moments,
        steps: prediction.emulated,
        "static": prediction.static_moments,
    }
    return {name: moments for name, moments in laws.items() if moments is not None}


def _errors(a: Moments | None, b: Moments | None) -> dict[str, Any]:
    nodes_a, nodes_b = (moments.node_errors.tolist() if moments else [] for moments in (a, b))
    return {
        "system_error": relative(*(moments.system_error if moments else None for moments in (a, b))),
        # Agents of networks of different sizes have nothing in common but their numbers.
        "node_errors": [relative(*pair) for pair in zip(nodes_a, nodes_b, strict=True)]
        if len(nodes_a) == len(nodes_b)
        else [],
    }


def _rates(prediction: Prediction) -> dict[str, float | None]:
    """Final decay rates of the steps of the run, per unit of time; None: not found, infinite, or no such thing."""
    unit = prediction.experiment.step_length
    rates = dataclasses.asdict(asymptotic_rates(prediction.system))
    return {key: rate / unit if rate is not None and math.isfinite(rate) else None for key, rate in rates.items()}


def _leaders(
    a: ValidExperiment, b: ValidExperiment, found: list[Prediction | str], watch: SearchProgress
) -> list[dict[str, Any]]:
    """Leaders of each, and the best set of as many; one without leaders gets as many, and the gain, of the other."""
    sides = []
    for experiment, other, prediction in ((a, b, found[0]), (b, a, found[1])):
        own = experiment.spec.leaders
        pattern = own or other.spec.leaders
        count, gain = (len(pattern.agents), pattern.gain) if pattern else (1, math.inf)
        side: dict[str, Any] = {
            "agents": list(own.agents) if own else None,
            "gain": _gain(own.gain) if own else None,
            "system_error": None,
            "best": None,
            "note": None,
        }
        sides.append(side)
        if isinstance(prediction, str):
            side["note"] = "no prediction"
        elif experiment.agents > MOST_AGENTS or math.comb(experiment.agents, count) > AUTO_SETS:
            side["note"] = f"not searched: use msg-analysis leaders {experiment.source}"
        else:
            try:
                selection = select_leaders(experiment, count, gain=gain, method="exhaustive", top=1, watch=watch)
            except InputError as error:
                side["note"] = str(error)
                continue
            document = selection.to_json()
            best = document["sets"][0]
            side["best"] = {
                "agents": best["agents"],
                "system_error": best["system_error"],
                "gain": document["gain"],
                "law": document["law"],
            }
            side["system_error"] = document["present"]["system_error"] if document["present"] else None
    return sides


def _gain(gain: float) -> float | str:
    return "inf" if math.isinf(gain) else gain
