"""report.html in a real browser: nothing fetched, nothing complained of, nothing too wide, and it prints."""

import base64
import io
import json
import re
import shutil
import time

import pytest
from conftest import ROOT
from PIL import Image

from casacal.cli.main import main

pytestmark = pytest.mark.long

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-unsafe-swiftshader",
    "--use-gl=angle",
    "--use-angle=swiftshader",
)
WIDTHS = {"phone": 390, "desktop": 1280}
SMALLEST_TEXT = 9.5
"""Pixels of a picture's text at phone width."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("no headless browser here; apt-get install chromium chromium-driver to look at report.html")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield browser
    browser.quit()


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report with long and hostile labels, so that what fits here fits elsewhere."""
    folder = tmp_path_factory.mktemp("browser-report") / "problem"
    shutil.copytree(ROOT / "problems" / "hsr_jr680", folder)
    samples = (folder / "samples.csv").read_text(encoding="utf-8")
    for old, new in {"floor": "<script>document.title='owned'</script>", "side": "side$^" * 60}.items():
        samples = samples.replace(f",{old}\n", f",{new}\n")
    (folder / "samples.csv").write_text(samples, encoding="utf-8")
    out = folder.parent / "out"
    assert main(["calibrate", str(folder), "--method", "lm", "--holdout", "0.25", "--out", str(out)]) == 0
    return out / "report.html"


@pytest.fixture(params=WIDTHS)
def opened(browser, report, request):
    size = {"width": WIDTHS[request.param], "height": 900, "deviceScaleFactor": 1, "mobile": request.param == "phone"}
    browser.get_log("performance")
    browser.get_log("browser")
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(report.as_uri())
    return browser, WIDTHS[request.param]


@pytest.mark.long
def test_nothing_is_fetched_and_nothing_complained_of(opened, report):
    browser, _ = opened
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert set(asked) == {report.as_uri()}
    assert browser.get_log("browser") == []
    assert browser.title.startswith("Calibration of HSR-JR680")


def test_nothing_is_wider_than_the_screen(opened):
    browser, width = opened
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    # tables may scroll inside their own box, everything else must fit
    wide = browser.execute_script(
        "return [...document.querySelectorAll('body *')].filter(e => !e.closest('.scroll table') && "
        "!e.closest('svg') && e.getBoundingClientRect().right > document.documentElement.clientWidth + 1)"
        ".map(e => e.outerHTML.slice(0, 80))"
    )
    assert wide == []


def test_pictures_are_legible_and_hold_all_they_draw(opened):
    browser, _ = opened
    small, outside, count = browser.execute_script(
        "const texts = [...document.querySelectorAll('svg.picture text')];"
        "const size = t => parseFloat(getComputedStyle(t).fontSize) *"
        "  t.closest('svg').getBoundingClientRect().width / 400;"
        "const out = t => { const a = t.getBoundingClientRect(), b = t.closest('svg').getBoundingClientRect();"
        "  return a.left < b.left - 1 || a.right > b.right + 1 || a.top < b.top - 1 || a.bottom > b.bottom + 1; };"
        "return [Math.min(...texts.map(size)), texts.filter(out).map(t => t.textContent), texts.length];"
    )
    assert count > 80
    assert small >= SMALLEST_TEXT
    assert outside == []


@pytest.mark.long
def test_texts_stand_out_from_the_page(opened):
    """Contrast of every text with what is behind it, as WCAG 2 defines it."""
    browser, _ = opened
    found = browser.execute_script(
        "return [...document.querySelectorAll('body *')].filter(e => [...e.childNodes].some("
        "n => n.nodeType === 3 && n.data.trim())).map(e => { let b = e, c = getComputedStyle(e);"
        "while (b && getComputedStyle(b).backgroundColor === 'rgba(0, 0, 0, 0)') b = b.parentElement;"
        "const behind = b ? getComputedStyle(b).backgroundColor : 'rgb(255, 255, 255)';"
        "return [e.closest('svg') ? c.fill : c.color, behind]; })"
    )
    for pair in {tuple(pair) for pair in found}:
        bright = sorted(luminance(colour) for colour in pair)
        assert (bright[1] + 0.05) / (bright[0] + 0.05) >= 4.5, pair


def luminance(colour):
    parts = [int(part) / 255 for part in re.findall(r"\d+", colour)[:3]]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def printed(browser, report):
    """The report as PDF. Once in some twenty runs Chromium fails to print anything; a page at fault always fails."""
    from selenium.common.exceptions import WebDriverException

    failed = []
    for _ in range(3):
        browser.get(report.as_uri())
        try:
            return base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})["data"])
        except WebDriverException as error:
            if "Printing failed" not in str(error):
                raise
            failed.append(error)
    raise failed[-1]


@pytest.mark.long
def test_it_prints(browser, report):
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})  # paper, not the screen of the test before
    pdf = printed(browser, report)
    assert pdf.startswith(b"%PDF-")
    assert 5 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 12


def test_an_arm_is_large_enough_to_be_recognised(browser, report, tmp_path):
    """In the report and above a sheet 200 pixels high, beside each touch 90."""
    sheet = tmp_path / "sheet.html"
    asked = [
        "plan",
        str(ROOT / "problems" / "ur5"),
        "--touches",
        "12",
        "--pool",
        "60",
        "--out",
        str(tmp_path / "p.csv"),
    ]
    assert main([*asked, "--sheet", str(sheet)]) == 0
    size = {"width": WIDTHS["desktop"], "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    for page, many, look, least in ((report, 2, "svg.arm", 200), (sheet, 2, ".overview svg.arm", 200),
                                    (sheet, 24, "td svg.arm", 90)):  # fmt: skip
        browser.get(page.as_uri())
        found = [each.size for each in browser.find_elements("css selector", look)]
        assert len(found) == many
        assert min(each["height"] for each in found) >= least
        assert min(each["width"] for each in found) > 0.3 * least


def test_the_fold_draws_the_arm_in_space_without_a_network(browser, report):
    """Opened, it shows sky, table, faces, arm and map in many colours; nothing is fetched but what it made itself."""
    browser.get_log("performance")
    browser.get_log("browser")
    browser.get(report.as_uri())
    fold = browser.find_element("css selector", "#space-fold summary")
    browser.execute_script("arguments[0].scrollIntoView()", fold)
    fold.click()
    drawn = "const c = document.getElementById('space-view'); return c.width > 300 && c.dataset.engine || ''"
    for _ in range(200):
        if browser.execute_script(drawn):
            break
        time.sleep(0.05)
    assert browser.execute_script(drawn).startswith("three.js")
    with Image.open(io.BytesIO(browser.find_element("id", "space-view").screenshot_as_png)) as picture:
        assert len(picture.convert("RGB").quantize(32).getcolors()) > 10
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert {url.partition(":")[0] for url in asked} <= {"file", "blob"}
    assert browser.get_log("browser") == []
