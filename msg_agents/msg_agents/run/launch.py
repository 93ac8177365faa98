# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Runs under ``ros2 launch``, without ``launch``: arguments, processes, what the end of each means, what follows.

``launch`` itself starts the processes and handles signals and output (``nodes/launch_actions.py``).
"""

from __future__ import annotations

import atexit
import difflib
import math
import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from msg_agents.process_layout import RECORDER, ProcessSpec, lay_out_network
from msg_agents.replay import parse_rate
from msg_agents.run.folder import load_with_overrides, make_bag_directory, temporary_directory
from msg_agents.run.supervisor import failure_of
from msg_analysis.bags.stored_file import MEGABYTE, SMALLEST_SPLIT, Storage
from msg_analysis.cli.console import print_notes
from msg_analysis.common.files import REPORT_FILE
from msg_analysis.common.resources import SINGLE_THREAD
from msg_analysis.errors import ExitCode, InputError
from msg_analysis.experiment.examples import find
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.simulate import new_record

TRUE, FALSE = {"true", "1", "yes", "on"}, {"false", "0", "no", "off"}
SHUTDOWN = ("false", "Whether the end of these processes ends the whole launch, with all that else it has started.")
NETWORK_ARGUMENTS = {
    "experiment": ("line_ring", "Experiment file, or the name of an example."),
    "out": ("runs", "Directory in which the bag's directory <name>_<time> is created."),
    "record": ("true", "Whether to record; otherwise there is no bag and no verdict."),
    "analyse": (
        "true",
        "Whether to compare the bag with the prediction afterwards: the launch fails if they disagree.",
    ),
    "compression": ("zstd", "Compression of the chunks of the bag: none, zstd or lz4."),
    "split_size": ("", "MB (10^6 bytes) after which the bag continues in a new file, from 0.1; empty: one file."),
    "seed": ("", "Overrides run.seed."),
    "duration": ("", "Overrides run.duration, in units of simulated time."),
    "pace": ("", "Overrides run.pace: lockstep or realtime."),
    "speed": ("", "Overrides run.speed: units of simulated time per second (realtime)."),
    "processes": ("", "Overrides run.processes: auto, one_per_agent or a number."),
    "namespace": ("", "Namespace of all nodes and topics, such as /lab."),
    "use_sim_time": ("false", "Whether to take the time from /clock (realtime)."),
    "parameter_services": ("false", "Whether to offer the parameters to `ros2 param`: six services per node."),
    "shutdown": SHUTDOWN,
}
"""Default and description of each argument of network.launch.py."""
REPLAY_ARGUMENTS = {
    "bag": ("", "The bag: a directory, or one of its files."),
    "rate": ("1", "Seconds of the bag per second, or max: as fast as the readers allow."),
    "live": ("true", "Whether to watch it: errors next to their prediction, also on the topic estimate."),
    "namespace": ("", "Namespace of the network in the bag, for live."),
    "clock": ("", "Rate [Hz] at which the time of the bag is published on /clock; empty: it is not published."),
    "loop": ("false", "Whether to start again at the end, without limit; not together with live."),
    "shutdown": SHUTDOWN,
}
"""The same for replay.launch.py."""
# Arguments that launch itself reads, for any launch file.
OF_LAUNCH = {"sigterm_timeout", "sigkill_timeout", "emulate_tty", "launch-prefix", "launch-prefix-filter"}
ANALYSIS = "msg-analysis"
VERDICTS: dict[int, str] = {  # of the exit codes of ``msg-analysis compare``
    ExitCode.DISAGREES: "the run disagrees with the prediction",
    ExitCode.INCOMPLETE: "data are incomplete: no verdict",
}


def check_names(context: Any, known: Collection[str]) -> None:
    """InputError: ``ros2 launch`` was given an argument that its launch file does not have; launch ignores these."""
    # A launch file that another one includes may be given the arguments of that one, too.
    values = context.get_locals_as_dict()
    description = getattr(values.get("event"), "launch_description", None)
    sources = [getattr(each, "launch_description_source", None) for each in getattr(description, "entities", ())]
    if [source and str(Path(source.location).absolute()) for source in sources] != [
        values.get("current_launch_file_path")
    ]:
        return
    for word in context.argv:
        name = word.partition(":=")[0]
        if name not in known and name not in OF_LAUNCH:
            close = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}"
            raise InputError(f"{word}: this launch file has no argument {name}: {hint}")


def flag(arguments: Mapping[str, str], name: str) -> bool:
    """A launch argument that must be true or false; InputError if it is neither."""
    word = arguments[name].strip().lower()
    if word not in TRUE | FALSE:
        raise InputError(f"{name}:={arguments[name]}: expected true or false")
    return word in TRUE


def number(arguments: Mapping[str, str], name: str) -> float | None:
    """A launch argument that must be a number above 0, or empty (None)."""
    if not (text := arguments[name].strip()):
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise InputError(f"{name}:={text}: expected a number above 0")
    return value


def load_experiment(arguments: Mapping[str, str]) -> Experiment:
    """The experiment with the changes of the launch arguments; InputError if it is wrong or cannot be run."""
    changes: dict[str, Any] = {}
    for name, kind in (("seed", int), ("duration", float), ("speed", float)):
        if text := arguments[name].strip():
            try:
                changes[name] = kind(text)
            except ValueError as error:
                what = "a whole number" if kind is int else "a number"
                raise InputError(f"{name}:={text}: expected {what}") from error
    changes |= {name: arguments[name].strip() or None for name in ("pace", "processes")}
    try:
        file = find(str(Path(arguments["experiment"]).expanduser()))
    except InputError as error:
        raise InputError(f"experiment:={error}") from error
    experiment = load_with_overrides(file, changes, name=lambda key: f"{key}:={arguments[key].strip()}")
    print_notes(experiment)
    experiment.require_available()
    if experiment.external:
        raise InputError("run.external: a launch file starts all agents: use `msg-agents run`, or remove it")
    if "speed" in changes and experiment.run.pace == "lockstep":
        raise InputError(f"speed:={arguments['speed']}: a run in lockstep has no speed: add pace:=realtime")
    return experiment


def bag_storage(arguments: Mapping[str, str]) -> Storage:
    """How the files of the bag are stored."""
    size = number(arguments, "split_size")
    if size is not None and size < SMALLEST_SPLIT:
        raise InputError(f"split_size:={arguments['split_size']}: expected at least {SMALLEST_SPLIT} (MB)")
    return Storage(arguments["compression"].strip(), None if size is None else round(size * MEGABYTE))  # type: ignore[arg-type]  # checked there


def player_options(arguments: Mapping[str, str]) -> list[str]:
    """Bag and options of the player; InputError if the arguments are wrong."""
    bag = arguments["bag"].strip()
    if not bag or not Path(bag).expanduser().exists():
        raise InputError(f"bag: {bag or 'not given'}: expected the directory of a bag, or one of its files: bag:=...")
    rate = arguments["rate"].strip()
    try:
        parse_rate(rate)
    except ValueError as error:
        raise InputError(f"rate:={rate}: expected a positive number, or max") from error
    options = [str(Path(bag).expanduser()), "--rate", rate]
    if flag(arguments, "loop"):
        if flag(arguments, "live"):
            raise InputError("loop:=true: a run that starts again cannot be watched: give live:=false")
        options.append("--loop")
    if (clock := number(arguments, "clock")) is not None:
        options += ["--clock", f"{clock:g}"]
    return options


class LaunchFailedError(Exception):
    """A process has failed: the launch is to end with a failure as exit code."""


class LaunchedProcesses:
    """Processes that ``launch`` starts together: when one fails, the others are stopped; then ``reason`` says why."""

    # The actions of ``launch`` pass on the end of each process, and ask ``to_stop`` and ``analysis`` then. Killed
    # processes are not started again here.
    def __init__(self, namespace: str) -> None:
        self.namespace = namespace.strip()
        self._stack = ExitStack()
        # The processes end when its lock is released: SIGTERM ends launch without a signal to them.
        self._folder = self._stack.enter_context(temporary_directory())
        atexit.register(self.close)
        self.processes: list[ProcessSpec] = []
        self.reason: str | None = None  # why these processes have failed
        self._interruption: str | None = None  # why launch has stopped them
        self._running: set[str] = set()
        self._stopped: set[str] = set()

    def _set(self, processes: Sequence[ProcessSpec]) -> None:
        lock = ("--lifeline-lock", str(self._folder))
        self.processes = [replace(spec, arguments=spec.arguments + lock) for spec in processes]
        self._running = {spec.name for spec in processes}

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
    """A run whose processes ``launch`` starts; InputError: the arguments are wrong, and no bag has been made."""

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
            lay_out_network(experiment, self._run_file, None)  # rejects too many processes before anything is made
            if record:
                out = Path(arguments["out"]).expanduser().absolute()
                self.bag = make_bag_directory(experiment, out, option="out:=")
            # Of each, ``arguments[0]`` is the executable.
            options: dict[str, Any] = {"use_sim_time": use_sim_time, "parameter_services": services}
            self._set(lay_out_network(experiment, self._run_file, self.bag, storage=storage, **options))
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
        """See LaunchedProcesses; the run record is stored with the bag."""
        if self.bag is not None:
            if self._recorded and self._run_file.exists():
                with suppress(OSError):
                    (self.bag / "log").mkdir(exist_ok=True)
                    (self.bag / "log" / "run.json").write_bytes(self._run_file.read_bytes())
            with suppress(OSError):
                self.bag.rmdir()  # if it is empty
        super().close()


class LaunchedReplay(LaunchedProcesses):
    """A player and, if requested, ``live``, which ``launch`` starts; InputError: the arguments are wrong."""

    def __init__(self, arguments: Mapping[str, str]) -> None:
        player = ("player", *player_options(arguments))
        live = flag(arguments, "live")
        super().__init__(arguments["namespace"])
        if live:
            player = (*player, "--await", "live")
        watcher = [ProcessSpec("live", ("live", "--reliable"))] if live else []
        self._set([*watcher, ProcessSpec("player", player)])


def environment() -> dict[str, str]:
    """Additions to the launch's environment."""
    return {name: os.environ.get(name) or number for name, number in SINGLE_THREAD.items()}
