"""The page in a real browser: it draws, every mode changes the picture, and nothing is complained of or asked for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from html import escape
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, browser, find_browser
from pages import CENTRE, adorned, report, scan, torus

from gnrecon.report.html import write_page

MODES = ["colors", "error", "sigma", "distance", "mean_curvature", "gauss_curvature", "intensity"]


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    executable = find_browser()
    if executable is None:
        pytest.skip("there is no Chromium here (Debian's package chromium)")
    with browser(executable, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    mesh = adorned(torus())
    path = tmp_path_factory.mktemp("page") / "page.html"
    write_page(path, report(mesh), mesh, scan(mesh))
    return path


@pytest.fixture
def opened(chromium: Browser, file: Path) -> Browser:
    """The page in its first state, with nothing said yet."""
    chromium.events.clear()
    chromium.open(file, 1200, 800)
    return chromium


def drawn(image: np.ndarray) -> np.ndarray:
    """Which pixels of the canvas show something."""
    return image[..., 3] > 0


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """Mean difference of the colours where either picture shows something."""
    either = drawn(one) | drawn(other)
    return float(np.abs(one.astype(int) - other.astype(int))[either].mean())


def test_it_opens_without_complaints_or_requests_and_is_not_blank(opened: Browser, file: Path, tmp_path: Path) -> None:
    assert opened.value("document.documentElement.dataset.viewer") == "ready"
    whole = opened.screenshot(tmp_path / "page.png", whole=True)
    assert (tmp_path / "page.png").stat().st_size > 20_000
    assert whole.shape[0] > 1500
    assert opened.complaints() == []
    assert {address.partition("#")[0] for address in opened.requests()} <= {file.as_uri(), "about:blank"}
    image = opened.canvas()
    share = drawn(image).mean()
    assert 0.15 < share < 0.8
    clay = image[drawn(image)].astype(int)
    assert (clay[:, 0] > clay[:, 2]).mean() > 0.9, "plain clay is warm"
    assert clay[:, :3].std() > 15, "light shows the form"
    # The torus lies in the middle, and its hole is seen.
    columns = np.nonzero(drawn(image))[1]
    assert abs(columns.mean() - image.shape[1] / 2) < 0.03 * image.shape[1]
    opened.click('[data-set="view"][data-to="top"]')
    image = opened.canvas()
    assert not drawn(image)[image.shape[0] // 2, image.shape[1] // 2]


def test_every_mode_changes_the_picture_and_shows_its_legend(opened: Browser) -> None:
    pictures = {"plain": opened.canvas()}
    for mode in MODES:
        opened.click(f'[data-set="mode"][data-to="{mode}"]')
        pictures[mode] = opened.canvas()
        shown = opened.value("[...document.querySelectorAll('[data-legend]:not([hidden])')].map(e => e.dataset.legend)")
        assert shown == ([] if mode == "colors" else [mode])
        assert opened.value("location.hash").startswith(f"#mode={mode}&")
    names = list(pictures)
    for index, one in enumerate(names):
        for other in names[:index]:
            assert difference(pictures[one], pictures[other]) > 3, (one, other)
    opened.click('[data-set="mode"][data-to="plain"]')
    assert difference(opened.canvas(), pictures["plain"]) == 0
    assert opened.complaints() == []


def test_colours_are_those_of_the_scale(opened: Browser) -> None:
    """From above, errors of sin(5 x): the colour left and right of the middle must be red and blue as the sine is."""
    opened.click('[data-set="view"][data-to="top"]')
    opened.click('[data-set="mode"][data-to="error"]')
    image = opened.canvas().astype(int)
    columns = np.nonzero(drawn(image).any(axis=0))[0]
    x = (np.arange(image.shape[1]) - columns.mean()) / (np.ptp(columns) / 2) * 1.4
    for at in (-0.9, -0.3, 0.3, 0.9):
        column = image[:, np.abs(x - at).argmin()]
        red, _, blue, _ = column[column[:, 3] > 0].mean(axis=0)
        assert (red > blue) == (np.sin(5 * at) > 0), at


def test_what_no_data_supports_is_hatched(opened: Browser) -> None:
    """The distance grows outward from 0.12 to 0.28, and is hatched from 0.22 on: at a radius of 11."""
    opened.click('[data-set="view"][data-to="top"]')
    opened.click('[data-set="mode"][data-to="distance"]')
    image = opened.canvas().astype(int)
    rows, columns = np.nonzero(drawn(image))
    middle = (rows.min() + rows.max()) // 2
    line = image[middle - 15 : middle + 15].sum(axis=2)
    x = np.abs(np.arange(image.shape[1]) - columns.mean()) / (np.ptp(columns) / 2) * 14
    # Neighbours along a column are of nearly the same radius: only stripes set them apart.
    rough = np.abs(np.diff(line, axis=0)).max(axis=0)
    assert rough[(x > 11.8) & (x < 13)].min() > 40
    assert rough[(x > 7) & (x < 10)].max() < 20


def test_parts_can_be_shown_and_hidden(opened: Browser) -> None:
    mesh = opened.canvas()
    opened.click('[data-set="points"]')
    both = opened.canvas()
    assert difference(mesh, both) > 3
    opened.click('[data-set="mesh"]')
    points = opened.canvas()
    assert 0 < drawn(points).sum() < drawn(both).sum()
    blue = points[drawn(points)].astype(int)
    assert (blue[:, 2] > blue[:, 0]).mean() > 0.9
    opened.click('[data-set="points"]')
    assert not drawn(opened.canvas()).any()
    opened.click('[data-set="wire"]')
    lines = opened.canvas()
    assert 0 < drawn(lines).mean() < drawn(mesh).mean()


def test_a_section_opens_the_solid_towards_the_eye(opened: Browser) -> None:
    opened.click('[data-set="view"][data-to="front"]')
    whole = opened.canvas()
    opened.click('[data-set="axis"][data-to="y"]')
    cut = opened.canvas()
    inner = opened.value("getComputedStyle(document.documentElement).getPropertyValue('--inner')").strip()
    color = np.array(list(bytes.fromhex(inner[1:])))
    hatched = np.abs(cut[..., :3].astype(int) - color).max(axis=2) < 40
    # Half a torus shows two discs.
    middle = cut.shape[1] // 2
    assert hatched[:, :middle].sum() == pytest.approx(hatched[:, middle:].sum(), rel=0.05)
    assert hatched.sum() > 0.1 * drawn(whole).sum()
    assert opened.value("document.getElementById('cut-at').textContent").startswith("y = 4500000")
    opened.value("{const s = document.getElementById('cut'); s.value = 0; s.dispatchEvent(new Event('input'));}")
    opened.click("body")
    assert difference(opened.canvas(), whole) == 0
    opened.click('[data-set="side"]')
    assert drawn(opened.canvas()).sum() < 0.02 * drawn(whole).sum()
    assert opened.complaints() == []


def test_dragging_turns_the_model_and_the_pointer_reads_values(opened: Browser) -> None:
    opened.click('[data-set="mode"][data-to="distance"]')
    opened.click('[data-set="view"][data-to="top"]')
    before = opened.canvas()
    box = opened.value("(({left, top, width, height}) => [left, top, width, height])"
                       "(document.querySelector('canvas').getBoundingClientRect())")  # fmt: skip
    middle = (box[0] + box[2] / 2, box[1] + box[3] / 2)
    radius = 0.5 * np.ptp(np.nonzero(drawn(before).any(axis=0))[0]) / 1.4
    opened.ask("Input.dispatchMouseEvent", type="mouseMoved", x=middle[0] + radius, y=middle[1])
    opened.wait_for("!document.getElementById('probe').hidden")
    said = opened.value("document.getElementById('probe').textContent")
    value, places = said.split("\n")
    assert float(value.split()[3]) == pytest.approx(0.2, abs=0.02)
    # The place lies on the torus, right of the middle and at its upper side.
    x, y, z = np.array([float(number) for number in places.split(", ")]) - CENTRE
    assert (np.hypot(x, y) - 10) ** 2 + z**2 == pytest.approx(16, abs=0.4)
    assert x > 9
    assert abs(y) < 0.1
    assert z > 3.5
    for kind, way in (("mousePressed", 0), ("mouseMoved", -90), ("mouseReleased", -90)):
        place = {"x": middle[0] + way, "y": middle[1] + way}
        opened.ask("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)
    opened.wait_for("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
    assert difference(before, opened.canvas()) > 3


def test_an_address_opens_the_view_that_it_names(chromium: Browser, file: Path) -> None:
    chromium.open(file, 1200, 800, fragment="mode=sigma&points=1&axis=x&cut=0.3&view=right&up=y")
    shared = chromium.canvas()
    chromium.open(file, 1200, 800)
    for selector in (
        '[data-set="up"][data-to="y"]',
        '[data-set="view"][data-to="right"]',
        '[data-set="mode"][data-to="sigma"]',
        '[data-set="points"]',
        '[data-set="axis"][data-to="x"]',
    ):
        chromium.click(selector)
    chromium.value("{const s = document.getElementById('cut'); s.value = 0.3; s.dispatchEvent(new Event('input'));}")
    chromium.click("body")
    assert difference(shared, chromium.canvas()) == 0


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [420, 1400])
def test_it_fits_every_width_in_light_and_dark(
    chromium: Browser, file: Path, tmp_path: Path, width: int, dark: bool
) -> None:
    chromium.open(file, width, 900, dark=dark)
    assert chromium.value("document.documentElement.scrollWidth") <= width
    image = chromium.screenshot(tmp_path / "page.png", whole=True)[..., :3].astype(int)
    assert (image[2, 2].mean() < 60) == dark
    assert drawn(chromium.canvas()).mean() > 0.1
    beyond = chromium.value(
        "[...document.querySelectorAll('body *')].filter(e => e.getClientRects().length && "
        "e.getBoundingClientRect().right > document.documentElement.clientWidth + 1).map(e => e.outerHTML.slice(0, 99))"
    )
    assert beyond == []


def test_paper_is_white_however_dark_the_screen_is(chromium: Browser, file: Path) -> None:
    chromium.open(file, 1200, 800, dark=True)
    card = "getComputedStyle(document.querySelector('.card')).backgroundColor"
    assert chromium.value(card) != "rgb(255, 255, 255)"
    dark = {"name": "prefers-color-scheme", "value": "dark"}
    chromium.ask("Emulation.setEmulatedMedia", media="print", features=[dark])
    assert chromium.value(card) == "rgb(255, 255, 255)"
    shown = "[...document.querySelectorAll('button')].filter(e => e.getClientRects().length).length"
    assert chromium.value(shown) == 0, "nothing can be pressed on paper"
    chromium.ask("Emulation.setEmulatedMedia", media="", features=[])


def test_it_works_in_the_frame_of_a_notebook(chromium: Browser, file: Path, tmp_path: Path) -> None:
    notebook = tmp_path / "notebook.html"
    framed = escape(file.read_text(encoding="utf-8"))
    notebook.write_text(
        f'<!doctype html><html data-viewer="ready"><iframe srcdoc="{framed}"></iframe>', encoding="utf-8"
    )
    chromium.events.clear()
    chromium.open(notebook, 1200, 800)
    state = "document.querySelector('iframe')?.contentDocument?.documentElement?.dataset.viewer"
    deadline = time.monotonic() + 60
    while (found := chromium.value(state)) is None and time.monotonic() < deadline:
        time.sleep(0.1)
    assert found == "ready"
    assert chromium.complaints() == []
