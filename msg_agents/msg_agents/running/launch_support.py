"""What the launch files do, without ``launch``: which processes, what the end of each one means, what follows the run.

The plan is that of ``msg-agents run`` (``process_plan``). ``launch`` itself starts the processes and handles signals
and output. Killed processes are not started again here.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from msg_agents.processes.process_plan import ProcessPlan, plan_network
from msg_agents.running.experiment_overrides import load_with_overrides
from msg_agents.running.run_folder import make_bag_directory, workshop
from msg_agents.running.runner import REPORT_FILE
from msg_agents.running.supervisor import failure_of
from msg_analysis.common.blas_threads import SINGLE_THREAD
from msg_analysis.common.exit_codes import ExitCode
from msg_analysis.errors import InputError
from msg_analysis.model.experiment.experiment import ValidExperiment
from msg_analysis.twin.simulate import new_record

TRUE, FALSE = {"true", "1", "yes", "on"}, {"false", "0", "no", "off"}
NETWORK_ARGUMENTS = {
    "experiment": ("line_ring", "Experiment file, or the name of one of msg_agents_bringup."),
    "out": ("runs", "Directory in which the bag's directory <name>_<time> is created."),
    "record": ("true", "Whether to record; otherwise there is no bag and no verdict."),
    "analyse": (
        "true",
        "Whether to compare the bag with the prediction afterwards: the launch fails if they disagree.",
    ),
    "seed": ("", "Overrides run.seed."),
    "duration": ("", "Overrides run.duration, in units of simulated time."),
    "pace": ("", "Overrides run.pace: lockstep or realtime."),
    "speed": ("", "Overrides run.speed: units of simulated time per second (realtime)."),
    "processes": ("", "Overrides run.processes: auto, one_per_agent or a number."),
    "namespace": ("", "Namespace of all nodes and topics, such as /lab."),
    "use_sim_time": ("false", "Whether to take the time from /clock (realtime)."),
}
"""Default and description of each argument of network.launch.py."""
REPLAY_ARGUMENTS = {
    "bag": ("", "The bag: a directory, or one of its files."),
    "rate": ("1", "Seconds of the bag per second, or max: as fast as the readers allow."),
    "live": ("true", "Whether to watch it: errors next to their prediction, also on the topic estimate."),
    "namespace": ("", "Namespace of the network in the bag, for live."),
    "clock": ("", "Rate [Hz] at which the time of the bag is published on /clock; empty: it is not published."),
    "loop": ("false", "Whether to start again at the end, without limit; not together with live."),
}
"""The same for replay.launch.py."""


class LaunchFailedError(Exception):
    """A process has failed: the launch is to end with a failure as exit code."""


def flag(arguments: Mapping[str, str], name: str) -> bool:
    """A launch argument that must be true or false; InputError if it is neither."""
    word = arguments[name].strip().lower()
    if word not in TRUE | FALSE:
        raise InputError(f"{name}: {arguments[name]}: expected true or false")
    return word in TRUE


def find_experiment(name: str, share: Path) -> Path:
    """The experiment file: the path ``name``, or else the example of this name in ``share``.

    ``share`` is the data directory of msg_agents_bringup. A path with a suffix is not checked here; else
    InputError if there is neither file nor example.
    """
    path = Path(name).expanduser()
    examples = share / "experiments"
    if path.is_file() or path.suffix:
        return path
    if (example := examples / f"{name}.yaml").is_file():
        return example
    known = ", ".join(sorted(file.stem for file in examples.glob("*.yaml")))
    raise InputError(f"experiment: {name}: expected a file, or one of {known}")


def load_experiment(arguments: Mapping[str, str], share: Path) -> ValidExperiment:
    """The experiment with the changes of the launch arguments; InputError if it is wrong or cannot be run."""
    changes: dict[str, Any] = {}
    for name, kind in (("seed", int), ("duration", float), ("speed", float)):
        if text := arguments[name].strip():
            try:
                changes[name] = kind(text)
            except ValueError as error:
                what = "a whole number" if kind is int else "a number"
                raise InputError(f"{name}: {text}: expected {what}") from error
    changes |= {name: arguments[name].strip() or None for name in ("pace", "processes")}
    experiment = load_with_overrides(find_experiment(arguments["experiment"], share), changes)
    experiment.require_available()
    return experiment


class LaunchedNetwork:
    """A run whose processes ``launch`` starts.

    Takes the arguments of the launch by the names of NETWORK_ARGUMENTS, and the data directory of msg_agents_bringup.
    InputError: the arguments or the experiment are wrong; no bag has been made.
    """

    def __init__(self, arguments: Mapping[str, str], share: Path) -> None:
        experiment = load_experiment(arguments, share)
        record = flag(arguments, "record")
        self._analyse = flag(arguments, "analyse") and record
        use_sim_time = flag(arguments, "use_sim_time")
        self.namespace = arguments["namespace"]
        self._stack = ExitStack()
        folder = self._stack.enter_context(workshop())
        self._run_file = folder / "run.json"
        self._run_file.write_text(new_record(experiment).to_json(with_key=True), encoding="utf-8")
        self.bag: Path | None = None  # directory that the recorder makes
        try:
            plan_network(experiment, self._run_file, None)  # rejects too many processes before anything is made
            if record:
                out = Path(arguments["out"]).expanduser().absolute()
                out.mkdir(parents=True, exist_ok=True)
                self.bag = make_bag_directory(experiment, out)
            # Of each, ``arguments[0]`` is the executable.
            self.processes: list[ProcessPlan] = plan_network(
                experiment, self._run_file, self.bag, use_sim_time=use_sim_time
            )
        except BaseException:
            self.close()
            raise
        self._running = {plan.name for plan in self.processes}
        self._over = False

    def ended(self, name: str, code: int) -> bool:
        """Take note of the end of a process; True if it was the last one and the run is complete.

        ``code`` is its exit code, or minus the signal that killed it. The first failure raises LaunchFailedError; later
        ones do not, since they follow from it.
        """
        self._running.discard(name)
        failure = failure_of(code)
        if failure and not self._over:
            self._over = True
            raise LaunchFailedError(f"{name}: {failure}: the run is not complete" + self._what_is_left())
        return not self._running and not self._over

    def _what_is_left(self) -> str:
        return "" if self.bag is None else f"; its data so far are in {self.bag}"

    @property
    def analysis(self) -> list[str] | None:
        """Arguments of ``msg-analysis`` after a complete run; None: no analysis."""
        if not self._analyse or self.bag is None:
            return None
        return ["compare", str(self.bag), "--report", str(self.bag / REPORT_FILE)]

    def analysed(self, code: int) -> None:
        """Take note of the exit code of ``msg-analysis compare``; LaunchFailedError unless the run agrees."""
        if code:
            verdict: dict[int, str] = {
                ExitCode.DISAGREES: "the run disagrees with the prediction",
                ExitCode.INCOMPLETE: "data are incomplete: no verdict",
            }
            raise LaunchFailedError(f"msg-analysis: {verdict.get(code, f'exit code {code}')}")

    def close(self) -> None:
        """Keep the run record with the bag, and remove temporary files. May be called again."""
        if self.bag is not None:
            if (self.bag / f"{self.bag.name}_0.mcap").exists() and self._run_file.exists():
                with suppress(OSError):
                    (self.bag / "log").mkdir(exist_ok=True)
                    (self.bag / "log" / "run.json").write_bytes(self._run_file.read_bytes())
            with suppress(OSError):
                self.bag.rmdir()  # if it is empty
        self._stack.close()


def environment() -> dict[str, str]:
    """Additions to the launch's environment."""
    return {name: os.environ.get(name, number) for name, number in SINGLE_THREAD.items()}


def replay_commands(arguments: Mapping[str, str]) -> list[tuple[str, list[str]]]:
    """Executable and arguments of each node of a replay; InputError if the arguments are wrong."""
    bag, live = arguments["bag"].strip(), flag(arguments, "live")
    if not bag or not Path(bag).expanduser().exists():
        raise InputError(f"bag: {bag or 'not given'}: expected the directory of a bag, or one of its files: bag:=...")
    player = [str(Path(bag).expanduser()), "--rate", arguments["rate"].strip()]
    if flag(arguments, "loop"):
        if live:
            raise InputError("loop: true: a run that starts again cannot be watched: give live:=false")
        player.append("--loop")
    if clock := arguments["clock"].strip():
        player += ["--clock", clock]
    if not live:
        return [("player", player)]
    return [("live", ["--reliable"]), ("player", [*player, "--await", "live"])]
