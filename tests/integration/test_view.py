"""What people see of a running network: the panel on a terminal, lines elsewhere, the page in a browser."""

import json
import re
import signal
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from browser import CUT, FAINT, Log
from terminal import Terminal

PAGE = re.compile(r"live page at (http://127\.0\.0\.1:\d+/)")
HIDE_CURSOR, SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"


def _long(network: Any, **run: Any) -> Path:
    """Paced, so that it takes long enough to be looked at on any machine: 40 s."""
    return network.file(run={"pace": "realtime", "speed": 2, "duration": 80} | run)


def _bottom(screen: Terminal) -> int:
    """Width of the newest panel."""
    return max(map(len, re.findall(r"╰─*╯", screen.text)[-1:]), default=0)


def _plain(text: str) -> str:
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)


def test_panel_and_ctrl_c(network: Any, terminal: Any) -> None:
    """Graph, steps and errors; smaller windows get less; Ctrl-C ends the run in order and leaves the terminal tidy."""
    screen = terminal("msg-agents", "run", _long(network, processes=2), "--out", network.directory / "runs")
    screen.wait_for("starting")
    screen.wait_for("predicted 1.", seconds=60)
    screen.read(0.5)
    seen = _plain(screen.text)
    assert re.search(r"step \d+ of 1600 +\d+ % +\d+ steps/s", seen)
    assert re.search(r"graph (line|ring) +for [\d.e-]+ units of time", seen)
    assert re.search(r"│ +5 +\d+ +\d+ +[\d.]+ +- +[\d.]+", seen)
    screen.resize(40, 10)
    network.wait_for(lambda: screen.read(0.1) and _bottom(screen) == 40, 5, "a narrow panel")
    screen.type(b"\x03")
    assert screen.read_to_the_end() == 3
    assert "stopped by Ctrl-C at step " in _plain(screen.text)
    assert "Traceback" not in screen.text
    assert screen.text.rindex(SHOW_CURSOR) > screen.text.rindex(HIDE_CURSOR)
    assert screen.mode() == screen.before


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """In a window of its own."""
    with browser.new_context() as window:
        yield window.new_page()


def _address(process: subprocess.Popen[str]) -> str:
    for line in process.stderr:
        if found := PAGE.search(line):
            return found[1]
    raise AssertionError("no page")


def _follow(page: Any, address: str) -> Log:
    log = Log(page)
    page.goto(address)
    page.wait_for_selector("#chart polyline", state="attached")
    return log


def test_page_of_a_run(network: Any, terminal: Any, page: Any) -> None:
    """Steps, graph, states and errors come in; the end is told, with the verdict and the numbers of the comparison."""
    # The panel goes to stderr, a terminal: stdout, which is elsewhere, is one object.
    file, out = network.file(run={"processes": 2}), network.directory / "result"
    options = ("--out", network.directory / "runs", "--json", "--web", "0")
    log = Log(page)
    with ThreadPoolExecutor() as reader:
        screen = terminal("msg-agents", "run", file, *options, stdout=out)
        address = network.wait_for(lambda: (screen.read(0.1), PAGE.search(screen.text))[1], 60, "the page")[1]
        reading = reader.submit(screen.read_to_the_end)  # a full terminal would hold up the run
        page.goto(address)
        page.wait_for_selector("body[data-over=yes]")
        code = reading.result()
    assert log.complaints == []
    assert set(log.requests) == {address, f"{address}events", f"{address}report"}
    result = json.loads(out.read_text())
    assert result["steps"] == 300
    said = _plain(screen.text)
    assert "net: 5 agents, lockstep" in said
    assert re.search(r"note: ROS_DOMAIN_ID (\d+): to watch the run, msg-agents live --domain \1\b", said)
    assert "verdict" not in said
    assert "Traceback" not in said
    assert {0: "agrees", 1: "disagrees"}[code] == page.get_attribute("#state", "class")
    assert "The run has ended" in page.inner_text("#state")
    assert page.inner_text("#step") == "300 of 300"
    assert page.inner_text("#graph") in ("line", "ring")
    assert page.locator("#network line.active").count() in (4, 5)
    assert page.locator("#agents tr").count() == 5
    # The page has kept the report, although nothing is served any more.
    with page.context.expect_page() as opened:
        page.click("#report-link")
    shown = Log(opened.value)
    opened.value.wait_for_load_state()
    assert "net" in opened.value.title()
    assert shown.complaints == []
    assert page.inner_text("#report-path") == result["report"]
    error = result["system_error"]
    assert float(page.inner_text("#measured")) == pytest.approx(error["measured"], rel=1e-3)
    assert float(page.inner_text("#predicted")) == pytest.approx(error["predicted"], rel=1e-3)


def test_page_of_a_run_in_time(network: Any, page: Any) -> None:
    """While it goes on, on a phone: the active graph and the numbers change; another browser closes, nothing stops."""
    # A stopped agent turns grey and its silence is told; a killed one is an event, and its return.
    page.set_viewport_size({"width": 390, "height": 800})
    run = network.start("run", _long(network), "--out", network.directory / "runs", "--web", "0")
    log = _follow(page, address := _address(run))
    other = page.context.browser.new_page()
    _follow(other, address)
    other.close()
    step = int(page.inner_text("#step").split()[0])
    page.locator("#step", has_text=re.compile(rf"^(?!{step} of)\d+ of 1600")).wait_for()
    assert page.inner_text("#state") == "running"
    fills = page.evaluate("[...document.querySelectorAll('#network circle')].map((one) => one.getAttribute('fill'))")
    assert len(fills) == 5
    assert len(set(fills)) > 1

    assert page.locator("#agents tr.away").count() == 0
    assert re.fullmatch(r"[\d.]+ ms", page.locator("#late", has_text="ms").inner_text())
    (second,) = (each for each in network.processes() if "--agent" in each.command and each.agent == 2)
    second.kill(signal.SIGSTOP)
    page.wait_for_selector("#network .ball.away")
    assert re.fullmatch(r"[\d.]+ s ago", page.locator("#agents tr").nth(1).locator("td.fresh").inner_text())
    second.kill(signal.SIGCONT)
    page.wait_for_selector("#network .ball.away", state="detached")
    second.kill()
    page.locator("#events li", has_text="agent_2: killed by SIGKILL").wait_for()
    page.locator("#events li", has_text="agent 2 is back").wait_for()
    assert page.locator("#trace .trace").count() >= 5
    page.get_by_role("button", name="agent 2").press("Enter")
    page.locator("#agent-keys [aria-pressed=false]").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        assert page.evaluate(CUT) == []
        assert page.evaluate(FAINT) == []

    run.send_signal(signal.SIGINT)
    page.wait_for_selector("body[data-over=yes]")
    assert "stopped by Ctrl-C at step " in page.inner_text("#state")
    assert log.complaints == []
    run.communicate(timeout=60)
    assert run.returncode == 3


def test_page_of_a_replay(network: Any, domain: int, twin_bag: Path, page: Any) -> None:
    live = network.start("live", "--web", "0", "--json", "--reliable", "--timeout", "60")
    address = _address(live)
    play = network.start("play", twin_bag, "--rate", "5", "--await", "live")
    log = _follow(page, address)
    page.wait_for_selector("body[data-over=yes]")
    assert log.complaints == []
    stdout, _ = live.communicate(timeout=60)
    play.communicate(timeout=60)
    assert (live.returncode, play.returncode) == (0, 0)
    assert page.inner_text("#step") == "300 of 300"
    measured = json.loads(stdout)["system_error"]["measured"]
    assert float(page.inner_text("#measured")) == pytest.approx(measured, rel=1e-3)
