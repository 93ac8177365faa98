"""Compiled laws, random streams, clocks and the matrix exponential: bit by bit beside numpy, fractions, many digits."""

import math
import struct
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from math import floor

import mpmath
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from msg_analysis.arithmetic import update_law
from msg_analysis.arithmetic.reproducible import (
    StepClock,
    Stream,
    exponential,
    generator,
    link_number,
    normals,
    reproducible_product,
)

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
def test_all_finite(values: list[float]) -> None:
    expected = all(math.isfinite(value) for value in values)
    assert update_law.all_finite(pack(values)) is expected
    assert update_law.all_finite_with_numpy(pack(values)) is expected


def test_terms_are_added_in_order() -> None:
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


def defined(seed: int, stream: int, agent: int, block: int) -> np.random.Generator:
    key = np.random.SeedSequence(seed).generate_state(2, np.uint64)
    counter = np.array([0, block % 2**64, agent, stream], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def test_each_number_is_a_function_of_its_place() -> None:
    """In any order, whatever was drawn before, and for links, whose numbers are large."""
    places = [(seed, 3, agent, block) for seed in (0, 7) for agent in (0, link_number(5, 2)) for block in (-1, 0, 9)]
    for seed, stream, agent, block in [*places, *reversed(places)]:
        expected = defined(seed, stream, agent, block).standard_normal((3, 5))
        assert np.array_equal(normals(seed, Stream(stream), agent, block, (3, 5)), expected)
        other = generator(seed, Stream(stream), agent, block)
        assert other.integers(2**20, dtype=np.uint32) >= 0  # leaves half of a number behind
        assert other.random() == _second(seed, stream, agent, block)


def _second(seed: int, stream: int, agent: int, block: int) -> float:
    random = defined(seed, stream, agent, block)
    random.integers(2**20, dtype=np.uint32)
    return random.random()


def test_threads_do_not_disturb_each_other() -> None:
    def numbers(agent: int) -> bool:
        drawn = [normals(1, Stream.PROCESS, agent, block, (256, 4)) for block in range(50)]
        defined_ones = [defined(1, 3, agent, block).standard_normal((256, 4)) for block in range(50)]
        return np.array_equal(drawn, defined_ones)

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(numbers, range(16)))


# Lengths with few decimals, as people write them, and with as many as a float has.
lengths = st.one_of(st.sampled_from([0.05, 0.1, 1.0, 1e-7, 0.3, 0.007, 1 / 3]), st.floats(1e-6, 100.0))
offsets = st.floats(0.0, 1.0, exclude_max=True)


def due(step: int, dt: float, phase: float) -> int:
    """By the definition: the text of dt counts, half a nanosecond goes up, the phase shifts all steps alike."""
    length = Fraction(str(dt)) * 10**9
    return floor(step * length + Fraction(1, 2)) + round(phase * float(length))


@given(step=st.integers(0, 10**12), dt=lengths, phase=offsets)
def test_times_one_by_one(step: int, dt: float, phase: float) -> None:
    assert StepClock(dt, phase).nanoseconds(step) == due(step, dt, phase)
    assert abs(StepClock(dt).nanoseconds(step) - step * Fraction(str(dt)) * 10**9) <= Fraction(1, 2)


@given(steps=st.lists(st.integers(0, 10**7), max_size=5), dt=lengths, phase=offsets)
def test_times_many_at_once(steps: list[int], dt: float, phase: float) -> None:
    """Bit for bit the same, also where a product does not fit into 64 bits."""
    found = StepClock(dt, phase).times(np.array(steps, dtype=np.int64))
    assert found.dtype == np.int64
    assert found.tolist() == [due(step, dt, phase) for step in steps]


def test_products_that_do_not_fit_into_64_bits() -> None:
    dt, steps = 1.2345678901234567e-05, np.array([[0, 7], [4_700_001, 10**8]])
    assert StepClock(dt).times(steps).tolist() == [[due(k, dt, 0.0) for k in row] for row in steps.tolist()]


def laplacian(agents: int, scale: float, seed: int) -> np.ndarray:
    """Of a random graph, with a leader."""
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.exponential(scale, (agents, agents)) * (rng.random((agents, agents)) < 0.5), 1)
    adjacency = upper + upper.T
    result = np.diag(adjacency.sum(axis=1)) - adjacency
    result[0, 0] += scale
    return result


@pytest.mark.parametrize(("agents", "scale"), [(1, 1.0), (2, 1.0), (5, 1e-3), (5, 1.0), (6, 50.0), (8, 1e4), (20, 1.0)])
def test_against_forty_digits(agents: int, scale: float) -> None:
    z = laplacian(agents, scale, agents)
    with mpmath.workdps(40):
        exact = np.array(mpmath.expm(mpmath.matrix((-z).tolist())).tolist(), dtype=float)
    assert np.abs(exponential(-z) - exact).max() < 1e-15


def test_large_exponentials() -> None:
    z = laplacian(150, 0.05, 3)
    assert np.abs(exponential(-z) - scipy.linalg.expm(-z)).max() < 1e-14
    assert np.array_equal(exponential(np.zeros((3, 3))), np.eye(3))


def test_the_product_is_as_good_as_any() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(40, 40)), rng.normal(size=(40, 40))
    assert np.abs(reproducible_product(a, b) - a @ b).max() < 1e-13
    permuted = rng.permutation(40)  # another order of the sums
    assert np.array_equal(reproducible_product(a[:, permuted], b[permuted]), reproducible_product(a, b))
