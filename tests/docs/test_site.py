"""The site: strict, whole, and nothing of it comes from elsewhere. ``make docs`` runs these tests."""

import contextlib
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

import pytest
from browser import CUT_OR_SCROLLED, FAINT, Log, Tab
from click.testing import CliRunner
from mkdocs.__main__ import cli
from pages import EXPERIMENTS, ROOT, blocks

SCHEMES = ("default", "slate")
READ = ("index", "examples", "commands", "theory", "api", "which_page")
"""Pages with tables, graphs, code in several languages, equations and the API."""
LOADS = {"img": "src", "script": "src", "iframe": "src", "source": "src", "link": "href"}


class Links(HTMLParser):
    """What a page links to and loads, and where it can be linked to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = {key: value or "" for key, value in attributes}
        if "id" in given:
            self.anchors.add(given["id"])
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag in LOADS and LOADS[tag] in given and given.get("rel") not in {"canonical", "prev", "next"}:
            self.loads.append(given[LOADS[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site that ``make docs`` has built, or else one built in the same way."""
    if given := os.environ.get("SITE"):
        return ROOT / given
    target = tmp_path_factory.mktemp("site")
    with contextlib.chdir(ROOT):
        built = CliRunner(env={"NO_MKDOCS_2_WARNING": "1"}).invoke(
            cli, ["build", "--strict", "--site-dir", str(target)]
        )
    assert built.exit_code == 0, built.output
    return target


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Links]:
    # The page for what is not found can only be served: its links begin at the root of the server.
    return {page: Links(page) for page in site.rglob("*.html") if page.name != "404.html"}


def test_no_link_is_broken(pages: dict[Path, Links]) -> None:
    """mkdocs looks at what is written in the pages' sources; this looks at what has become of it."""
    broken = []
    for page, found in pages.items():
        for link in found.links + found.loads:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if not target.exists():
                broken.append(f"{page.name}: {link}")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                broken.append(f"{page.name}: {link}: no such place")
    assert broken == []


def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, Links]) -> None:
    foreign = [f"{page.name}: {load}" for page, found in pages.items() for load in found.loads if "//" in load]
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        foreign += [f"{sheet.name}: {url}" for url in re.findall(r"url\([\"']?((?:https?:)?//[^)]*)", text)]
        foreign += [f"{sheet.name}: {url}" for url in re.findall(r"@import[^;]*", text)]
    assert foreign == []


def test_equations_are_drawn(site: Path) -> None:
    theory = (site / "theory.html").read_text(encoding="utf-8")
    assert theory.count('display="block"') > 10
    for page in site.glob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert "arithmatex" not in text
        assert "$$" not in text


def test_graphs_of_the_examples(site: Path) -> None:
    """In the table and below the headings; two examples have the graphs of those beside them, one has too many."""
    text = (site / "examples.html").read_text(encoding="utf-8")
    assert "<!-- graphs" not in text
    named = re.findall(r"<!-- graphs: (\w+) -->", (ROOT / "docs/examples.md").read_text(encoding="utf-8"))
    others = {file.stem for file in EXPERIMENTS.glob("*.yaml")} - set(named)
    assert others == {"fast_switching", "most_certain", "recorded_robots"}
    assert all(named.count(name) == 2 for name in named)
    drawn = re.findall(r'<svg [^>]*aria-label="(\w+): (\d+) links".*?</svg><figcaption>(\w+)</figcaption>', text)
    assert drawn.count(("line", "4", "line")) == drawn.count(("ring", "5", "ring")) == 6
    assert drawn.count(("square", "180", "square")) == 2  # 10 times 10: 2 times 10 times 9
    colours = (site / "assets/graph_colours.css").read_text(encoding="utf-8")
    assert all(colours.count(f"{used}:") == 2 for used in set(re.findall(r"--graph-\d", text)))  # light and dark


