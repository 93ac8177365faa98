# SPDX-FileCopyrightText: 2026 msg_agents contributors
# SPDX-License-Identifier: Apache-2.0

"""A small page on which browsers follow a run: one HTML file, and server-sent events.

A slow or lost browser delays nothing; it misses what it is too slow for. Connections are few, and a request must arrive
soon: nothing that a browser does may take the file descriptors of the run.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
import socket
import threading
import time
from collections import deque
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any, Self

from msg_analysis.common.text import finite
from msg_analysis.errors import InputError

MOST_BROWSERS = 32  # that follow the run; one more takes the place of the one that has followed longest
MOST_CONNECTIONS = 64
REQUEST_TIME = 5.0  # s for a request to arrive
HISTORY = 600  # points of the running error that a browser gets when it connects
SEND_TIMEOUT = 10.0  # s for a browser to take what it is sent
ALIVE = 5.0  # s after which a comment is sent if there is nothing new, to detect lost browsers
HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^:@/\[\]]+)(?::\d+)?")  # of a Host header: name, port
SHUTDOWN_TIMEOUT = 1.5  # s for sending the end to the browsers
REPORT_TIME = 5.0  # s for them to fetch the report after that
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data: blob:; font-src data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",  # images and fonts are those of the report
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class WebServer:
    """Serves the page at ``address`` until ``close``; its methods may be called from any thread."""

    def __init__(self, host: str, port: int, *, request_timeout: float = REQUEST_TIME) -> None:
        self._changed = threading.Condition()
        self._number = 0  # of the newest change
        self._setting: dict[str, Any] | None = None
        self._moment: dict[str, Any] | None = None
        self._trace: Mapping[str, Any] | None = None  # the newest states
        self._trace_sent, self._traces = "", 0  # the same as text, and how many there have been
        self._ending: dict[str, Any] | None = None
        self._history: deque[list[float | None]] = deque(maxlen=HISTORY)
        self._browsers: dict[_Handler, None] = {}  # in the order in which they came
        self.report: bytes | None = None  # browsers keep it, so that it can be opened when nothing is served any more
        self._fetching = 0  # browsers that have been sent the end and have not fetched it
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._server = _Server(self, host, port, family, request_timeout)
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(
                f"--web: cannot serve at {host}, port {port} ({reason}): give another port (--web 0: any "
                "free one), or another --web-host"
            ) from error
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), name="web", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def begin(self, setting: dict[str, Any]) -> None:
        """Show a run, given by ``snapshot.run_description``."""
        with self._changed:
            self._setting = finite(setting)
            self._notify()

    def show(self, moment: dict[str, Any]) -> None:
        """Show the current state of the run, given by ``snapshot.snapshot_document``."""
        system = moment["system"] or {}
        with self._changed:
            trace = moment.get("trace")
            if trace is not None and trace is not self._trace:  # of many numbers: once, while they stay the same
                self._trace, self._trace_sent, self._traces = trace, json.dumps(finite(trace)), self._traces + 1
            self._moment = finite({key: value for key, value in moment.items() if key != "trace"})
            if system.get("measured") is not None and (
                not self._history or self._history[-1][0] != moment["errors_step"]
            ):
                keys = ("measured", "predicted", "standard_error")
                self._history.append(finite([moment["errors_step"], *(system[key] for key in keys)]))
            self._notify()

    def end(self, words: dict[str, Any], report: Path | None = None) -> None:
        """Show that the run is over (first call only): ``words`` are "text", and "verdict" or None."""
        content = None
        with contextlib.suppress(OSError):
            content = report.read_bytes() if report is not None else None
        with self._changed:
            if self._ending is None:
                self.report = content
                self._ending = finite({**words, "report": str(report) if content is not None else None})
            self._notify()

    def report_fetched(self) -> None:
        """A browser has fetched the report, or will not."""
        with self._changed:
            self._fetching -= 1
            self._changed.notify_all()

    def close(self) -> None:
        """Show the browsers that the run is over, give them the report, and stop serving; a few seconds at most."""
        self.end({"text": "The run has ended.", "verdict": None})
        deadline = time.monotonic() + SHUTDOWN_TIMEOUT
        with self._changed:
            while self._browsers and (left := deadline - time.monotonic()) > 0:
                self._changed.wait(left)
            deadline = time.monotonic() + REPORT_TIME
            while self._fetching > 0 and (left := deadline - time.monotonic()) > 0:
                self._changed.wait(left)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _notify(self) -> None:
        self._number += 1
        self._changed.notify_all()

    def follow(self, handler: _Handler) -> None:
        """Send one browser what is newest until the end or until it has gone; runs in that browser's thread."""
        with self._changed:
            if len(self._browsers) >= MOST_BROWSERS:
                # It may be one that never reads; a browser comes back by itself.
                longest = next(iter(self._browsers))
                del self._browsers[longest]
                _hang_up(longest.connection)
            self._browsers[handler] = None
        try:
            handler.start_events()
            sent_events, number = dict[str, int](), -1
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._number != number, ALIVE)  # noqa: B023  called here and now
                    number = self._number
                    events = self._events(sent_events)
                sent = handler.send_events(events)
                if sent and "end" in sent_events and self.report is not None:
                    with self._changed:
                        self._fetching += 1
                if not sent or "end" in sent_events:
                    return
        finally:
            with self._changed:
                self._browsers.pop(handler, None)
                self._changed.notify_all()

    def _events(self, sent: dict[str, int]) -> list[tuple[str, str]]:
        """What a browser has not been sent, as JSON; ``sent``: the numbers of what it has."""
        events: list[tuple[str, str]] = []
        if self._setting is not None and "setting" not in sent:
            sent["setting"] = 1
            events += [("setting", json.dumps(self._setting)), ("history", json.dumps(list(self._history)))]
        if self._moment is not None and "setting" in sent:
            if self._traces != sent.get("trace", 0):
                sent["trace"] = self._traces
                events.append(("trace", self._trace_sent))
            events.append(("moment", json.dumps(self._moment)))
        if self._ending is not None:
            sent["end"] = 1
            events.append(("end", json.dumps(self._ending)))
        return events


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    request_queue_size = 64

    def __init__(
        self, web: WebServer, host: str, port: int, family: socket.AddressFamily, request_timeout: float
    ) -> None:
        self.address_family, self._request_timeout = family, request_timeout
        self.web = web
        self.page = _whole_page()
        self.names: set[str] | None = None  # allowed in the Host header; None: any
        # When they were made [s]; None once their request has arrived
        self._connections: dict[socket.socket, float | None] = {}
        self._lock = threading.Lock()
        super().__init__((host, port), _Handler)
        address = ipaddress.ip_address(str(self.server_address[0]))
        if address.is_loopback:
            self.names = {"localhost", "127.0.0.1", "[::1]", host.lower()}

    def server_bind(self) -> None:
        """Bind without a look-up of our own name, which may take long or need a network."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread of its own, unless there are too many."""
        with self._lock:
            room = len(self._connections) < MOST_CONNECTIONS
            if room:
                self._connections[request] = time.monotonic()
        if room:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._connections.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """End connections whose request does not arrive; called several times a second."""
        latest = time.monotonic() - self._request_timeout
        with self._lock:
            for connection, begun in self._connections.items():
                if begun is not None and begun < latest:
                    _hang_up(connection)

    def has_arrived(self, connection: socket.socket) -> None:
        """Note that the request of a connection has arrived."""
        with self._lock:
            if connection in self._connections:
                self._connections[connection] = None

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that disconnect."""


def _whole_page() -> bytes:
    """The page with its style and its scripts in it."""
    pages = resources.files("msg_agents.watch") / "pages"
    shared = resources.files("msg_analysis.report") / "templates"
    page = (pages / "live.html").read_bytes()
    for file in (pages / "live.css", shared / "svg.js", pages / "live.js"):
        page = page.replace(f"{{{file.name}}}".encode(), b"\n" + file.read_bytes())
    return page


def _hang_up(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = SEND_TIMEOUT
    server_version, sys_version = "msg_agents", ""

    def do_GET(self) -> None:
        """Serve the page or the events."""
        self.server.has_arrived(self.connection)
        path = self.path.partition("?")[0]
        # DNS rebinding: a foreign page whose name has been made to point here must not read this one.
        names = [HOST.fullmatch(host) for host in self.headers.get_all("Host", [])]
        name = names[0][1].lower() if len(names) == 1 and names[0] else None
        if self.server.names is not None and name not in self.server.names:
            self.refuse(HTTPStatus.FORBIDDEN, "this page is served under the name of this machine only")
        elif path == "/":
            self._send(HTTPStatus.OK, self.server.page, "text/html; charset=utf-8")
        elif path == "/events":
            self.server.web.follow(self)
        elif path == "/report" and (report := self.server.web.report) is not None:
            try:
                self._send(HTTPStatus.OK, report, "text/html; charset=utf-8")
            finally:
                self.server.web.report_fetched()
        elif path == "/favicon.ico":
            self._send(HTTPStatus.NO_CONTENT, b"", "image/x-icon")
        else:
            self.refuse(HTTPStatus.NOT_FOUND, "not found: only /, /events and, at the end, /report are served")

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:  # noqa: ARG002
        """Answer a request that is none, or of another method."""
        self.request_version = "HTTP/1.0"  # what cannot be read counts as 0.9, whose answers have no headers
        self.refuse(HTTPStatus(code), message or HTTPStatus(code).phrase)

    def refuse(self, status: HTTPStatus, words: str) -> None:
        """Answer with an error and its reason."""
        self._send(status, f"{words}\n".encode(), "text/plain; charset=utf-8")

    def start_events(self) -> None:
        """Send the head of a stream of events."""
        self.close_connection = True
        self._head(HTTPStatus.OK, "text/event-stream; charset=utf-8")
        self.end_headers()

    def send_events(self, events: list[tuple[str, str]]) -> bool:
        """Send events, in JSON, or a comment if there are none; False if the browser did not take them."""
        text = "".join(f"event: {name}\ndata: {data}\n\n" for name, data in events) or ": still here\n\n"
        try:
            self.wfile.write(text.encode())
            self.wfile.flush()
        except OSError:  # the browser has gone, or is too slow
            return False
        return True

    def _send(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self._head(status, kind)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _head(self, status: HTTPStatus, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        for header, value in HEADERS.items():
            self.send_header(header, value)

    def log_message(self, *_: Any) -> None:
        """Log nothing: stderr is for the run."""
