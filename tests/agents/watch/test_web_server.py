"""The page for browsers: what it serves, to whom, and that nobody holds anybody up."""

import contextlib
import http.client
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner
from waiting import wait_for

from msg_agents.cli.main import main
from msg_agents.cli.watching import WebCommand, web_options
from msg_agents.watch.web_server import MOST_BROWSERS, MOST_CONNECTIONS, WebServer
from msg_analysis.errors import InputError

MOMENT = {"system": {"measured": 1.5, "predicted": 1.4, "standard_error": 0.1}, "errors_step": 7, "reached": 8}


@pytest.fixture
def web() -> Iterator[WebServer]:
    with WebServer("127.0.0.1", 0) as served:
        yield served


@pytest.fixture(scope="module")
def idle() -> Iterator[WebServer]:
    """One to which no test shows anything."""
    with WebServer("127.0.0.1", 0) as served:
        yield served


def _connection(web: WebServer) -> http.client.HTTPConnection:
    return http.client.HTTPConnection(web.address.removeprefix("http://").rstrip("/"), timeout=20)


def _get(web: WebServer, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = _connection(web)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def _dial(web: WebServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", int(web.address.rstrip("/").rpartition(":")[2])), timeout=20)


class Events:
    """Reads a stream of events."""

    def __init__(self, web: WebServer) -> None:
        self._response = _get(web, "/events")
        assert self._response.status == 200
        assert self._response.getheader("Content-Type", "").startswith("text/event-stream")

    def next(self) -> tuple[str, Any] | None:
        """The next one; None at the end."""
        name = ""
        while line := self._response.readline().decode():
            if line.startswith("event: "):
                name = line.removeprefix("event: ").strip()
            elif line.startswith("data: "):
                return name, json.loads(line.removeprefix("data: "))
        return None

    def until(self, name: str) -> list[tuple[str, Any]]:
        """Those up to the next one of this name; to the last one, if there is none."""
        found: list[tuple[str, Any]] = []
        while (event := self.next()) is not None:
            found.append(event)
            if event[0] == name:
                break
        return found


def test_page(idle: WebServer) -> None:
    page = _get(idle, "/")
    text = page.read().decode()
    assert page.status == 200
    assert "default-src 'none'" in page.getheader("Content-Security-Policy", "")
    assert "<!DOCTYPE html>" in text
    for outside in ("http://", "https://", "//cdn"):
        assert outside not in text.replace("http://www.w3.org/2000/svg", "")
    assert _get(idle, "/etc/passwd").status == 404
    assert _get(idle, "/../setup.py").status == 404


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost:1", 200),
        ("127.0.0.1", 200),
        ("[::1]:80", 200),
        ("evil.example", 403),
        ("127.0.0.1.evil.example:80", 403),
        ("", 403),
        ("localhost:8421@evil.example", 403),
        ("user@localhost", 403),
        ("localhost:", 403),
    ],
)
def test_only_under_our_own_name(idle: WebServer, host: str, status: int) -> None:
    """A page from elsewhere whose name points here all of a sudden (DNS rebinding) gets nothing."""
    assert _get(idle, "/", Host=host).status == status


def test_states_are_sent_when_there_are_new_ones(web: WebServer) -> None:
    """Before the moment of which they are the newest; a browser that comes late gets them, too."""
    early = Events(web)
    web.begin({"name": "net"})
    trace, newer = {"steps": [1], "agents": [[0.5, float("inf")]]}, {"steps": [1, 2], "agents": [[0.5, 1.0]]}
    moments = [MOMENT | {"reached": number, "trace": each} for number, each in enumerate((trace, trace, newer, newer))]
    found = [early.next(), early.next()]
    for moment in moments:
        web.show(moment)
        *others, event = early.until("moment")
        found += others
        assert event == ("moment", {key: value for key, value in moment.items() if key != "trace"})
    assert found[2:] == [("trace", {"steps": [1], "agents": [[0.5, None]]}), ("trace", newer)]
    late = Events(web)
    assert [late.next() for _ in range(4)][2] == ("trace", newer)


def test_events(web: WebServer) -> None:
    """Who comes early waits; who comes late gets what was, with the history."""
    early = Events(web)
    web.begin({"name": "net", "agents": 2})
    assert early.next() == ("setting", {"name": "net", "agents": 2})
    assert early.next() == ("history", [])
    web.show(MOMENT | {"z": float("nan")})
    assert early.next() == ("moment", MOMENT | {"z": None})
    late = Events(web)
    assert late.next() == ("setting", {"name": "net", "agents": 2})
    assert late.next() == ("history", [[7, 1.5, 1.4, 0.1]])
    assert late.next() == ("moment", MOMENT | {"z": None})
    web.end({"text": "over", "verdict": "agrees"})
    web.end({"text": "over again", "verdict": None})
    for events in (early, late):
        assert events.until("none")[-1] == ("end", {"text": "over", "verdict": "agrees", "report": None})


def test_the_report_is_there_until_the_browsers_have_it(tmp_path: Path) -> None:
    """They fetch it when they are told of the end; the server waits for them."""
    report = tmp_path / "report.html"
    report.write_text("<p>all is well</p>")
    with WebServer("127.0.0.1", 0) as served:
        assert _get(served, "/report").status == 404
        browser = Events(served)
        served.begin({"name": "net"})
        assert browser.next() is not None
        served.end({"text": "over", "verdict": "agrees"}, report)
        closing = threading.Thread(target=served.close)
        closing.start()
        assert browser.until("end")[-1] == ("end", {"text": "over", "verdict": "agrees", "report": str(report)})
        assert browser.next() is None
        assert closing.is_alive()
        answer = _get(served, "/report")
        assert (answer.status, answer.read()) == (200, b"<p>all is well</p>")
        closing.join()


