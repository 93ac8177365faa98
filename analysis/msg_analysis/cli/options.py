# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Options that several commands have."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from msg_analysis.cli.console import print_notes
from msg_analysis.errors import InputError

if TYPE_CHECKING:
    from msg_analysis import Experiment
    from msg_analysis.bags.stored_file import Compression

# As in the modules of bags and results, whose imports take longer than --help may take.
BAG_SUFFIXES = (".mcap", ".mcap.zstd", ".db3", ".db3.zstd")
COMPRESSIONS = ("none", "zstd", "lz4")
SMALLEST_SPLIT = 0.1  # MB
RESULT_FILE = "result.json"


_PLAIN = re.compile(r"[\w./~+,:@%=-]*")  # characters that a shell needs no quotes for


class InputPath(click.Path):
    """Path of a file with one of the suffixes, or of a directory with one of ``holds`` (patterns) in it."""

    def __init__(self, *suffixes: str, holds: Sequence[str] = ()) -> None:
        super().__init__(path_type=Path)
        self._suffixes = suffixes
        self._holds = tuple(holds)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; an empty text, as of a shell variable that is not set, is none. See click.ParamType."""
        if not os.fspath(value):
            self.fail("an empty text: expected a path", param, ctx)
        return super().convert(value, param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Complete to such paths, and to directories on the way to them; see click.ParamType."""
        del ctx, param
        found = _paths(incomplete, self._is_wanted)
        if not all(_PLAIN.fullmatch(path) for path in found):
            return [CompletionItem(incomplete, type="file")]  # the shell completes, and quotes, by itself
        return [CompletionItem(path) for path in found]

    def _is_wanted(self, path: Path) -> bool:
        if path.is_dir():
            return any(next(path.glob(pattern), None) for pattern in self._holds)
        return path.name.endswith(self._suffixes)


def _paths(incomplete: str, wanted: Callable[[Path], bool]) -> list[str]:
    """Wanted paths with this beginning; a lone directory is entered, since shells end a lone answer with a blank."""
    begin = incomplete.rfind("/") + 1
    head, start = incomplete[:begin], incomplete[begin:]
    found = []
    try:
        for entry in sorted(Path(head or ".").expanduser().iterdir()):
            if not entry.name.startswith(start) or (entry.name.startswith(".") and not start):
                continue
            if wanted(entry):
                found.append(head + entry.name)
            elif entry.is_dir():
                found.append(f"{head}{entry.name}/")
    except (OSError, RuntimeError):  # not readable, or ~name of an unknown user
        return []
    return found + _paths(found[0], wanted) if len(found) == 1 and found[0].endswith("/") else found


class ExperimentPath(InputPath):
    """An experiment file, or the name of an example; where there is a directory of that name, it is given as it is."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """The path of the file, by the rule of ``bundled.find``; see click.ParamType."""
        from msg_analysis.experiment.examples import find

        word = os.fsdecode(super().convert(os.fspath(value), param, ctx))
        return Path(word) if Path(word).is_dir() and self._is_wanted(Path(word)) else find(word)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Complete to files, then to names of examples; see click.ParamType."""
        from msg_analysis.experiment.examples import names

        files = super().shell_complete(ctx, param, incomplete)
        if any(item.type == "file" for item in files):
            return files
        return files + [CompletionItem(name) for name in names() if name.startswith(incomplete)]


YAML = InputPath(".yaml", ".yml", ".json")  # sweeps, hosts
EXPERIMENT = ExperimentPath(".yaml", ".yml", ".json")
BAG = InputPath(*BAG_SUFFIXES, holds=("metadata.yaml", "*.mcap", "*.db3"))
SOURCE = ExperimentPath(".yaml", ".yml", ".json", *BAG_SUFFIXES, holds=("metadata.yaml", "*.mcap", "*.db3"))
LOG = InputPath(*BAG_SUFFIXES, ".csv", ".parquet", ".npz", holds=("metadata.yaml", "*.mcap", "*.db3"))
RESULT = InputPath(".json", holds=(RESULT_FILE,))
RUN_RECORD = InputPath(".json")
PATH = click.Path(path_type=Path)
FILE = click.Path(dir_okay=False, path_type=Path)


def is_bag(source: Path) -> bool:
    """Whether a ``SOURCE`` is a bag, and not an experiment file."""
    return source.is_dir() or bool({".mcap", ".db3"} & set(source.suffixes))


set_option = click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="KEY=VALUE",
    help="Replace a value of EXPERIMENT, for example noise.process=2. Repeatable.",
)


