"""Domains: taken by a lock, given back by the system, and never where somebody's ports are."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from msg_agents.discovery import rtps
from msg_agents.discovery.rtps import PORT_BASE, PORTS_PER_DOMAIN, free_domain, held_domains
from msg_analysis.errors import InputError

HOLD = """
from msg_agents.discovery import ros_domain as domain
domain.DOMAINS = range({first}, {end})
with domain.free_domain() as held:
    print(held, flush=True)
    input()
"""


@pytest.fixture(autouse=True)
def reserved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[range]:
    """Three domains in a row that no other run takes meanwhile; for the tests, locks of our own."""
    with free_domain(3) as first:
        monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
        yield range(first, first + 3)


@contextmanager
def holder(domains: range, directory: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Another process that holds a domain."""
    code = HOLD.format(first=domains.start, end=domains.stop)
    environment = {**os.environ, "TMPDIR": str(directory)}
    command = [sys.executable, "-P", "-c", code]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        try:
            yield process, int(process.stdout.readline())
        finally:
            process.kill()


def test_holders_get_different_domains(reserved: range, monkeypatch: pytest.MonkeyPatch) -> None:
    domains = reserved[:3]
    monkeypatch.setattr(rtps, "DOMAINS", domains)
    with ExitStack() as stack:
        assert {stack.enter_context(free_domain()) for _ in domains} == set(domains)
        with pytest.raises(InputError, match="--domain"), free_domain():
            pass
    with free_domain() as again:
        assert again in domains


def test_a_killed_holder_gives_its_domain_back(
    reserved: range, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    domains = reserved[:1]
    monkeypatch.setattr(rtps, "DOMAINS", domains)
    with holder(domains, tmp_path) as (process, held):
        assert held == domains[0]
        with pytest.raises(InputError), free_domain():
            pass
        (tmp_path / "msg_agents_domain_x.lock").touch()
        assert held_domains() == [held]
        process.kill()
        process.wait()
        assert held_domains() == []
        with free_domain() as mine:
            assert mine == held


@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_a_domain_whose_ports_are_in_use_is_left_alone(
    reserved: range, monkeypatch: pytest.MonkeyPatch, family: socket.AddressFamily
) -> None:
    domains = reserved[:2]
    monkeypatch.setattr(rtps, "DOMAINS", domains)
    with socket.socket(family, socket.SOCK_DGRAM) as somebody:
        try:
            somebody.bind(("::1" if family == socket.AF_INET6 else "127.0.0.1", _port(domains[0], 11)))
        except OSError as error:
            pytest.skip(f"this machine: cannot bind: {error}")
        for _ in range(4):  # the order is random
            with free_domain() as chosen:
                assert chosen == domains[1]


def test_the_lock_is_released_when_the_run_fails(reserved: range, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtps, "DOMAINS", reserved[:1])
    for _ in range(2):
        with pytest.raises(RuntimeError, match="the run failed"), free_domain():
            raise RuntimeError("the run failed")


@pytest.mark.skipif(os.geteuid() != 0, reason="run as root: only root can be another user")
def test_lock_files_of_another_user_do_not_use_up_the_domains(
    reserved: range, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    shared = Path(tempfile.mkdtemp(dir="/tmp"))  # pytest's own directories are closed to others
    request.addfinalizer(lambda: shutil.rmtree(shared))
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(shared))
    monkeypatch.setattr(rtps, "DOMAINS", reserved[:1])
    shared.chmod(0o1777)  # as /tmp is; Linux guards files of others in such directories
    with free_domain() as held:
        pass
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.setgid(65534)
            os.setuid(65534)
            with free_domain() as chosen:
                code = 0 if chosen == held else 2
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def _port(number: int, offset: int) -> int:
    return PORT_BASE + PORTS_PER_DOMAIN * number + offset
