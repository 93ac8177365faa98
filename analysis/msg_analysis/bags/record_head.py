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

"""The run record of a bag by its first bytes: for lists of many bags, of which no states are read."""

from __future__ import annotations

import io
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Metadata

from msg_analysis.bags.format.files import first_file
from msg_analysis.bags.format.mcap_chunks import RECORD, RECORD_LIMIT
from msg_analysis.bags.format.mcap_file import MAGIC
from msg_analysis.bags.reader import read_record
from msg_analysis.bags.written_file import RECORD_NAME
from msg_analysis.errors import BagError, InputError

MOST = 16 << 20  # bytes of messages in which the record of another recorder's bag is looked for


def record_document(path: Path) -> dict[str, Any]:
    """The document of the run record of a bag; only that of another recorder's bag is checked.

    BagError: there is none in the first ``MOST`` bytes; InputError: it is not valid.
    """
    text = _head_record(first_file(path)) or read_record(path, most=MOST).to_json()
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its run record is not JSON ({error}): the bag is damaged") from error
    if not isinstance(document, dict):
        raise InputError(f"{path}: its run record is not a JSON object: the bag is damaged")
    return document


def started(path: Path) -> datetime | None:
    """When the run of a bag was started, by the head of its first file alone; None where that does not say it."""
    try:
        found = datetime.fromisoformat(json.loads(_head_record(first_file(path)) or "{}")["started"])
        return found if found.tzinfo else found.replace(tzinfo=UTC)
    except (BagError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _head_record(file: Path | None) -> str | None:
    """The text that our recorder and the twin put before the first chunk of an MCAP file; None where there is none."""
    if file is None or file.suffix != ".mcap":
        return None
    try:
        size = file.stat().st_size
        with file.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return None
            while len(head := stream.read(RECORD.size)) == RECORD.size:
                opcode, length = RECORD.unpack(head)
                if opcode not in (Opcode.HEADER, Opcode.METADATA) or length > min(RECORD_LIMIT, size):
                    return None
                content = stream.read(length)
                if opcode == Opcode.METADATA:
                    record = Metadata.read(ReadDataStream(io.BytesIO(content)))
                    if record.name == RECORD_NAME:
                        found: str | None = record.metadata.get("record")
                        return found
    except Exception as error:  # the library raises many kinds of errors on damage
        if isinstance(error, OSError):
            raise BagError(f"{file}: cannot be read ({error.strerror})") from error
    return None
