"""What has been done is kept, whatever happens to whoever writes it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from msg_analysis.errors import InputError
from msg_analysis.sweep.points import DONE, Outcome
from msg_analysis.sweep.results import JOURNAL, ResultStore


def outcome(name: str, value: float = 1.0) -> Outcome:
    return Outcome(name, DONE, None, {"system_error": value}, 0.1, "here:1", "version 1")


def test_kept_and_read_again(tmp_path: Path) -> None:
    with ResultStore.open(tmp_path / "new" / "deep") as store:
        store.add([outcome("a"), outcome("b", float("inf"))])
        store.add([outcome("a", 2.0)])
    with ResultStore.open(tmp_path / "new" / "deep") as store:
        assert store.outcomes == {"a": outcome("a", 2.0), "b": outcome("b", float("inf"))}
        assert store.damaged == 0


def test_cut_anywhere_it_keeps_all_whole_lines_and_goes_on(tmp_path: Path) -> None:
    with ResultStore.open(tmp_path) as store:
        store.add([outcome("a"), outcome("b"), outcome("c")])
    content = (tmp_path / JOURNAL).read_bytes()
    for size in range(len(content) + 1):
        (tmp_path / JOURNAL).write_bytes(content[:size])
        with ResultStore.open(tmp_path) as store:
            assert list(store.outcomes) == ["a", "b", "c"][: content[:size].count(b"\n")]
            assert store.damaged == 0
            store.add([outcome("d")])
        with ResultStore.open(tmp_path) as store:
            assert list(store.outcomes) == [*["a", "b", "c"][: content[:size].count(b"\n")], "d"]
            assert store.damaged == 0


@pytest.mark.parametrize("line", [b"{}", b"nonsense", b"\xff\xfe", b"[1]", b""])
def test_lines_that_are_none_are_counted(tmp_path: Path, line: bytes) -> None:
    with ResultStore.open(tmp_path) as store:
        store.add([outcome("a")])
    path = tmp_path / JOURNAL
    path.write_bytes(line + b"\n" + path.read_bytes())
    with ResultStore.open(tmp_path) as store:
        assert list(store.outcomes) == ["a"]
        assert store.damaged == 1


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    code = f"from msg_analysis.sweep.results import ResultStore; ResultStore.open({str(tmp_path)!r})"
    with ResultStore.open(tmp_path):
        with pytest.raises(InputError, match="another sweep is writing"):
            ResultStore.open(tmp_path)
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
        assert "another sweep is writing" in other.stderr
    ResultStore.open(tmp_path).close()


def test_a_place_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose another place with --out"):
        ResultStore.open(tmp_path / "file")
