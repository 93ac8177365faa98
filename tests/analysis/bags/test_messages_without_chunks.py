"""Messages that stand in a file without chunks, against a walk from record to record.

No test here can raise a false alarm: nothing random is asserted.
"""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from msg_analysis.bags import mcap_reading
from msg_analysis.bags.mcap_reading import MAGIC, McapFile

MESSAGE, METADATA_INDEX, FOOTER, HEAD = 5, 13, 2, 22

# Runs of equal and of different lengths; of 21 bytes a message is damaged, the other opcode is none.
runs = st.lists(
    st.tuples(
        st.sampled_from([MESSAGE] * 4 + [METADATA_INDEX]), st.sampled_from([21, 22, 30, 98, 700]), st.integers(1, 60)
    ),
    max_size=12,
)


def _file(path: Path, records: list[tuple[int, bytes]]) -> bytes:
    body = b"".join(struct.pack("<BQ", opcode, len(content)) + content for opcode, content in records)
    path.write_bytes(MAGIC + body)
    return MAGIC + body


def _walk(data: bytes) -> tuple[list[bytes], int]:
    """CDR bytes of the whole messages, and where the last whole record ends."""
    at, found = len(MAGIC), []
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            break
        if opcode == MESSAGE and length >= HEAD:
            found.append(data[at + 9 + HEAD : at + 9 + length])
        at += 9 + length
    return found, at


def _read(path: Path) -> tuple[list[bytes], McapFile]:
    file, found, ends = McapFile(path), [], []
    for batch in file.batches():
        found += [batch.message(index) for index in range(len(batch.start))]
        ends.append(batch.end)
    assert ends == sorted(ends)
    return found, file


@settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(runs=runs, cut=st.integers(0, 3000), block=st.sampled_from([1, 100, 5000, 2**18]))
def test_runs_of_any_lengths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: list[tuple[int, int, int]], cut: int, block: int
) -> None:
    """Cut off anywhere, and whatever the size of the blocks in which the file is read."""
    monkeypatch.setattr(mcap_reading, "_LOOSE", block)
    records = [(opcode, size, number) for opcode, size, count in runs for number in range(count)]
    contents = [(opcode, bytes(HEAD)[:size] + bytes([number] * (size - HEAD))) for opcode, size, number in records]
    path = tmp_path / "x.mcap"
    data = _file(path, contents)
    data = data[: max(len(MAGIC), len(data) - cut)]
    path.write_bytes(data)
    wanted, end = _walk(data)
    found, file = _read(path)
    assert found == wanted
    assert file.whole_bytes == end
    assert file.torn


def test_long_messages(tmp_path: Path) -> None:
    """Longer than what is read at a time, beside short ones; then one that is cut off."""
    sizes = [30, 2**18 - 9, 2**18, 2**20, 40, 40, 2**18 + 1]
    contents = [(MESSAGE, bytes(HEAD) + bytes([i] * (size - HEAD))) for i, size in enumerate(sizes)]
    path = tmp_path / "x.mcap"
    data = _file(path, contents)
    assert _read(path)[0] == [content[HEAD:] for _, content in contents]
    path.write_bytes(data[:-1])
    found, file = _read(path)
    assert found == [content[HEAD:] for _, content in contents[:-1]]
    assert file.torn is not None
    assert "cut off" in file.torn


def test_the_end_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(_file(path, [(MESSAGE, bytes(98))] * 40 + [(FOOTER, bytes(20))]) + MAGIC)
    found, file = _read(path)
    assert len(found) == 40
    assert file.torn is None
