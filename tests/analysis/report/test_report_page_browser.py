"""The report in a browser: no complaint, no request, figures that answer, and all of it on paper."""

import base64
import dataclasses
import functools
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CUT, FAINT, Log, Tab
from PIL import Image

from experiments import Completeness, Experiment, Run, claimed, compare, document, late, simulate
from msg_analysis.inference.pool import compare_pooled
from msg_analysis.report.page import write_report
from msg_analysis.report.plot_style import DARK, GRAPHS

# Not stationary: a run of 100 agents from their stationary law has a long past to be simulated.
HUNDRED: dict[str, Any] = {"duration": 35, "replicas": 16, "start": "zero"}
LONG: dict[str, Any] = {"duration": 200, "replicas": 16, "start": "zero"}
KILLED: dict[str, Any] = {"kind": "killed", "step": 1800, "node": "agent_2", "words": "agent_2: killed"}


def _document(agents: int, **run: Any) -> dict[str, Any]:
    numbers = list(range(1, agents + 1))
    graphs = {"line": {"path": numbers}, "ring $$x$$": {"cycle": numbers}}
    return document(agents, 0.5, name="seen", graphs=graphs, run={"seed": 7} | run)


def _trajectory(agents: int, **run: Any) -> Run:
    return simulate(Experiment.parse(_document(agents, **run)))


def _open(tab: Tab, path: Path) -> tuple[Any, Log]:
    page, log = tab.open(path.as_uri(), width=1000)
    page.wait_for_selector("body[data-ready=yes]")
    return page, log


def _draw_all(page: Any) -> None:
    """Also the figures that are not near the visible part of the page."""
    page.evaluate("window.drawAll()")
    page.wait_for_selector("body[data-ready=yes]")


def _check(page: Any, log: Log, path: Path) -> None:
    assert log.complaints == []
    assert log.requests == [path.as_uri()]
    _draw_all(page)
    assert page.locator(".figure:empty").count() == 0
    # Every figure has been drawn: not all of its pixels are white.
    blank = page.evaluate(
        """() => [...window.Bokeh.index.roots].filter((view) => view.el.closest(".plot")).filter((view) => {
            const canvas = view.export("png", false).canvas;
            const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
            return !data.some((value, place) => place % 4 < 3 && value < 128 && data[place | 3] > 0);
        }).length"""
    )
    assert blank == 0
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[Path, Run]]:
    """The report of a run, and the run, by the number of agents and the settings of the run."""

    @functools.cache
    def made(agents: int, **run: Any) -> tuple[Path, Run]:
        path, trajectory = tmp_path_factory.mktemp("reports") / "report.html", _trajectory(agents, **run)
        events = [KILLED] if len(trajectory.modes) > KILLED["step"] else []
        write_report(compare(trajectory), path, events=events)
        return path, trajectory

    return made


@pytest.mark.parametrize("agents", [5, 100])
def test_small_and_large(tab: Tab, reports: Callable[..., tuple[Path, Run]], agents: int) -> None:
    """Figures are drawn when near, on paper all are; hover shows values; agents are chosen by numbers and a click."""
    path, _ = reports(agents, **({} if agents == 5 else HUNDRED))
    assert path.stat().st_size < 3_000_000
    page, log = _open(tab, path)
    figures, drawn = page.locator(".figure").count(), page.locator(".figure:not(:empty)").count()
    assert 4 <= drawn < figures - 4
    page.locator("#innovations").scroll_into_view_if_needed()
    page.locator("[aria-label^='Variance of the residuals'] .figure:not(:empty)").wait_for()
    assert page.locator(".figure:empty").count() > 0

    rows = page.locator("#node-table tbody tr:visible")
    page.fill("#agents", "2, 4-5")
    assert rows.count() == 3
    assert page.evaluate("Bokeh.documents[0].get_model_by_name('lines').data.agent") == [
        "agent 2",
        "agent 4",
        "agent 5",
    ]
    assert page.evaluate("Bokeh.documents[0].get_model_by_name('bands').data.xs.length") == 3
    page.fill("#agents", f"{agents + 1}")
    assert f"expected numbers from 1 to {agents}" in page.inner_text("#chosen")
    page.click("#all-agents")
    assert rows.count() == agents

    # The point of an agent, where the figure has it on the screen.
    x, y = page.evaluate(
        """() => {
            const view = [...Bokeh.index.roots].find((view) => view.model.renderers?.some(
                (one) => one.data_source.name == "nodes" && one.glyph.type == "Scatter"));
            view.el.scrollIntoView({block: "center"});
            const data = Bokeh.documents[0].get_model_by_name("nodes").data;
            const at = view.canvas_view.el.getBoundingClientRect();
            const {x_scale, y_scale} = view.frame;
            return [at.x + x_scale.compute(data.agent[2]), at.y + y_scale.compute(data.measured[2])];
        }"""
    )
    page.mouse.move(x, y)
    page.locator(".bk-Tooltip", has_text=re.compile(r"agent:?\s*3.*z:?\s*[+\-−]\d", re.DOTALL)).first.wait_for()
    page.mouse.click(x, y)
    page.locator("#chosen", has_text=f"1 of {agents} agents").wait_for()
    assert rows.count() == 1
    assert page.input_value("#agents") == "3"
    page.click("#all-agents")

    page.locator("details").last.evaluate("one => one.open = false")
    page.evaluate(
        """() => window.addEventListener("beforeprint", () => {
            window.pictured = document.querySelectorAll(".plot.pictured img").length;
        })"""
    )
    paper = page.pdf(format="A4")
    assert paper.startswith(b"%PDF")
    assert paper.count(b"/Subtype /Image") >= 5
    assert page.locator(".plot.pictured").count() == 0  # as before
    assert page.locator("details[open]").count() == 1
    assert page.evaluate("window.pictured") == figures
    page.emulate_media(media="print")
    sizes = page.evaluate(
        """() => ["p", "td", "figcaption", ".facts dd"].map(
            (one) => 0.75 * parseFloat(getComputedStyle(document.querySelector(`main ${one}, ${one}`)).fontSize))"""
    )  # [pt]
    assert all(8.0 <= size <= 10.0 for size in sizes), sizes
    assert page.evaluate("getComputedStyle(document.querySelector('.bar i')).printColorAdjust") == "exact"
    page.emulate_media(media="screen")
    _check(page, log, path)