def test_example_report(tab: Tab, site: Path) -> None:
    """In its page and in its own tab: by the commands of the page, in its scheme, drawn without a complaint."""
    report = site / "reports/line_ring.html"
    commands = next(blocks(ROOT / "docs/example_report.md", "sh")).splitlines()
    assert f"<code>{' &amp;&amp; '.join(commands)}</code>" in report.read_text(encoding="utf-8")
    # The scheme is not emulated, as that wins in frames.
    page, log = tab.open((site / "example_report.html").as_uri(), width=1280, scheme="null")
    page.locator("iframe.report").scroll_into_view_if_needed()
    inside = page.frame_locator("iframe.report")
    inside.locator("body[data-ready=yes]").wait_for()
    assert inside.locator(".verdict strong").inner_text() == "✓ The run agrees with the prediction."
    inside.locator("body").evaluate("() => window.drawAll()")  # also what is below
    inside.locator("body[data-ready=yes]").wait_for()
    assert inside.locator(".plot canvas").count() > 5
    page.locator("label[for=__palette_1]").click()
    follows = """() => new Promise((done) => {
        const dark = matchMedia("(prefers-color-scheme: dark)");
        dark.matches ? done(true) : dark.addEventListener("change", () => done(dark.matches));
    })"""
    assert inside.locator("body").evaluate(follows)
    with page.expect_popup() as opened:
        page.locator("a.md-button").click()
    alone = opened.value
    alone.wait_for_selector("body[data-ready=yes]")
    assert alone.url == report.as_uri()
    assert [url for url in log.requests if not url.startswith(("file:", "data:", "blob:", "about:"))] == []
    assert log.complaints == []
    alone.close()
    page.evaluate("localStorage.clear()")


class Seen(NamedTuple):
    """What was found when all pages were opened, one after the other."""

    log: Log
    first: str
    """Address of the first result of a search."""
    wide: list[str]
    """Pages wider than a phone."""
    poor: dict[str, list[Any]]
    """Texts that are faint, by colour scheme, and what is cut, with page and width."""


@pytest.fixture(scope="module")
def seen(tab: Tab, site: Path, pages: dict[Path, Links]) -> Seen:
    assert {site / f"{name}.html" for name in READ} <= set(pages)
    page, log = tab.open("about:blank", width=390, height=844)
    wide, poor = [], {key: [] for key in (*SCHEMES, "cut")}
    for file in pages:
        page.set_viewport_size({"width": 390, "height": 844})
        page.goto(file.as_uri())
        if page.evaluate("document.documentElement.scrollWidth > document.documentElement.clientWidth"):
            wide.append(file.name)
        if file.parent != site or file.stem not in READ:
            continue
        page.add_style_tag(content="* { transition: none !important; }")
        for width in (390, 1280):
            page.set_viewport_size({"width": width, "height": 844})
            poor["cut"] += [(file.name, width, one) for one in page.evaluate(CUT_OR_SCROLLED)]
            for scheme in SCHEMES:
                page.evaluate(f"document.body.dataset.mdColorScheme = '{scheme}'")
                poor[scheme] += [(file.name, width, one) for one in page.evaluate(FAINT)]
    page.set_viewport_size({"width": 1280, "height": 900})
    page.goto((site / "index.html").as_uri())
    page.locator(".md-search__input").press_sequentially("supermodularity")  # the search listens to keys
    first = page.locator(".md-search-result__link").first
    first.wait_for()
    return Seen(log, str(first.get_attribute("href")), wide, poor)


def test_in_a_browser(seen: Seen) -> None:
    """Opened from the disk: no request to anywhere, no error, nothing wider than a phone, and the search finds."""
    assert "leader_theory.html" in seen.first
    addresses = seen.log.requests
    assert [url for url in addresses if not url.startswith(("file:", "data:", "blob:", "about:"))] == []
    assert seen.log.complaints == []
    assert seen.wide == []


@pytest.mark.parametrize("what", [*SCHEMES, "cut"])
def test_texts_can_be_read(seen: Seen, what: str) -> None:
    """No text is faint or cut, on a phone and at a desk."""
    assert seen.poor[what] == []
