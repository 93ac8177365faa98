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

"""The files of a bag by their names: which there are, and how each is read."""

from __future__ import annotations

import re
from pathlib import Path, PurePath
from typing import Any

from msg_analysis.bags.format.mcap_file import McapFile
from msg_analysis.bags.format.metadata import METADATA_FILE, read_metadata
from msg_analysis.bags.format.sqlite_file import SqliteFile
from msg_analysis.bags.format.storage_options import BAG_SUFFIXES, SQLITE_SUFFIX
from msg_analysis.bags.format.stored_file import StoredFile
from msg_analysis.errors import BagError
from msg_analysis.model.experiment.yaml_document import no_bag_but

_STORAGES = ("mcap", "sqlite3")


def stored_file(path: Path) -> StoredFile:
    """A file of a bag, to be read; sqlite3 if its name says so, else MCAP."""
    return SqliteFile(path) if SQLITE_SUFFIX in path.suffixes else McapFile(path)


def bag_files(path: Path) -> list[Path]:
    """The files of a bag in their order; BagError: there are none, one is missing, or another storage."""
    if path.is_file():
        if instead := no_bag_but(path):
            raise BagError(f"{path}: {instead}")
        return [path]
    if not path.is_dir():
        raise BagError(f"{path}: not found: expected the directory of a bag, or an .mcap or .db3 file")
    information = read_metadata(path)
    if information is None:
        files = [file for suffix in BAG_SUFFIXES for file in path.glob(f"*{suffix}")]
        if not files:
            if {entry.name for entry in path.iterdir()} <= {"log"}:  # a run makes its directory before anything else
                raise BagError(f"{path}: empty: its run ended before anything was recorded: delete it")
            raise BagError(f"{path}: not a bag: expected metadata.yaml, .mcap or .db3 files in this directory")
        return sorted(files, key=_file_number)
    _refuse_unknown(path, information)
    names = information.get("relative_file_paths")
    files = [_listed(path, str(name)) for name in names] if isinstance(names, list) else []
    lost = [file.name for file in files if not file.is_file()]
    if lost or not files:
        raise BagError(
            f"{path}: {', '.join(lost) or 'every file'} of its {METADATA_FILE} is missing: copy the whole bag, or move "
            f"{METADATA_FILE} away to read the files that are there"
        )
    return files


def first_file(path: Path) -> Path | None:
    """The first file of a bag by the names alone; None where there is none."""
    files = [file for suffix in BAG_SUFFIXES for file in path.glob(f"*{suffix}")]
    return min(files, key=_file_number, default=None)


def _refuse_unknown(path: Path, information: dict[str, Any]) -> None:
    storage = information.get("storage_identifier")
    if storage not in _STORAGES:
        raise BagError(
            f"{path}: its storage is {storage}, expected mcap or sqlite3: record with `ros2 bag record -s mcap`, or "
            "convert it"
        )
    mode = str(information.get("compression_mode") or "none").lower()
    compression = information.get("compression_format") or "zstd"
    if mode != "none" and compression != "zstd":
        raise BagError(
            f"{path}: its compression_format is {compression}, expected zstd: convert it with `ros2 bag convert`"
        )


def _listed(path: Path, name: str) -> Path:
    """A file of metadata.yaml; before version 4 of its format, its name has that of the bag before it."""
    file = path / name
    return file if file.is_file() else path / PurePath(name).name


def _file_number(file: Path) -> tuple[int, str]:
    """Order of the files of a split bag, which rosbag2 numbers: name_0.mcap, name_1.mcap, ..., name_10.mcap."""
    number = re.search(r"_(\d+)\.(?:mcap|db3)", file.name)
    return int(number[1]) if number else 0, file.name
