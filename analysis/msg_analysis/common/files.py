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

"""Files written at the end of long work: checked before it, and never written in part."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from msg_analysis.errors import InputError

RESULT_FILE = "result.json"  # of a run, next to its bag
REPORT_FILE = "report.html"  # the same


def require_place(file: Path | None) -> None:
    """Refuse, before long work, a path where no file can be put: its directory is missing, or it is not a regular file.

    None stands for no file. Raises InputError; permissions are not checked.
    """
    if file is None:
        return
    if not file.parent.is_dir():
        raise InputError(f"{file}: no such directory {file.parent}: create it")
    if file.exists() and not file.is_file():
        raise InputError(f"{file}: not a regular file: choose another")


def require_utf8(path: Path) -> None:
    """Refuse a path whose bytes are not text: it could not be written into a bag, or passed on. Raises InputError."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        shown = str(path).encode(errors="backslashreplace").decode()
        raise InputError(f"{shown}: not UTF-8: choose a name in UTF-8") from error


def no_temporary_directory(error: OSError) -> str | None:
    """What to say of the error of ``tempfile`` where there is no temporary directory; None: it is another error."""
    if "temporary directory" not in str(error.strerror):
        return None
    return f"TMPDIR: {error.strerror}: set it to a directory that can be written"


def write_whole(path: Path, content: bytes) -> Path:
    """Write under a temporary name and rename; after an OSError, what was at ``path`` is unchanged."""
    with written_whole(path) as temporary:
        temporary.write_bytes(content)
    return path


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary file to write, beside ``path``, which it replaces at the end; after any error, nothing is changed."""
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as stream:
        temporary = Path(stream.name)
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