def test_agents_by_name(tab: Tab, tmp_path: Path) -> None:
    """Both fields take names and numbers, and the figures show names, whatever is in them."""
    names = ["Bad Ems", "<b>Ulm</b>", "$$x$$", "Kiel", "1"]
    trajectory = simulate(Experiment.parse(_document(5) | {"names": names}))
    path = tmp_path / "report.html"
    write_report(compare(trajectory), path)
    page, log = _open(tab, path)
    _check(page, log, path)
    page.fill("#agents", "Kiel, Bad Ems ,3; 1")
    assert page.locator("#node-table tbody tr:visible td:first-child").all_inner_texts() == [
        *("Bad Ems", "$$x$$", "Kiel", "1")
    ]
    chosen = "Bokeh.documents[0].get_model_by_name('lines').data.agent"
    assert page.evaluate(chosen) == ["agent Bad Ems", "agent $$x$$", "agent Kiel", "agent 1"]
    page.fill("#agents", "Bonn")
    assert "expected" in page.inner_text("#chosen")
    page.click("#all-agents")
    assert page.locator("#agent-buttons button").all_inner_texts() == names
    page.click("#agent-buttons button >> nth=3")
    assert "Kiel" not in page.input_value("#shown-agents").split(", ")
    assert page.locator("main b, svg b", has_text="Ulm").count() == 0
    assert log.complaints == []


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Any], Path]:
    """The report of a comparison and run, by the function that makes them."""

    @functools.cache
    def made(make: Any) -> Path:
        path = tmp_path_factory.mktemp("kinds") / "report.html"
        write_report(make(), path)
        return path

    return made


@pytest.fixture
def disagrees(kinds: Callable[[Any], Path]) -> Path:
    """The report of a run that disagrees."""
    return kinds(_disagreeing)


def test_screens_of_all_kinds(tab: Tab, disagrees: Path) -> None:
    """On large and small screens, light and dark, nothing is cut or faint; the keyboard reaches all controls."""
    path = disagrees
    page, log = _open(tab, path)
    _check(page, log, path)
    assert "The gain of edge 1-4 in both directions" in page.inner_text("body")
    for one in page.locator("details").all():
        one.evaluate("one => one.open = true")
    for width in (1280, 390):
        page.set_viewport_size({"width": width, "height": 900})
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            assert page.evaluate(CUT) == []
            assert page.evaluate(FAINT) == []
            _check(page, log, path)
            shown = page.evaluate("Bokeh.documents[0].get_model_by_name('graphs').data.colour[0]")
            assert shown == (GRAPHS[0] if scheme == "light" else DARK[GRAPHS[0]])
    # On paper, the colours are those for white pages.
    page.evaluate(
        """() => window.addEventListener("beforeprint", () => {
            window.printed = document.querySelector("[aria-label='Active graph over time'] img").src;
        })"""
    )
    page.pdf(format="A4")
    printed = Image.open(io.BytesIO(base64.b64decode(page.evaluate("window.printed").partition(",")[2]))).convert(
        "RGBA"
    )
    seen = {colour for _, colour in printed.getcolors(printed.width * printed.height)}
    assert (*bytes.fromhex(GRAPHS[0][1:]), 255) in seen
    assert (*bytes.fromhex(DARK[GRAPHS[0]][1:]), 255) not in seen
    assert page.evaluate("Bokeh.documents[0].get_model_by_name('graphs').data.colour[0]") == DARK[GRAPHS[0]]

    page.focus("a")
    reached = set()
    at = "((one) => one !== document.body && [one.id || one.textContent])(document.activeElement)"
    while found := page.evaluate(at):
        reached.add(*found)
        page.keyboard.press("Tab")
    controls = page.locator("a, button, input, select, summary").all()
    assert {one.get_attribute("id") or one.text_content() for one in controls} <= reached


