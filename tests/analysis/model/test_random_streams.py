"""The random streams of a run against their definition, numpy's Philox."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from msg_analysis.arithmetic.reproducible import Stream, generator, link_number, normals


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
