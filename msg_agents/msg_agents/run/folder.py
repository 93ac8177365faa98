# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""The folder of a run, and the experiment with the values of the command line."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msg_agents.environment import MEMORY, free_space
from msg_analysis.common import files
from msg_analysis.common.files import require_utf8
from msg_analysis.common.shared_folders import clear_unlocked, own_folder
from msg_analysis.errors import InputError
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.loading import read_yaml
from msg_analysis.experiment.problems import ExperimentError

PREFIX = "run_"
SPARE = 4  # times the room that is needed must be free there, so that other programs have enough
YOUTH = 60.0  # s; younger folders may belong to a run that has not locked its own yet


@contextmanager
def temporary_directory(room: int | None = None, memory: Path = MEMORY) -> Iterator[Path]:
    """A folder, in memory if there is ``room`` [bytes], that is removed at the end; first, those of killed runs are."""
    parent = own_folder()
    places = [parent]
    if os.access(memory, os.W_OK):
        places.append(own_folder(memory))
        if room is not None and free_space(memory) > SPARE * room:
            parent = places[-1]
    for place in places:
        clear_unlocked(place, PREFIX, YOUTH)
    path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
    lock = os.open(path, os.O_RDONLY)  # marks folders in use; ends with its process
    try:
        files.lock(lock, fcntl.LOCK_EX, path)
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


def make_bag_directory(experiment: Experiment, out: Path, *, option: str = "--out: ") -> Path:
    """Make an empty directory <out>/<name>_<time> for a new bag; ``option``: how the user gave ``out``."""
    require_utf8(out)
    stem = f"{experiment.name}_{datetime.now(UTC):%Y%m%d_%H%M%S}"
    candidate, number = out / stem, 2
    try:
        out.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                candidate.mkdir()  # no other run can then take that name
                break
            except FileExistsError:
                candidate, number = out / f"{stem}_{number}", number + 1
        directory = os.open(candidate, os.O_RDONLY)
        files.lock(directory, fcntl.LOCK_SH, candidate)  # the recorder, which locks it, cannot show the note
        os.close(directory)
        return candidate
    except OSError as error:
        place = "is a file" if out.is_file() else f"cannot be written ({error.strerror})"
        raise InputError(f"{option}{out}: {place}: give a directory for the bags of runs") from error


def load_with_overrides(
    path: Path,
    run: Mapping[str, Any],
    *,
    name: Callable[[str], str] = "--{}".format,  # of the new value of a key, in errors
    change: Callable[[Any], Any] = lambda document: document,  # of other keys of the file, made first
    source: str = "",  # name of the file then, in errors
) -> Experiment:
    """The experiment, checked once, after values of ``run`` were replaced; None replaces nothing."""
    changes = {key: value for key, value in run.items() if value is not None}
    if str(changes.get("processes", "")).isdigit():  # it may be a number as text
        changes["processes"] = int(changes["processes"])
    document, source = change(read_yaml(path)), source or str(path)
    if not changes or not isinstance(document, dict) or not isinstance(section := document.get("run", {}), dict):
        return Experiment.parse(document, source=source, directory=path.parent)
    changed = document | {"run": section | changes}
    try:
        return Experiment.parse(changed, source=source, directory=path.parent)
    except InputError as error:
        Experiment.parse(document, source=source, directory=path.parent)  # the fault may be the file's
        problems = error.problems if isinstance(error, ExperimentError) else []
        wrong = [key for key in changes if any(line.startswith(f"run.{key}:") for line in problems)]
        given = ", ".join(name(key) for key in wrong or changes)
        return Experiment.parse(changed, source=given, directory=path.parent)
