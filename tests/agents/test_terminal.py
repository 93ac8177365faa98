"""Signals that are kept, and let through again, in this process."""

import signal
from collections.abc import Iterator

import pytest

from msg_agents.terminal import SIGNALS, Interruption


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    """Those of Python at its start, and afterwards those of before."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_signal_waits_until_it_is_asked_for() -> None:
    with Interruption() as interruption:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        assert interruption.caught == signal.SIGTERM
        assert interruption.take() == signal.SIGTERM
        assert interruption.take() is None
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_a_kept_signal_is_let_through_at_once() -> None:
    begun = False
    with Interruption() as interruption:
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt), interruption.let_through():
            begun = True
        assert not begun
        signal.raise_signal(signal.SIGINT)  # is kept again
        with pytest.raises(KeyboardInterrupt):
            interruption.check()


def test_a_signal_raises_while_it_is_let_through() -> None:
    interruption = Interruption()
    interruption.keep()
    with pytest.raises(KeyboardInterrupt), interruption.let_through():
        signal.raise_signal(signal.SIGINT)
    assert interruption.take() is None
    signal.raise_signal(signal.SIGINT)
    interruption.end()
    assert interruption.take() == signal.SIGINT


def test_other_signals_exit_with_their_code() -> None:
    with Interruption() as interruption:
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(SystemExit) as raised, interruption.let_through():
            pass
    assert raised.value.code == 128 + signal.SIGTERM


def test_what_never_kept_lets_through_and_keeps_nothing() -> None:
    interruption = Interruption()
    with interruption.let_through():
        pass
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
