"""A browser for tests of pages: headless Chromium, which tells what it complained of and what it asked for."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

ARGUMENTS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
PROGRAMS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, PROGRAMS)), None)
NO_CHROMIUM = "no Chromium: install it (Debian: apt-get install chromium)"
WAIT = 60_000  # ms
# Elements that the window cuts at its left or right; tables may scroll within their own boxes.
CUT = """() => [...document.querySelectorAll("body *")].filter((one) => {
    const box = one.getBoundingClientRect();
    return box.width > 0 && !one.closest(".hidden") && (box.left < -0.5 || box.right > innerWidth + 0.5);
}).map((one) => one.outerHTML.slice(0, 200))"""
# The same where boxes scroll on their own, and what is called for waits beside the window.
CUT_OR_SCROLLED = """() => [...document.querySelectorAll("body *")].filter((one) => {
    const box = one.getBoundingClientRect();
    if (box.width === 0 || (box.left >= -0.5 && box.right <= innerWidth + 0.5)) return false;
    if (!one.checkVisibility({ opacityProperty: true, visibilityProperty: true })) return false;
    for (let place = one.parentElement; place !== document.body; place = place.parentElement) {
        const style = getComputedStyle(place);
        if (/auto|scroll/.test(style.overflowX) || style.position === "fixed") return false;
    }
    return getComputedStyle(one).position !== "fixed";
}).map((one) => one.outerHTML.slice(0, 200))"""
# Texts whose contrast to their background is below that of WCAG 2.2, level AA, whatever shines through both.
FAINT = """() => {
    const numbers = (colour) => (colour.match(/[0-9.]+/g) || []).map(Number);
    const part = (value) => (value <= 0.04045 * 255 ? value / 255 / 12.92 : ((value / 255 + 0.055) / 1.055) ** 2.4);
    const light = ([r, g, b]) => 0.2126 * part(r) + 0.7152 * part(g) + 0.0722 * part(b);
    const over = (front, back, share) => [0, 1, 2].map((i) => share * front[i] + (1 - share) * back[i]);
    const once = (compute, found = new Map()) => (one) => {
        if (!found.has(one)) found.set(one, compute(one));
        return found.get(one);
    };
    const behind = once((one) => {
        if (!one) return [255, 255, 255];
        const layer = numbers(getComputedStyle(one).backgroundColor), share = layer[3] ?? 1;
        return share === 1 ? layer.slice(0, 3) : over(layer, behind(one.parentElement), share);
    });
    const opaque = once((one) => (one ? getComputedStyle(one).opacity * opaque(one.parentElement) : 1));
    const faint = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let node = walker.nextNode(); node; node = walker.nextNode()) {
        const one = node.parentElement, style = getComputedStyle(one);
        const unseen = one.closest("script, style, option, .hidden, .bk-Root");
        if (!node.data.trim() || !one.checkVisibility() || unseen) continue;
        const drawn = numbers(one.closest("svg") ? style.fill : style.color), share = opaque(one) * (drawn[3] ?? 1);
        if (share < 0.05) continue;  // shown when it is asked for
        const outlined = style.paintOrder.startsWith("stroke") && style.stroke !== "none";
        const ground = outlined ? numbers(style.stroke) : behind(one), colour = over(drawn, ground, share);
        const [high, low] = [light(colour), light(ground)].sort((a, b) => b - a);
        const size = parseFloat(style.fontSize), large = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
        if ((high + 0.05) / (low + 0.05) >= (large ? 3 : 4.5)) continue;
        faint.push([node.data.trim(), colour.map(Math.round).join()]);
    }
    return faint;
}"""


class Log:
    """What became of a page: ``complaints`` of the console and uncaught errors; ``requests``, all addresses."""

    def __init__(self, page: Any) -> None:
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self._page = page
        self._heard = {
            "console": self._said,
            "pageerror": lambda error: self.complaints.append(str(error)),
            "request": lambda request: self.requests.append(request.url),
        }
        for event, hear in self._heard.items():
            page.on(event, hear)
        page.set_default_timeout(WAIT)

    def end(self) -> None:
        for event, hear in self._heard.items():
            self._page.remove_listener(event, hear)

    def _said(self, message: Any) -> None:
        if message.type not in ("info", "log", "debug"):
            self.complaints.append(message.text)


class Tab:
    """A page for one address after the other: its process need not start and compile the same scripts each time."""

    def __init__(self, browser: Any) -> None:
        self._page = browser.new_page()
        self._log = Log(self._page)

    def open(self, address: str, *, width: int, height: int = 900, scheme: str = "light") -> tuple[Any, Log]:
        """The page with this address, of this size and colour scheme, and the log from here on."""
        page = self._page
        self._log.end()
        page.goto("about:blank")  # nothing more comes from the page before
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(color_scheme=scheme, media="screen")
        page.mouse.move(0, 0)
        self._log = Log(page)
        page.goto(address)
        return page, self._log

    @contextmanager
    def phone(self, address: str) -> Iterator[tuple[Any, Any]]:
        """The page with this address on the screen of a phone, and a session that can send touches."""
        page, _ = self.open("about:blank", width=390, height=800)
        session = page.context.new_cdp_session(page)
        screen = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
        session.send("Emulation.setTouchEmulationEnabled", {"enabled": True})
        session.send("Emulation.setDeviceMetricsOverride", screen)
        page.goto(address)
        try:
            yield page, session
        finally:
            session.detach()


@contextmanager
def chromium() -> Iterator[Any]:
    """A headless Chromium; the test is skipped where there is none."""
    if CHROMIUM is None:
        pytest.skip(NO_CHROMIUM)
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: run make setup")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()
