"""The page of a comparison: what is embedded, that it needs nothing from outside, and that it works in a browser without a head."""

import base64
import json
import re
import time

import numpy as np
import pytest
from browsers import browser
from comparison_cases import UNIT, comparison
from studies import compared as numbers
from studies import report
from studies.pictures import draw_all

from biem.curves.fourier import resample

WIDTHS = (1280, 400)
PATIENCE = 20.0  # s, for what the page does by itself


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The comparison of `comparison_cases`, its numbers, and its page as a file."""
    folder = tmp_path_factory.mktemp("page")
    compared = comparison(folder)
    found = {"scene": "two & <i>moving</i>"} | numbers.results(compared, 3.0 * UNIT)
    path = folder / "report.html"
    path.write_text(report.page(compared, found), encoding="utf-8")
    return compared, found, path


def data_of(path):
    """What is embedded."""
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', path.read_text(), re.S)[1])


def test_embedded_membranes_are_the_runs(made):
    compared, _, path = made
    film = data_of(path)["film"]
    run, P = film["runs"][1], film["points"]
    centers = np.frombuffer(base64.b64decode(run["centers"]), "<f4").reshape(run["frames"], 2, 2)
    shapes = np.frombuffer(base64.b64decode(run["shapes"]), "<i2").reshape(run["frames"], 2, P, 2) * run["step"]
    trajectory = compared.rungs[0].trajectory
    last = resample(trajectory.X[-1], P).transpose(0, 2, 1) / compared.R
    assert np.abs(centers[-1][:, None] + shapes[-1] - last).max() < 2e-4
    assert film["times"][-1] == pytest.approx(3.0)
    assert film["runs"][4]["frames"] == 1 + (len(film["times"]) - 1) // 3  # it ended at a third of the time
    assert film["runs"][5] is None


def test_errors_over_time_are_those_of_the_comparison(made):
    data = data_of(made[2])
    assert data["errors"][0]["values"]["position"][-1] == pytest.approx(0.006, rel=1e-3)
    assert data["floor"]["values"]["position"][-1] == pytest.approx(0.003, rel=1e-3)
    assert data["errors"][4] is None
    assert data["front"]["position"]["cpu"] == ["cheap", "good"]


def test_page_asks_for_nothing_and_escapes_what_it_says(made):
    _, _, path = made
    text = path.read_text()
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:,)""", text)
    assert set(re.findall(r"https?://[^\s\"'<]+", text)) == {"http://www.w3.org/2000/svg"}
    assert not re.search(r"@import|url\((?!#)|fetch\(|XMLHttpRequest|import\(", text)
    assert "{{" not in re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert "<b>not</b>" not in text
    assert "<i>moving" not in text
    assert len(text) < 1e6


@pytest.mark.parametrize(("vesicles", "runs"), [(1, 2), (2, 6), (32, 6), (100, 6), (2000, 4), (10_000, 5)])
def test_films_of_many_vesicles_stay_small(vesicles, runs):
    times, points = report._size(vesicles * runs)
    assert times >= 2
    assert points >= 16
    size = 4 / 3 * vesicles * runs * times * 4 * (points + 2)
    assert size < 5e6 or times == 2
    assert vesicles > 32 or (times >= report.LEAST_TIMES and points >= 24)


def test_pictures(made, tmp_path):
    compared, found, _ = made
    draw_all(compared, found, tmp_path)
    for name in ("error_time", "paths", "membranes"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000, name


@pytest.fixture(scope="module")
def opened(made, tmp_path_factory):
    """The browser with the page."""
    with browser(tmp_path_factory.mktemp("profile")) as driver:
        show(driver, made[2], WIDTHS[0])
        yield driver


def show(driver, path, width, dark=False):
    driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    )
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
    driver.get_log("browser")  # what was said before
    driver.get(path.as_uri())


def picture(driver):
    """What the canvas shows."""
    return driver.execute_script("return document.getElementById('film').toDataURL()")


def at(driver):
    """The frame that the film shows."""
    return float(driver.execute_script("return document.getElementById('film').dataset.at"))


def click(driver, identity):
    driver.execute_script("document.getElementById(arguments[0]).scrollIntoView({block: 'center'})", identity)
    driver.find_element("id", identity).click()


def wait_until(met, what):
    end = time.monotonic() + PATIENCE
    while not met():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def inked(driver):
    """The share of the canvas's pixels that are not of its ground."""
    return driver.execute_script(
        "const c = document.getElementById('film'), p = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "let n = 0; for (let i = 0; i < p.length; i += 4) n += p[i] !== p[0] || p[i + 1] !== p[1] || p[i + 2] !== p[2];"
        "return n / (p.length / 4)"
    )


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", WIDTHS)
def test_loads_without_an_error(opened, made, width, dark):
    show(opened, made[2], width, dark)
    assert opened.get_log("browser") == []
    assert opened.title == "Solvers on two & <i>moving</i>"
    assert opened.execute_script("return document.documentElement.scrollWidth") <= width  # nothing sticks out
    count = lambda selector: len(opened.find_elements("css selector", selector))
    assert count("#trade svg path") >= 6  # the front, the reference and four rungs
    assert count("#history svg path") >= 5  # the floor and four rungs
    assert count("#paths svg path") >= 10
    assert count("#summary li") == len(made[1]["summary"])
    assert count("#numbers tbody tr") == 6
    assert "unfit was refused: they are for 32 nodes, <b>not</b> these" in opened.find_element("id", "summary").text
    assert 0.02 < inked(opened) < 0.9
    light = opened.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert (light == "rgb(255, 255, 255)") != dark


