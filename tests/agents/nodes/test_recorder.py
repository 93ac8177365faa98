"""The recorder node, given its messages by hand."""

import platform
import subprocess
import sys
import time
from array import array
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from networks import experiment

pytest.importorskip("rclpy")

import rclpy

from msg_agents.discovery.rtps import free_domain
from msg_agents.environment import node_environment
from msg_agents.nodes.recorder import Recorder, write_size
from msg_agents.stepping.state_receiver import ReceivedSteps, StateReceiver
from msg_agents.stepping.synchronizer import RESEND_LIMIT
from msg_analysis.messages.acceptance import Refusal, graph_message
from msg_analysis.messages.cdr import encode_batch
from msg_analysis.messages.messages import StateCodec
from msg_analysis.model.graph_path import HoldingPeriod
from msg_analysis.twin.simulate import new_record

pytestmark = pytest.mark.filterwarnings("ignore:module .sre_:DeprecationWarning")  # of a package that rclpy imports
AGENTS, DT = 2, 0.05
STEPS = 3 * RESEND_LIMIT


@pytest.fixture
def recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Recorder]:
    """A recorder that hears no other node."""
    one_graph = {"graphs": {"line": {"path": [1, 2]}}, "switching": {"generator": [[0]]}}
    what = experiment(2, **one_graph, run={"dt": DT, "duration": STEPS * DT, "start": "zero", "replicas": 1})
    with free_domain() as domain:
        for name, value in node_environment(domain).items():
            monkeypatch.setenv(name, value)
        rclpy.init()
        node = Recorder(record=new_record(what), directory=tmp_path / "bag")
        yield node
        node.finish(complete=False, deadline=time.monotonic())
        node.destroy_node()
        rclpy.shutdown()


def held(value: object) -> int:
    """Numbers and containers in a value and in what it holds, deep down: what would grow."""
    if isinstance(value, array):
        return len(value)
    if isinstance(value, ReceivedSteps | StateReceiver):
        return held(vars(value))
    if isinstance(value, dict | list | set | tuple | deque):
        return len(value) + sum(map(held, value.values() if isinstance(value, dict) else value))
    return 0


def test_memory_is_bounded_and_repeats_are_recorded_once(recorder: Recorder) -> None:
    """Marks of 2 RESEND_LIMIT steps per topic are kept, however long the run; the last RESEND_LIMIT are recognised."""
    (receive,) = (s.callback for s in recorder.subscriptions if s.topic_name == "/states")
    codecs = {f"/agent_{i}/state": StateCodec(recorder.run, i, 1, DT) for i in range(1, AGENTS + 1)}

    def send(step: int) -> None:
        messages = [codec.wrap(step, min(step, 1), step.to_bytes(8, "little")) for codec in codecs.values()]
        receive(encode_batch(recorder.run, messages))

    most = 0
    for step in range(STEPS):
        send(step)
        if step % 500 == 499:
            most = max(most, held(vars(recorder)))
    marks = 2 * AGENTS * RESEND_LIMIT
    # Batches that are not yet written, at most.
    waiting = write_size(AGENTS) // len(encode_batch(recorder.run, [bytes(76)]))
    assert marks <= most <= marks + waiting + 1000
    newest = STEPS - 1
    for step in range(newest - RESEND_LIMIT + 1, newest + 1):
        send(step)
    send(newest - 2 * RESEND_LIMIT)
    send(STEPS)
    recorder.finish(complete=False, deadline=time.monotonic())
    assert recorder.bag.messages == AGENTS * (STEPS + 1)
    assert recorder.repeated == AGENTS * RESEND_LIMIT
    assert recorder.refused == {(topic, Refusal.TOO_OLD): 1 for topic in codecs}
    assert held(vars(recorder)) <= marks + 1000


def test_sojourns_are_recorded_once(recorder: Recorder) -> None:
    """Of the record's path only; however often, and whatever else comes."""
    (receive,) = (s.callback for s in recorder.subscriptions if s.topic_name == "/graph")
    holding = HoldingPeriod(0, 0, 0, STEPS - 1)
    true = graph_message(recorder.record, holding)
    for forged in (replace(true, mode=0), replace(true, last_step=10**9), replace(true, sequence=5)):
        receive(forged.encode())
    for _ in range(3):
        receive(true.encode())
    assert recorder.bag.messages == 1
    assert recorder.repeated == 2
    assert recorder.refused.total() == 3


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="this machine: another C library")
def test_freed_memory_is_kept() -> None:
    """The system is not asked again for the memory of eight arrays of 1 MB, made and freed 20 times: 2,048 pages."""
    code = """
import resource
import numpy as np
from msg_agents.nodes.recorder import keep_freed_memory
keep_freed_memory()
[np.ones(2**17) for _ in range(8)]
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    [np.ones(2**17) for _ in range(8)]
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(shown.stdout) < 2048