def with_changes(document: Any, changes: Sequence[str]) -> Any:
    """The document of an experiment with the values of ``--set``; keys as in sweep files, values in YAML."""
    from msg_analysis.experiment.loading import parse_yaml
    from msg_analysis.sweeps.grid import KeyProblemError, put

    if not isinstance(document, dict):
        return document  # whoever parses it says what is wrong
    for change in changes:
        key, _, text = change.partition("=")
        if not key.strip() or not text.strip():
            raise InputError(f"--set {change}: expected KEY=VALUE, for example noise.process=2")
        try:
            document = put(document, key.strip(), parse_yaml(text, f"--set {change}"))
        except KeyProblemError as error:
            raise InputError(f"--set {str(error).removeprefix('over.')}") from None
    return document


def load_experiment(path: Path, changes: Sequence[str] = ()) -> Experiment:
    """The experiment of a file with the values of ``--set``; its notes are printed."""
    from msg_analysis import Experiment
    from msg_analysis.experiment.loading import read_yaml

    if not changes:
        experiment = Experiment.load(path)
    else:
        document = with_changes(read_yaml(path), changes)
        experiment = Experiment.parse(document, source=source_of(path, changes), directory=path.parent)
    print_notes(experiment)
    return experiment


def source_of(path: Path, changes: Sequence[str]) -> str:
    """How errors call a file with the values of ``--set``."""
    return " ".join([str(path), *(f"--set {change}" for change in changes)])


class PositiveFloat(click.FloatRange):
    """A finite number above 0, at most ``most``."""

    def __init__(self, most: float | None = None) -> None:
        super().__init__(min=0, min_open=True, max=most)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Refuse NaN and infinity, too; see click.ParamType."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):  # FloatRange accepts nan
            self.fail(f"{number}: expected a positive number", param, ctx)
        return number


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
verbose_option = click.option(
    "-v", "--verbose", is_flag=True, help="Also print all tests and agents, the order of the agents, and the timing."
)
experiment_argument = click.argument("experiment", type=EXPERIMENT)
seed_option = click.option("--seed", type=int, metavar="N", help="Seed of the run (run.seed).")
duration_option = click.option(
    "--duration", type=float, metavar="T", help="Overrides run.duration, in units of simulated time."
)


def choice_option(name: str, choices: Sequence[str], text: str, **more: Any) -> Callable[..., Any]:
    """An option with one of these words; ``text``: its help."""
    return click.option(name, type=click.Choice(choices), help=text, **more)


def positive_option(name: str, metavar: str, text: str, **more: Any) -> Callable[..., Any]:
    """An option with a finite number above 0; ``text``: its help."""
    return click.option(name, type=PositiveFloat(), metavar=metavar, help=text, **more)


def out_option(metavar: str, text: str, **more: Any) -> Callable[..., Any]:
    """The option ``--out``; ``text``: its help."""
    return click.option("--out", type=PATH, metavar=metavar, help=text, **more)


max_missed_option = click.option(
    "--max-missed",
    type=click.FloatRange(0.0, 1.0),
    metavar="SHARE",
    default=0.05,
    help="In real time: share of missed deadlines above which the verdict is 'late' (exit code 4).",
)


def level_option(what: str) -> Callable[..., Any]:
    """The option ``--level``, a probability; ``what`` is its help text."""
    return click.option("--level", type=PositiveFloat(0.5), metavar="P", default=0.01, help=what)


def storage_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add ``--compression`` and ``--split-size``; the command gets the ``storage`` that they ask for."""

    @wraps(command)
    def with_storage(*arguments: Any, compression: Compression, split_size: float | None, **options: Any) -> None:
        from msg_analysis.bags.stored_file import MEGABYTE, Storage

        try:
            size = None if split_size is None else round(split_size * MEGABYTE)
        except (ValueError, OverflowError) as error:  # nan, inf
            raise InputError(f"--split-size: {split_size}: expected a number of MB") from error
        command(*arguments, storage=Storage(compression, size), **options)

    what = "Start a new file of the bag after this many MB (10^6 bytes)."
    decorate = click.option("--split-size", type=click.FloatRange(SMALLEST_SPLIT), metavar="MB", help=what)
    compress = choice_option("--compression", COMPRESSIONS, "Compression of the chunks of the bag.", default="zstd")
    decorated: Callable[..., None] = decorate(compress(with_storage))
    return decorated


def parse_agents(text: str) -> list[int | str]:
    """Numbers and names between commas."""
    return [int(word) if word.isascii() and word.isdigit() else word for word in map(str.strip, text.split(","))]


def suggest(*words: str) -> Callable[..., list[CompletionItem]]:
    """A ``shell_complete`` function that offers these words; the option takes others, too."""
    return lambda _context, _option, incomplete: [CompletionItem(w) for w in words if w.startswith(incomplete)]