def test_plays_and_pauses(opened, made):
    show(opened, made[2], WIDTHS[0])
    assert at(opened) == 0.0
    first = picture(opened)
    click(opened, "play")
    wait_until(lambda: at(opened) > 1.0, "the film does not advance")
    assert opened.find_element("id", "play").text == "Pause"
    assert picture(opened) != first
    click(opened, "play")
    stopped = at(opened)
    time.sleep(0.3)
    assert at(opened) == stopped
    assert opened.find_element("id", "play").text == "Play"
    opened.execute_script("FILM.go(FILM.last - 0.5)")
    click(opened, "play")
    wait_until(lambda: opened.find_element("id", "play").text == "Play", "the film does not stop at its end")
    assert at(opened) == len(data_of(made[2])["film"]["times"]) - 1


def test_scrubs_zooms_and_moves(opened, made):
    show(opened, made[2], WIDTHS[0])
    first = picture(opened)
    opened.execute_script("const s = document.getElementById('scrub'); s.value = 150; s.dispatchEvent(new Event('input'))")
    assert at(opened) == 150.0
    assert opened.find_element("id", "clock").text == "2.25 t_gamma"
    later = picture(opened)
    assert later != first
    film = opened.find_element("id", "film")
    before = inked(opened)
    opened.execute_script(
        "arguments[0].dispatchEvent(new WheelEvent('wheel', {deltaY: 300, clientX: 640, clientY: 300, cancelable: true}))", film
    )
    away = picture(opened)
    assert away != later
    assert inked(opened) < before  # from farther off all is smaller
    click(opened, "reset")
    assert picture(opened) == later
    click(opened, "closer")
    assert picture(opened) != later
    click(opened, "reset")
    webdriver = pytest.importorskip("selenium.webdriver")
    opened.execute_script("arguments[0].scrollIntoView({block: 'center'})", film)
    webdriver.ActionChains(opened).drag_and_drop_by_offset(film, 80, 40).perform()
    assert picture(opened) != later
    click(opened, "reset")
    assert picture(opened) == later
    opened.execute_script("const s = document.getElementById('camera'); s.value = '1'; s.dispatchEvent(new Event('change'))")
    assert picture(opened) != later


def test_works_by_the_keyboard(opened, made):
    show(opened, made[2], WIDTHS[0])
    keys = pytest.importorskip("selenium.webdriver").Keys
    film = opened.find_element("id", "film")
    film.send_keys(keys.ARROW_RIGHT, keys.ARROW_RIGHT, keys.ARROW_RIGHT, keys.ARROW_LEFT)
    assert at(opened) == 2.0
    still = picture(opened)
    film.send_keys("+")
    assert picture(opened) != still
    film.send_keys("0")
    assert picture(opened) == still
    film.send_keys(keys.END)
    assert at(opened) == 200.0
    film.send_keys(keys.HOME, keys.SPACE)
    wait_until(lambda: at(opened) > 0.5, "space does not play")
    film.send_keys(keys.SPACE)


def test_runs_are_shown_and_hidden(opened, made):
    show(opened, made[2], WIDTHS[1])
    opened.execute_script("FILM.go(FILM.last)")
    everything, curves = picture(opened), len(opened.find_elements("css selector", "#history svg path"))
    box = opened.find_element("css selector", "[data-run='2']")  # the one that is far off
    box.click()
    assert picture(opened) != everything
    assert len(opened.find_elements("css selector", "#history svg path")) == curves - 1
    box.click()
    assert picture(opened) == everything
    assert not opened.find_element("css selector", "[data-run='5']").is_enabled()  # it was refused


def test_other_quantities_and_costs(opened, made):
    show(opened, made[2], WIDTHS[0])
    title = lambda: opened.find_element("css selector", "#trade .axis-title").text
    before = title()
    choose = "const s = document.getElementById(arguments[0]); s.value = arguments[1]; s.dispatchEvent(new Event('change'))"
    opened.execute_script(choose, "cost", "wall")
    assert title() != before
    for quantity in made[1]["meaning"]:
        opened.execute_script(choose, "quantity", quantity)
        opened.execute_script(choose, "taken", "end")
        assert quantity in opened.find_element("id", "trade-caption").text
    assert opened.get_log("browser") == []