def test_a_finger_scrolls_the_page(tab: Tab, disagrees: Path) -> None:
    """Only the frame of the overview is moved by it, until a tool is chosen."""
    with tab.phone(disagrees.as_uri()) as (page, touch):
        _finger(page, touch)


def _finger(page: Any, touch: Any) -> None:
    page.wait_for_selector("body[data-ready=yes]")
    _draw_all(page)
    actions = page.evaluate(
        """() => [...Bokeh.index.roots].filter((view) => view.canvas_view).map((view) => [
            view.model.toolbar.tools.some((tool) => tool.type == "RangeTool"),
            getComputedStyle(view.canvas_view.shadow_el.querySelector(".bk-events")).touchAction])"""
    )
    assert sorted(map(tuple, actions)) == [*[(False, "auto")] * (len(actions) - 1), (True, "pan-y")]
    for button in ("#whole", "#closer", "#closer"):
        page.click(button)
    overview = page.locator("#trajectories .plot").first
    overview.scroll_into_view_if_needed()
    box = overview.bounding_box()
    y, middle = box["y"] + 20, box["x"] + 76 + (box["width"] - 90) / 2
    before = page.evaluate("Bokeh.documents[0].get_model_by_name('time').start")
    for kind, shift in (("touchStart", 0), ("touchMove", 10), ("touchMove", 30), ("touchMove", 50), ("touchEnd", 50)):
        points = [] if kind == "touchEnd" else [{"x": middle + shift, "y": y}]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    after = page.evaluate("Bokeh.documents[0].get_model_by_name('time').start")
    assert after > before
    assert page.evaluate("document.documentElement.scrollWidth <= 390")


def test_trajectories(tab: Tab, reports: Callable[..., tuple[Path, Run]]) -> None:
    """Agents are switched on and off, and every part of the run can be seen, with the keyboard alone."""
    path, trajectory = reports(5, **LONG)
    page, log = _open(tab, path)

    def drawn(name: str, column: str) -> Any:
        return page.evaluate(f"Bokeh.documents[0].get_model_by_name('{name}').data['{column}']")

    def settled(condition: str) -> None:  # not by wait_for_function, which the page does not allow
        page.evaluate(
            f"""() => new Promise((done) => {{
                const model = (name) => Bokeh.documents[0].get_model_by_name(name);
                const look = () => ({condition} ? done() : requestAnimationFrame(look));
                look();
            }})"""
        )

    assert drawn("states", "agent") == [f"agent {i}" for i in range(1, 6)]
    page.focus("#agent-buttons button:nth-child(2)")
    page.keyboard.press("Space")
    settled("model('states').data.agent.length == 4")
    assert page.input_value("#shown-agents") == "1, 3-5"
    assert page.get_attribute("#agent-buttons button:nth-child(2)", "aria-pressed") == "false"
    page.fill("#shown-agents", "2-3")
    settled("model('states').data.agent.join() == 'agent 2,agent 3'")

    # Between steps 2000 and 2100 every value is drawn, and is that of the run.
    page.fill("#from", "100")
    page.fill("#to", "105")
    page.keyboard.press("Tab")
    settled("model('time').end == 105 && model('states').data.xs[0].at(-1) < 106")
    xs, ys = np.array(drawn("states", "xs")[0]), np.array(drawn("states", "ys")[0])
    steps = np.rint(xs / 0.05).astype(int)
    assert set(range(2000, 2101)) <= set(steps.tolist())
    assert np.allclose(ys, trajectory.values[steps, 1, 0], atol=1e-5)
    lanes = {key: np.array(drawn("lanes", key)) for key in ("left", "right", "graph")}
    for left, right, graph in zip(*lanes.values(), strict=True):
        assert (trajectory.modes[round(left / 0.05) : round(right / 0.05)] == graph).all()

    # The whole run is drawn with a few points per pixel, none of which is beyond the run's.
    page.focus("#whole")
    page.keyboard.press("Enter")
    settled("model('time').end == 200 && model('states').data.xs[0][0] < 1")
    ys = np.array(drawn("states", "ys")[0])
    assert len(ys) < 2500
    assert np.isclose(ys.max(), trajectory.values[:, 1, 0].max(), atol=1e-5)
    page.focus("#deviation")
    page.keyboard.press("Space")
    settled("model('centre').data.y.join() == '0,0'")
    apart = trajectory.values[:, 1, 0] - trajectory.values[:, :, 0].mean(axis=1)
    settled(f"Math.abs(Math.max(...model('states').data.ys[0]) - {apart.max()}) < 1e-4")
    page.click("#earlier")
    page.click("#closer")
    page.click(".events button")
    settled("model('time').start < 90 && model('time').end > 90 && model('time').end < 100")
    assert drawn("events", "words") == ["agent_2: killed"]
    page.click("#show-none")
    settled("model('states').data.agent.length == 0")
    assert log.complaints == []


