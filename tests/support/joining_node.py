"""A node outside a network that looks who reads its topics."""

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from started_processes import started_processes

from msg_agents.environment import node_environment

Endpoints = Mapping[str, Sequence[Sequence[str]]]


def assert_endpoints(readers: Endpoints, writers: Endpoints, domain: int) -> None:
    """Within 20 s, these topics have exactly these readers and writers: node and reliability of each, sorted."""
    with watched_endpoints(readers, writers, domain):
        pass


@contextmanager
def watched_endpoints(readers: Endpoints, writers: Endpoints, domain: int) -> Iterator[None]:
    """The same of a network that is started meanwhile: the joining node is there before it, so the run may be short."""
    wanted = json.dumps([readers, writers])
    command = [sys.executable, "-P", "-c", JOINING, wanted]
    with started_processes() as started:
        started.append(
            joining := subprocess.Popen(
                command, env=node_environment(domain), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
        )
        assert joining.stdout.readline() == "ready\n"
        yield
        found = json.loads(joining.stdout.readline())
        assert found == json.loads(wanted), (found, joining.stderr.read())


def assert_delivery(heard: str, hearers: Sequence[int], domain: int) -> None:
    """In a network of five, these agents hear agent 1 so; its writer is reliable, as other readers may want it."""
    readers = {
        "/agent_1/state": [[f"agent_{i}", heard] for i in hearers],
        "/states": [["recorder", "RELIABLE"]],
        "/graph": [*([f"agent_{i}", "RELIABLE"] for i in range(1, 6)), ["recorder", "RELIABLE"]],
    }
    assert_endpoints(readers, {"/agent_1/state": [["agent_1", "RELIABLE"]]}, domain)


JOINING = """
import json, sys, time, rclpy
wanted, found = json.loads(sys.argv[1]), []
rclpy.init()
node = rclpy.create_node("joining")
print("ready", flush=True)
end = time.monotonic() + 20
looks = node.get_subscriptions_info_by_topic, node.get_publishers_info_by_topic
while found != wanted and time.monotonic() < end:
    time.sleep(0.1)
    found = [
        {topic: sorted([e.node_name, e.qos_profile.reliability.name] for e in look(topic)) for topic in topics}
        for look, topics in zip(looks, wanted)
    ]
print(json.dumps(found))
"""
