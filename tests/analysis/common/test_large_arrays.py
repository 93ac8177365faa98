"""Arrays in files: the same numbers as in memory, whatever becomes of the disk."""

import mmap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from full_disk import full_disk

from experiments import compare, line_ring, read_bag, simulate, write_trajectory
from msg_analysis.bags import states
from msg_analysis.common import arrays
from msg_analysis.common.arrays import LARGE, LargeRows, in_file, large_zeros, release


def test_small_ones_are_in_memory() -> None:
    array = large_zeros((3, 4), np.int64, total=LARGE - 1)
    assert not in_file(array)
    assert array.shape == (3, 4)
    release(array)
    assert not array.any()


def test_large_ones_keep_their_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Released and read again; views know that they are in a file; nothing is left in the folder."""
    monkeypatch.setattr(arrays.tempfile, "tempdir", str(tmp_path))
    array = large_zeros((1000, 40), np.float64, total=LARGE)
    assert not array.any()
    assert list(tmp_path.iterdir()) == []
    view = array[10:900].reshape(-1, 20)[::2]
    assert in_file(array)
    assert in_file(view)
    assert not in_file(view.copy())
    array[:] = np.arange(40_000).reshape(1000, 40)
    release(view)
    assert np.array_equal(array, np.arange(40_000).reshape(1000, 40))
    assert not in_file(large_zeros((0, 40), np.float64, total=LARGE))
    monkeypatch.setenv("MSG_ANALYSIS_LARGE", "much")
    with pytest.raises(ValueError, match="MSG_ANALYSIS_LARGE: much: expected a number of bytes"):
        large_zeros((1000, 40), np.float64, total=LARGE)


def test_released_memory_is_free() -> None:
    """Of 80 MB that have been written, none is resident afterwards."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("needs /proc")

    def resident() -> int:
        return int(statm.read_text().split()[1]) * mmap.PAGESIZE

    before = resident()
    array = large_zeros((10_000_000,), np.float64, total=LARGE)
    array[:] = 1.0
    written = resident()
    release(array)
    assert written - before > 7e7
    assert resident() - before < 1e7
    assert array.sum() == 10_000_000


@pytest.mark.parametrize("changes", [{}, {"noise": {"process": 1.0, "broadcast": 0.2, "loss": 0.1}}])
def test_a_run_that_is_read_into_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any]
) -> None:
    """Run and comparison are the same as in memory, also of an incomplete bag."""
    run = simulate(line_ring(run={"dt": 0.1, "duration": 200}, **changes))
    run.states[1500, 1] = np.nan
    write_trajectory(run, tmp_path / "bag")
    one = read_bag(tmp_path / "bag")
    monkeypatch.setenv("MSG_ANALYSIS_LARGE", "1")
    monkeypatch.setattr(states, "RELEASED_AT_ONCE", 100)
    monkeypatch.setattr(states, "_CELLS", 7)
    other = read_bag(tmp_path / "bag")
    assert in_file(other.states)
    assert not in_file(one.states)
    assert one.completeness == other.completeness
    assert one.completeness.missing > 0
    assert np.array_equal(one.states, other.states, equal_nan=True)
    for name in ("modes", "agent_modes", "lost"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    np.testing.assert_array_equal(one.published, other.published)
    assert (one.published is None) == (other.published is None) == (not changes)
    assert compare(one).to_json() == compare(other).to_json()


@pytest.mark.parametrize("limit", [1, 900, 10**6])
def test_rows_one_part_after_the_other(limit: int) -> None:
    """In memory, in a file from some size on, or all in a file; none at all, too."""
    random = np.random.default_rng(4)
    rows = LargeRows(3, np.int32, in_memory=limit)
    parts = [random.integers(-9, 9, (count, 3)) for count in (4, 0, 50, 1, 300)]
    assert [rows.append(part) for part in parts] == [0, 4, 4, 54, 55]
    found = rows.array()
    assert in_file(found) == (limit in (1, 900))
    assert found.dtype == np.int32
    assert np.array_equal(found, np.concatenate(parts))
    assert LargeRows(2, np.int64).array().shape == (0, 2)


def test_without_room_on_the_disk() -> None:
    """Files of this process may have 1 MB: what does not fit stays in memory, and can be used."""
    rows, parts = LargeRows(2, np.int64, in_memory=1), [np.full((20_000, 2), number) for number in range(9)]
    with full_disk(10**6):
        array = large_zeros((300_000,), np.float64, total=10**9)
        for part in parts:
            rows.append(part)
        found = rows.array()
    assert not in_file(array)
    array[:] = 1.0
    assert not in_file(found)
    assert np.array_equal(found, np.concatenate(parts))
