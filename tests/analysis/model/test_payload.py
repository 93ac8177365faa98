"""The compiled law beside numpy's, bit for bit."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_analysis.arithmetic import update_law

DOUBLES = st.floats(width=64)
SHAPES = st.tuples(st.integers(1, 5), st.integers(1, 20))


def pack(values: list[float]) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def test_compiled() -> None:
    """Whoever develops this has a compiler; without one the other tests here compare numpy with itself."""
    assert update_law.COMPILED


@given(st.data())
def test_both_laws_give_the_same_bits(data: st.DataObject) -> None:
    """Any doubles: denormal, infinite and undefined ones among them."""
    terms, replicas = data.draw(SHAPES)
    entries = st.lists(DOUBLES, min_size=replicas, max_size=replicas).map(pack)
    weights = tuple(data.draw(st.lists(DOUBLES, min_size=terms, max_size=terms)))
    payloads = data.draw(st.lists(entries, min_size=terms, max_size=terms))
    drive = data.draw(entries)
    ours = update_law.combine(weights, payloads, drive)
    with np.errstate(all="ignore"):
        reference = update_law.combine_with_numpy(weights, payloads, drive)
    for mine, other in zip(struct.iter_unpack("<Q", ours), struct.iter_unpack("<Q", reference), strict=True):
        # Which of the NaNs that meet survives is the processor's choice.
        assert mine == other or all(
            math.isnan(struct.unpack("<d", struct.pack("<Q", *bits))[0]) for bits in (mine, other)
        )


@given(st.lists(DOUBLES, max_size=20))
def test_finite(values: list[float]) -> None:
    expected = all(math.isfinite(value) for value in values)
    assert update_law.all_finite(pack(values)) is expected
    assert update_law.all_finite_with_numpy(pack(values)) is expected


def test_by_hand() -> None:
    """Terms are added in the order given: 1e16 + 1 - 1e16 is 0 from the left."""
    ones = pack([1.0])
    assert update_law.combine((1e16, 1.0, -1e16), [ones, ones, ones], pack([0.0])) == pack([0.0])
    assert update_law.combine((1e16, -1e16, 1.0), [ones, ones, ones], pack([0.5])) == pack([1.5])


@pytest.mark.parametrize(
    "arguments",
    [
        ((), [], b""),
        ((1.0,), [], bytes(8)),
        ((1.0,), [bytes(16)], bytes(8)),
        ((1.0,), [bytes(7)], bytes(7)),
        ((1.0,), [bytearray(8)], bytes(8)),
        ((1.0,), [None], bytes(8)),
        ([1.0], [bytes(8)], bytes(8)),
        ((1.0,), [bytes(8)], 3),
        ((1.0,), [bytes(8)]),
    ],
)
def test_what_is_not_of_one_shape_is_refused(arguments: tuple[object, ...]) -> None:
    with pytest.raises(ValueError, match="expected"):
        update_law.combine(*arguments)
    with pytest.raises(TypeError):
        update_law.combine(("1",), [bytes(8)], bytes(8))
    with pytest.raises(ValueError, match="expected"):
        update_law.all_finite(bytes(7))
