# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""Files: bounded input, and output that is written whole or not at all."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import tempfile
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import yaml

from msg_analysis.errors import InputError

RESULT_FILE = "result.json"  # of a run, next to its bag
REPORT_FILE = "report.html"  # the same


def require_place(file: Path | None) -> None:
    """Refuse, before long work, a path where no file can be put, whatever the permissions; None: no file."""
    if file is not None:
        require_utf8(file)
    if file is not None and not file.parent.is_dir():
        raise InputError(f"{file}: no such directory {file.parent}: create it")
    if file is not None and file.exists() and not file.is_file():
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


_without_locks: list[Path] = []  # of which it was said


def lock(file: int | IO[Any], operation: int, path: Path | None = None) -> bool:
    """Lock a file, as flock; False where its file system has no locks: NFS, Lustre or FUSE, for example.

    Of the first such ``path`` in this process, a note says so.
    """
    try:
        fcntl.flock(file, operation)
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
            raise
        if path is not None and not _without_locks:
            from msg_analysis.common.console import print_note  # rich

            _without_locks.append(path)
            words = f"its file system has no locks ({error.strerror})"
            print_note(f"{path}: {words}: two programs that use it at the same time do not notice each other")
        return False
    return True


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


LONGEST_FILE = 64 << 20  # bytes
PART = 1 << 20  # bytes
DEEPEST = 50  # collections in collections; PyYAML's loader in C crashes at some thousands
MOST_REPEATED = 1_000_000  # values that aliases repeat, each counted as often as it is repeated

SAFE_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # in C, where PyYAML has it


def read_text(path: Path, longest: int = LONGEST_FILE) -> str:
    """The text of a file in UTF-8; errors as of ``read_bytes``."""
    return read_bytes(path, longest).decode("utf-8")


def read_bytes(path: Path, longest: int = LONGEST_FILE) -> bytes:
    """The bytes of a file; OSError (EFBIG) where it has more than that, endless ones included."""
    data = bytearray()
    with path.open("rb") as stream:
        while part := stream.read(PART):
            data += part
            if len(data) > longest:
                raise OSError(errno.EFBIG, f"longer than {longest >> 20} MB")
    return bytes(data)


class StrictLoader(SAFE_LOADER):  # type: ignore[misc]  # one of two classes: see there
    """The safe loader with the scalars of YAML 1.2 (1e-3 is a number, not a text), without duplicate keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 (of PyYAML)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """A mapping; a key that appears twice is an error."""
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    text = f"key '{key.value}' appears twice: remove one"
                    raise yaml.constructor.ConstructorError(None, None, text, key.start_mark)
                seen.add(key.value)
        return dict(super().construct_mapping(node, deep))


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    ("merge", r"<<", ["<"]),
):
    StrictLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first)


def _construct_int(loader: StrictLoader, node: yaml.ScalarNode) -> int:
    """Decimal, also with leading zeros (octal in YAML 1.1)."""
    return int(loader.construct_scalar(node))


StrictLoader.add_constructor("tag:yaml.org,2002:int", _construct_int)


def load_yaml(text: str, loader: Any = SAFE_LOADER) -> Any:
    """The document; YAMLError where it is nested too deeply, or where aliases make it too large."""
    _require_bounds(text)
    return yaml.load(text, loader)


def _require_bounds(text: str) -> None:
    """From the events of a document; nothing is built."""
    sizes: dict[str, int | None] = {}  # values of what has an anchor; None: not finished yet
    around: list[tuple[str | None, int]] = []  # anchor and values so far of the collections that are open
    repeated = 0
    for event in yaml.parse(text, SAFE_LOADER):
        anchor = getattr(event, "anchor", None)
        if isinstance(event, yaml.CollectionStartEvent):
            if len(around) >= DEEPEST:
                raise _error(f"nested too deeply, more than {DEEPEST} levels", event)
            around.append((anchor, 0))
            if anchor:
                sizes[anchor] = None
            continue
        size = 1
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, values = around.pop()
            size = values + 1
        elif isinstance(event, yaml.AliasEvent):
            found = sizes.get(str(anchor), 0)  # one that is not there is for the loader to name
            if found is None:
                raise _error(f"alias '{anchor}' stands inside what it names", event)
            anchor, size, repeated = None, found, repeated + found
            if repeated > MOST_REPEATED:
                raise _error(f"aliases repeat more than {MOST_REPEATED} values: write down what is needed", event)
        elif not isinstance(event, yaml.ScalarEvent):
            continue
        if anchor:
            sizes[anchor] = size
        if around:
            name, values = around[-1]
            around[-1] = (name, values + size)


def _error(problem: str, event: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
