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

"""One random network: made, run with its faults, compared."""

from __future__ import annotations

import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

from msg_agents.doctor.networks.fault_injection import FaultInjection
from msg_agents.doctor.networks.fault_plan import plan_faults
from msg_agents.doctor.networks.outcome import Outcome, judge
from msg_agents.doctor.networks.random_networks import random_document
from msg_agents.running.run_folder import make_bag_directory, workshop
from msg_agents.running.runner import run_network
from msg_agents.terminal.interruption import raise_for
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import ValidExperiment

EXPERIMENT_FILE, OUTCOME_FILE = "experiment.json", "outcome.json"


def run_trial(seed: int, out: Path) -> Outcome:
    """Run the network of a seed as ``msg-agents run`` does; KeyboardInterrupt or SystemExit if a signal has ended it.

    Unless it went well, its bag with the logs, its experiment and the outcome are kept in a new folder in ``out``.
    """
    began = time.monotonic()
    with workshop() as folder:
        file = folder / EXPERIMENT_FILE
        file.write_text(json.dumps(random_document(seed), indent=1), encoding="utf-8")
        experiment = ValidExperiment.load(file)
        plan = plan_faults(seed, experiment.agents, experiment.steps)
        injection = FaultInjection(plan)
        result = run_network(experiment, folder, restarts=plan.restarts, view=injection)
        if injection.standstill is None:
            raise_for(result.interrupted_by)
        outcome = Outcome(
            seed=seed,
            agents=experiment.agents,
            processes=injection.process_count,
            graphs=len(experiment.graph_list),
            steps=experiment.steps,
            faults=injection.delivered,
            restarts=result.restarts,
            stalls=[line for line in injection.notes if line not in result.restarts],
            verdict=judge(result, replace(plan, faults=tuple(injection.delivered)), injection.standstill),
            wall_time=time.monotonic() - began,
        )
        if outcome.good:
            return outcome
        kept = make_bag_directory(experiment, out.absolute())
        if result.bag is not None and result.bag.is_dir():
            shutil.copytree(result.bag, kept, dirs_exist_ok=True)
        shutil.copy(file, kept)
        outcome = replace(outcome, folder=kept)
        (kept / OUTCOME_FILE).write_text(json.dumps(outcome.to_json(), indent=1), encoding="utf-8")
        return outcome


def require_directory(out: Path) -> None:
    """Refuse, before any run, a directory in which nothing could be kept. Raises InputError."""
    place = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        what = "cannot be written" if place.is_dir() else f"{place} is a file"
        raise InputError(f"--out: {out}: {what}: give a directory for networks that fail")