@pytest.mark.parametrize(("agents", "run"), [(5, LONG), (100, HUNDRED)])
def test_replicas(tab: Tab, reports: Callable[..., tuple[Path, Run]], agents: int, run: dict[str, Any]) -> None:
    """Each that has room can be chosen with the keyboard; its values are those of the run, to 16 bits of their span."""
    path, trajectory = reports(agents, **run)
    assert path.stat().st_size < 3_000_000
    page, log = _open(tab, path)
    offered = page.locator("#replica option").all_inner_texts()
    assert len(offered) == (16 if agents == 5 else 4)
    caption = page.locator("#trajectories figcaption")
    assert ("as many as have room in 1 MB" in caption.inner_text()) == (agents == 100)
    page.click("#whole")
    page.focus("#replica")
    for number in (2, 3):
        page.keyboard.press("ArrowDown")
        page.locator("#this-replica", has_text=str(number)).wait_for()
        states = trajectory.values[:, :, number - 1]
        span = float(states.max() - states.min())
        page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        drawn = page.evaluate("Bokeh.documents[0].get_model_by_name('states').data")
        for place, agent in enumerate(drawn["agent"]):
            column = states[:, int(agent.removeprefix("agent ")) - 1]
            ys = np.array(drawn["ys"][place])
            assert abs(ys.max() - column.max()) < span / 65_000
            assert abs(ys.min() - column.min()) < span / 65_000
        overview = page.evaluate("Bokeh.documents[0].get_model_by_name('overview').data")
        assert abs(max(overview["high"]) - states.max()) < span / 65_000
    width = int(re.findall(r"every (\d+) steps", caption.inner_text())[0]) if agents == 100 else 1
    assert width == -(-(len(trajectory.values)) // 306) if agents == 100 else "every" in caption.inner_text()
    assert log.complaints == []


def _in_real_time() -> Any:
    return compare(late(_trajectory(3, pace="realtime", speed=5.0), 60_000_000))


def _disagreeing() -> Any:
    said = _document(4, duration=100)
    ring = {"ring $$x$$": {"edges": [[1, 2], [2, 3], [3, 4], [1, 4, 0.3]]}}
    did = simulate(Experiment.parse(said | {"graphs": said["graphs"] | ring}))
    return compare(claimed(did, Experiment.parse(said)))


def _incomplete() -> Any:
    trajectory = _trajectory(3)
    trajectory.states[5, 1] = np.nan
    count = Completeness(expected=1203, received=1202, missing=1)
    return compare(dataclasses.replace(trajectory, completeness=count))


def _pooled() -> Any:
    return compare_pooled([(f"bag_{seed}", _trajectory(3, seed=seed)) for seed in (1, 2, 3)])


def _tracking() -> Any:
    led = {
        "name": "led",
        "problem": "tracking",
        "time": "discrete",
        "agents": 4,
        "graphs": {"</script>": {"arcs": [[1, 2], [2, 3], [3, 4], [4, 1]]}, "star": {"star": {"center": 1}}},
        "switching": {"transition": [[0.9, 0.1], [0.2, 0.8]]},
        "leaders": {"agents": [2], "gain": "inf", "reference": 3.0},
        "noise": {"process": 0.5, "loss": 0.1},
        "run": {"duration": 300},
    }
    return compare(simulate(Experiment.parse(led)))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (_in_real_time, ["age of values used", "Real time"]),
        (_incomplete, ["too early to compute"]),
        (_pooled, ["bag_2", "1, 2, 3"]),
        (_tracking, ["the leader, agent 2, is held at the reference 3", "Probabilities"]),
    ],
)
def test_every_kind(tab: Tab, kinds: Callable[[Any], Path], make: Any, words: list[str]) -> None:
    path = kinds(make)
    page, log = _open(tab, path)
    _check(page, log, path)
    text = page.inner_text("body")
    for word in words:
        assert word in text
    page.set_viewport_size({"width": 390, "height": 900})
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert page.evaluate(CUT) == []
