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

"""The arguments of the launch files, and their checks: before anything is started or made."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from msg_agents.replay.bag_clock import parse_rate
from msg_agents.running.experiment_overrides import load_with_overrides
from msg_analysis.bags.format.storage_options import MEGABYTE, SMALLEST_SPLIT, Storage
from msg_analysis.errors import InputError
from msg_analysis.examples.bundled import find
from msg_analysis.model.experiment.experiment import ValidExperiment

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
OF_LAUNCH = {"sigterm_timeout", "sigkill_timeout", "emulate_tty", "launch-prefix", "launch-prefix-filter"}
"""Arguments that launch itself reads, for any launch file."""


def check_names(context: Any, known: Collection[str]) -> None:
    """InputError: ``ros2 launch`` was given an argument that its launch file does not have; launch ignores these.

    ``context`` is launch's. A launch file that another one includes may be given the arguments of that one, too.
    """
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


def number(arguments: Mapping[str, str], name: str, *, least: float = 0.0) -> float | None:
    """A launch argument that must be a number above ``least``, or empty (None)."""
    if not (text := arguments[name].strip()):
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least < value < math.inf:
        raise InputError(f"{name}:={text}: expected a number above {least:g}")
    return value


def load_experiment(arguments: Mapping[str, str]) -> ValidExperiment:
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
    experiment.require_available()
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
