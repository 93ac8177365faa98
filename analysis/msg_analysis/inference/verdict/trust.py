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

"""Which errors of a run have intervals that can be trusted: those over all paths of the graphs, or given the path."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from msg_analysis.common.text.number_words import number_text
from msg_analysis.inference.errors.time_means import TimeMeans
from msg_analysis.theory.prediction import Prediction
from msg_analysis.theory.tails.fourth_moments import FourthMoment

Reason = Literal["heavy_tails", "kept_values", "short_run", "few_sojourns"]


@dataclass(frozen=True, slots=True)
class Trust:
    """Which errors to trust, and why not the others; ``errors`` is None where no errors have valid intervals."""

    errors: Literal["all_paths", "given_path"] | None
    reason: Reason | None = None
    words: str | None = None

    def to_json(self) -> dict[str, Any]:
        """The document."""
        return asdict(self)


def trusted(prediction: Prediction, means: TimeMeans, *, given: bool) -> Trust:
    """Which errors of a run in lockstep to trust.

    Parameters
    ----------
    prediction
        of the experiment
    means
        over all paths, of one run or of several
    given
        whether there are errors given the path of the graphs
    """
    reason = _reason(prediction, means)
    if reason is None:
        return Trust("all_paths")
    instead = "Trust the tests of innovations and switching, which do not depend on this."
    if given:
        instead = "Trust the errors given the path, and the tests, which do not depend on this."
    return Trust("given_path" if given else None, reason, f"{_why(reason, prediction, means)} {instead}")


def _reason(prediction: Prediction, means: TimeMeans) -> Reason | None:
    if means.heavy:
        return "heavy_tails"
    if prediction.system.readout is not None:
        return "kept_values"
    if not means.long_enough:
        return "short_run"
    return "few_sojourns" if means.few_sojourns else None


def _why(reason: Reason, prediction: Prediction, means: TimeMeans) -> str:
    if reason == "heavy_tails":
        return (
            f"The fourth moments of the states {_infinite(prediction.fourth_moment)}: rare large values make a large "
            "part of the mean error, so most runs measure less than the prediction, and the errors over all paths of "
            "the graphs have no standard error and no interval."
        )
    if reason == "kept_values":
        return (
            "Agents keep values from step to step, so the standard errors over all paths of the graphs depend on more "
            "than the log and are not known."
        )
    if reason == "short_run":
        return "The run is too short for intervals of the errors over all paths of the graphs."
    return (
        f"This run sees few sojourns of the graphs (some graph is left {number_text(means.switches, 3)} times on "
        "average), so the errors over all paths of the graphs depend on a few random lengths: they are far from "
        "normal, and their intervals are too wide."
    )


def _infinite(fourth: FourthMoment) -> str:
    if fourth.finite is None:
        return "may be infinite (their growth is not known exactly)"
    radius = fourth.radius if fourth.radius is not None else fourth.lower
    least = "" if fourth.radius is not None else "at least "
    return f"are infinite (they grow {least}{number_text(radius, 3)} times per step)"
