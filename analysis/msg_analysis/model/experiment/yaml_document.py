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

"""Reading YAML strictly: YAML 1.2 scalars, no duplicate keys, no objects; and telling its kinds of files from bags."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import yaml

from msg_analysis.common.bounded_input import SAFE_LOADER, load_yaml, read_text
from msg_analysis.errors import InputError


class _StrictLoader(SAFE_LOADER):  # type: ignore[misc]  # one of two classes: see there
    """The safe loader with the scalars of YAML 1.2 (1e-3 is a number, not a text), without duplicate keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 (of PyYAML)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"key '{key.value}' appears twice: remove one", key.start_mark
                    )
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
    _StrictLoader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first)


def _construct_int(loader: _StrictLoader, node: yaml.ScalarNode) -> int:
    """Decimal, also with leading zeros (octal in YAML 1.1)."""
    return int(loader.construct_scalar(node))


_StrictLoader.add_constructor("tag:yaml.org,2002:int", _construct_int)

_BAG_FILES = ("metadata.yaml", "*.mcap", "*.mcap.zstd", "*.db3", "*.db3.zstd")
_BAG_STARTS = (b"\x89MCAP0\r\n", b"SQLite format 3\x00")
_BAG_KEY = "rosbag2_bagfile_information"  # of its metadata.yaml
_NOT_A_BAG = (
    "expected a YAML file: give the experiment file from which it was recorded; `msg-analysis info`, `compare` and "
    "`export` read bags"
)
_HEAD = 65_536  # bytes of a file that are looked at


def is_bag(path: Path) -> bool:
    """Whether it is a bag, or a file of one, by its name or its beginning; it may be damaged."""
    if path.is_dir():
        return any(next(path.glob(pattern), None) for pattern in _BAG_FILES)
    return _head(path).startswith(_BAG_STARTS)


def no_bag_but(path: Path) -> str | None:
    """What a file is instead of one of a bag, and what to do, in words; None where that cannot be told."""
    text = _head(path).decode("utf-8", "ignore")
    if re.search(rf"^{_BAG_KEY}\s*:", text, re.MULTILINE):
        return f"is the metadata of a bag: expected a bag: give its directory, {path.parent}"
    keys = set(re.findall(r"""^[ {]*["']?(\w+)["']?\s*:""", text, re.MULTILINE))
    if "graphs" in keys:
        wanted = f"expected a bag: `msg-agents run {path}` and `msg-analysis simulate {path}` make one"
        return f"is an experiment file: {wanted}"
    if {"experiment", "over"} <= keys:
        return f"is a sweep file: expected a bag: `msg-analysis sweep {path}` runs it"
    return None


def _head(path: Path) -> bytes:
    """The beginning of a regular file; nothing of others, whose reader says what is wrong."""
    if not path.is_file():
        return b""
    try:
        with path.open("rb") as stream:
            return stream.read(_HEAD)
    except OSError:
        return b""


def other_kind(mapping: Mapping[Any, Any], wanted: str) -> str | None:
    """What a document is instead of the ``wanted`` kind (experiment, sweep), and what to do; None: not another kind."""
    if _BAG_KEY in mapping:
        return f"the metadata of a bag: {_NOT_A_BAG}"
    if wanted == "experiment" and {"experiment", "over"} <= mapping.keys() and "graphs" not in mapping:
        return "a sweep file: expected an experiment file: `msg-analysis sweep` runs sweeps"
    if wanted == "sweep" and "graphs" in mapping and not {"experiment", "over"} & mapping.keys():
        return "an experiment file: expected a sweep file: name it there as `experiment:`, and its values as `over:`"
    return None


def read_yaml(path: Path) -> Any:
    """The content of a YAML (or JSON) file in UTF-8.

    InputError, with file and (if known) line: the file cannot be read, is not YAML in UTF-8, is too large or too deep,
    or has a key twice.
    """
    if is_bag(path):
        raise InputError(f"{path}: is a bag: {_NOT_A_BAG}")
    try:
        text = read_text(path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file: check the path") from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: is a directory: expected an experiment file (YAML)") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start}: not UTF-8 text: expected an experiment file (YAML)") from error
    return parse_yaml(text, str(path))


def parse_yaml(text: str, source: str) -> Any:
    """The content of a text in YAML (or JSON); errors as of ``read_yaml``, ``source`` in the place of the file."""
    try:
        return load_yaml(text, _StrictLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise InputError(f"{source}: {line}{', '.join(filter(None, (error.context, error.problem)))}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{source}: not YAML: {' '.join(str(error).split())}") from error
