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

"""What the launch files do, without ``launch``: which processes, what the end of each one means, what follows the run.

The plan is that of ``msg-agents run`` (``process_plan``). ``launch`` itself starts the processes and handles signals
and output (``nodes/launch_actions.py``). Killed processes are not started again here.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

from msg_agents.processes.process_plan import RECORDER, ProcessPlan, plan_network
from msg_agents.running.launch_arguments import bag_storage, flag, load_experiment, player_options
from msg_agents.running.run_folder import make_bag_directory, workshop
from msg_agents.running.supervisor import failure_of
from msg_analysis.common.blas_threads import SINGLE_THREAD
from msg_analysis.common.exit_codes import ExitCode
from msg_analysis.common.files import REPORT_FILE
from msg_analysis.twin.simulate import new_record

ANALYSIS = "msg-analysis"
VERDICTS: dict[int, str] = {
    ExitCode.DISAGREES: "the run disagrees with the prediction",
    ExitCode.INCOMPLETE: "data are incomplete: no verdict",
}
"""Exit codes of ``msg-analysis compare``."""


class LaunchFailedError(Exception):
    """A process has failed: the launch is to end with a failure as exit code."""


class LaunchedProcesses:
    """Processes that ``launch`` starts together: when one fails, the others are stopped; then ``reason`` says why.

    ``launch`` is told to pass on the end of each process, and to ask ``to_stop`` and ``analysis`` then.
    """

    def __init__(self, namespace: str) -> None:
        self.namespace = namespace.strip()
        self._stack = ExitStack()
        # Its lock is the lifeline of the processes: SIGTERM ends launch without a word to them.
        self._folder = self._stack.enter_context(workshop())
        atexit.register(self.close)
        self.processes: list[ProcessPlan] = []
        self.reason: str | None = None  # why these processes have failed
        self._interruption: str | None = None  # why launch has stopped them
        self._running: set[str] = set()
        self._stopped: set[str] = set()

    def _plan(self, processes: Sequence[ProcessPlan]) -> None:
        lifeline = ("--lifeline-lock", str(self._folder))
        self.processes = [replace(plan, arguments=plan.arguments + lifeline) for plan in processes]
        self._running = {plan.name for plan in processes}

    @property
    def over(self) -> bool:
        """Whether no process runs any more."""
        return not self._running

    def ended(self, name: str, code: int) -> None:
        """Take note of the end of a process: its exit code, or minus the signal that killed it."""
        self._running.discard(name)
        failure = failure_of(code)
        if failure and self.reason is None:  # later failures follow from the first one
            self.reason = (self._interruption or f"{name}: {failure}") + self._consequence()

    def interrupted(self, why: str) -> None:
        """Take note that ``launch`` ends while processes run."""
        if self.reason is None and self._interruption is None:
            self._interruption = why

    def to_stop(self) -> list[str]:
        """Names of the processes to stop now, after a failure: the recorder last, so that it gets all that was sent."""
        if self.reason is None:
            return []
        last = self._running & {RECORDER}
        names = (self._running - last or last) - self._stopped
        self._stopped |= names
        return sorted(names)

    def analysis(self) -> list[str] | None:
        """Arguments of ``msg-analysis``, once, if it is to be started now; it is then one of the processes."""
        return None

    def _consequence(self) -> str:
        return ""

    def close(self) -> None:
        """Remove temporary files, when all processes have ended or ``launch`` itself does. May be called again."""
        self._stack.close()
        atexit.unregister(self.close)


class LaunchedNetwork(LaunchedProcesses):
    """A run whose processes ``launch`` starts.

    Takes the arguments of the launch by the names of NETWORK_ARGUMENTS. InputError: the arguments or the experiment are
    wrong; no bag has been made.
    """

    def __init__(self, arguments: Mapping[str, str]) -> None:
        experiment = load_experiment(arguments)
        storage = bag_storage(arguments)
        record = flag(arguments, "record")
        self._analyse = flag(arguments, "analyse") and record
        use_sim_time, services = flag(arguments, "use_sim_time"), flag(arguments, "parameter_services")
        self.bag: Path | None = None  # directory that the recorder makes
        super().__init__(arguments["namespace"])
        self._run_file = self._folder / "run.json"
        self._run_file.write_text(new_record(experiment).to_json(with_key=True), encoding="utf-8")
        try:
            plan_network(experiment, self._run_file, None)  # rejects too many processes before anything is made
            if record:
                out = Path(arguments["out"]).expanduser().absolute()
                self.bag = make_bag_directory(experiment, out, option="out:=")
            # Of each, ``arguments[0]`` is the executable.
            plans = plan_network(
                experiment,
                self._run_file,
                self.bag,
                use_sim_time=use_sim_time,
                parameter_services=services,
                storage=storage,
            )
            self._plan(plans)
        except BaseException:
            self.close()
            raise

    def ended(self, name: str, code: int) -> None:
        """See LaunchedProcesses; of ``msg-analysis``, the exit code is the verdict."""
        if name != ANALYSIS:
            super().ended(name, code)
            return
        self._running.discard(name)
        if self._interruption is not None:
            self.reason = f"{self._interruption} during the comparison: no verdict of {self.bag}"
        elif code:
            self.reason = f"{name}: {VERDICTS.get(code, f'exit code {code}')}"

    def analysis(self) -> list[str] | None:
        """See LaunchedProcesses: after a complete run."""
        if self._running or self.reason is not None or not self._analyse or self.bag is None:
            return None
        if self._interruption is not None:
            self.reason = f"{self._interruption} before the comparison: no verdict of {self.bag}"
            return None
        self._analyse = False
        self._running.add(ANALYSIS)
        return ["compare", str(self.bag), "--report", str(self.bag / REPORT_FILE)]

    @property
    def _recorded(self) -> bool:
        """Whether there is anything in the bag."""
        return self.bag is not None and (self.bag / f"{self.bag.name}_0.mcap").exists()

    def _consequence(self) -> str:
        return ": the run is not complete" + (f"; its data so far are in {self.bag}" if self._recorded else "")

    def close(self) -> None:
        """See LaunchedProcesses; the run record is kept with the bag."""
        if self.bag is not None:
            if self._recorded and self._run_file.exists():
                with suppress(OSError):
                    (self.bag / "log").mkdir(exist_ok=True)
                    (self.bag / "log" / "run.json").write_bytes(self._run_file.read_bytes())
            with suppress(OSError):
                self.bag.rmdir()  # if it is empty
        super().close()


class LaunchedReplay(LaunchedProcesses):
    """A player and, if requested, ``live``, which ``launch`` starts; the arguments are those of REPLAY_ARGUMENTS.

    InputError: they are wrong.
    """

    def __init__(self, arguments: Mapping[str, str]) -> None:
        player = ("player", *player_options(arguments))
        live = flag(arguments, "live")
        super().__init__(arguments["namespace"])
        if live:
            plans = [ProcessPlan("live", ("live", "--reliable")), ProcessPlan("player", (*player, "--await", "live"))]
        else:
            plans = [ProcessPlan("player", player)]
        self._plan(plans)


def environment() -> dict[str, str]:
    """Additions to the launch's environment."""
    return {name: os.environ.get(name, number) for name, number in SINGLE_THREAD.items()}