def test_who_is_slow_or_goes_holds_nobody_up(web: WebServer) -> None:
    """Moments larger than what a connection buffers: all are taken while one browser has stopped reading."""
    # It misses those that came meanwhile. Another browser goes at once, and one reads.
    web.begin({"name": "net"})
    slow = _dial(web)
    slow.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
    gone = _connection(web)
    gone.request("GET", "/events")
    gone.close()
    reader = Events(web)
    large = {"text": "x" * 16_000_000}
    web.show(MOMENT | {"reached": 0} | large)
    stream = slow.makefile("rb")
    while b'"reached": 0' not in stream.peek(1):
        stream.read(1)  # the rest of this moment stays where it is
    for step in range(1, 6):
        web.show(MOMENT | {"reached": step} | large)
    reached = [-1]
    while reached[-1] < 5:
        reached.append(reader.until("moment")[-1][1]["reached"])
    assert reached == sorted(reached)
    web.end({"text": "over", "verdict": None})
    reader.until("end")
    assert re.findall(rb'"reached": (\d+)', stream.read()) == [b"0", b"5"]
    slow.close()


def test_not_too_many(web: WebServer) -> None:
    web.begin({"name": "net"})
    streams = [Events(web) for _ in range(MOST_BROWSERS)]
    assert all(stream.next() for stream in streams)
    one_more = Events(web)
    assert one_more.next() == ("setting", {"name": "net"})
    streams[0].until("none")  # the first one has made room; a browser would come back
    web.show(MOMENT)
    for stream in (streams[1], streams[-1], one_more):
        assert stream.until("moment")[-1] == ("moment", MOMENT)
    assert _get(web, "/").status == 200


def test_two_names(idle: WebServer) -> None:
    connection = _connection(idle)
    connection.putrequest("GET", "/", skip_host=True)
    connection.putheader("Host", "localhost")
    connection.putheader("Host", "evil.example")
    connection.endheaders()
    assert connection.getresponse().status == 403


@pytest.mark.parametrize("request_line", [b"POST / HTTP/1.1", b"GET", b"GET / HTTP/9.9", b"\xff\xfe"])
def test_errors_have_the_headers_of_the_page(idle: WebServer, request_line: bytes) -> None:
    with _dial(idle) as browser:
        browser.sendall(request_line + b"\r\nHost: localhost\r\n\r\n")
        answer = browser.makefile("rb").read()
    assert re.match(rb"HTTP/1.0 (400|501|505) ", answer)
    assert b"Content-Security-Policy: default-src 'none'" in answer
    assert b"text/plain" in answer


@pytest.fixture
def strict() -> Iterator[WebServer]:
    with WebServer("127.0.0.1", 0, request_timeout=0.5) as served:
        yield served


def test_dripping_requests(strict: WebServer) -> None:
    """Twice as many as there may be, which send a byte now and then: few stay open, and not for long."""
    web = strict
    before = len(list(Path("/proc/self/fd").iterdir()))
    dripping = [_dial(web) for _ in range(2 * MOST_CONNECTIONS)]
    for _ in range(3):
        for browser in dripping:
            with contextlib.suppress(OSError):
                browser.sendall(b"G")
        time.sleep(0.1)
    of_the_server = len(list(Path("/proc/self/fd").iterdir())) - before - len(dripping)
    assert of_the_server <= MOST_CONNECTIONS
    wait_for(lambda: _answers(web), 10)
    for browser in dripping:
        browser.settimeout(10)
        with contextlib.suppress(ConnectionResetError):
            assert browser.recv(1) == b""  # closed
        browser.close()


def _answers(web: WebServer) -> bool:
    try:
        return _get(web, "/").status == 200
    except (OSError, http.client.HTTPException):
        return False


def test_the_end_reaches_who_watches() -> None:
    with WebServer("localhost", 0) as web:
        events = Events(web)
        web.begin({"name": "net"})
        assert events.next() is not None
    assert events.until("none")[-1][0] == "end"


def test_a_taken_port_ends_the_command_before_anything_starts(idle: WebServer, tmp_path: Any) -> None:
    """So does a host that is none."""
    with pytest.raises(InputError, match="cannot serve at nosuchhost"):
        WebServer("nosuchhost.invalid", 0)
    experiment = tmp_path / "net.yaml"
    experiment.write_text("name: net\ngraphs: {line: {path: [1, 2, 3]}}\nrun: {duration: 5}\n")
    port = idle.address.rstrip("/").rpartition(":")[2]
    for command in (["run", str(experiment), "--out", str(tmp_path / "runs")], ["live", "--timeout", "1"]):
        result = CliRunner().invoke(main, [*command, "--web", port])
        assert result.exit_code == 2, result.output
        words = f"--web: cannot serve at 127.0.0.1, port {port} .*in use.*another port"
        assert re.search(words, result.stderr)
        assert "Traceback" not in result.output
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ([], (None, ())),
        (["--web"], (8421, ())),
        (["--web", "file"], (8421, ("file",))),
        (["--web", "0", "file"], (0, ("file",))),
        (["file", "--web=9000"], (9000, ("file",))),
    ],
)
def test_the_port_may_be_left_out(arguments: list[str], found: Any) -> None:
    seen = []

    @click.command(cls=WebCommand)
    @click.argument("files", nargs=-1)
    @web_options
    def command(files: tuple[str, ...], web: int | None, web_host: str) -> None:
        seen.append((web, files))

    assert CliRunner().invoke(command, arguments).exit_code == 0
    assert seen == [found]
    assert CliRunner().invoke(command, ["--web=70000"]).exit_code == 2
