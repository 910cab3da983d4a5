"""The page in a real browser: a whole session, windows, a killed server, a gauge, a controller, keys alone, axe."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from measured_world import World
from played_controllers import PlayedArm, rtde_controller
from test_report_in_browser import FLAGS

from casacal import load_problem, plan
from casacal.planning import read_route
from casacal.planning.plan import write_plan

pytestmark = pytest.mark.long
HSR = ROOT / "problems" / "hsr_jr680"
PATIENCE = 90.0  # seconds, of a loaded machine


class Page:
    """A window of the page, as a person uses it."""

    def __init__(self, driver):
        self.driver = driver

    def part(self, selector):
        return self.driver.find_element("css selector", selector)

    def _with(self, act, selector):
        """What `act` does with a part; once more where the page was drawn anew between finding it and acting."""
        stale = pytest.importorskip("selenium.common.exceptions").StaleElementReferenceException
        for _ in range(50):
            with contextlib.suppress(stale):
                return act(self.part(selector))
        return act(self.part(selector))

    def text(self, selector):
        return self._with(lambda part: part.text, selector)

    def click(self, selector):
        self._with(lambda part: part.click(), selector)

    def until(self, true, what):
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            found = true()
            if found:
                return found
            time.sleep(0.02)
        raise AssertionError(f"{what}: {self.text('main')} {self.driver.get_log('browser')}")

    def go(self, gate):
        self.click(f"#gates a[href='#{gate}']")
        self.until(lambda: self.part(f"#{gate}").is_displayed(), gate)

    def made(self):
        return self.driver.execute_script("return document.querySelectorAll('#made tr').length")

    def number(self):
        found = re.match(r"Touch (\d+) of", self.text("#where"))
        return int(found[1]) if found else None

    def take(self, line, count):
        """Type a touch and press Enter; wait until that many are made."""
        field = self.part("#reading")
        field.clear()
        field.send_keys(line + "\n")
        self.until_made(count)

    def until_made(self, count):
        self.until(lambda: self.made() == count, f"{count} touches")

    def until_doubt(self):
        self.until(lambda: self.text("#doubt"), "a doubt")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("no headless browser here; apt-get install chromium chromium-driver")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('browser')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield browser
    browser.quit()


@pytest.fixture(scope="module")
def planned(hsr, tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    made = plan(hsr.problem, hsr.cell, touches=40, pool=600, starts=1, seed=5)
    write_plan(folder / "plan.csv", made, hsr.problem, hsr.name)
    route = read_route(folder / "plan.csv", hsr.problem.layout())
    return folder / "plan.csv", World(hsr.problem, route, seed=2)


class Served:
    """`casacal serve` as a process; `url` opens it."""

    def __init__(self, folder, *options, problem=HSR):
        self.command = [sys.executable, "-m", "casacal", "serve", str(problem), "--port", "0", *options]
        self.folder = folder
        self.begin()

    def begin(self):
        words = self.folder / "words.txt"
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        with words.open("w") as out:
            self.process = subprocess.Popen(self.command, cwd=self.folder, stdout=out, stderr=out, env=environment)
        for _ in range(600):
            found = re.search(r"http://\S+", words.read_text())
            if found:
                self.url = found[0]
                return
            assert self.process.poll() is None, words.read_text()
            time.sleep(0.05)
        raise AssertionError(words.read_text())

    def end(self, how=signal.SIGINT):
        self.process.send_signal(how)
        self.process.wait(20)


@pytest.fixture
def serve(tmp_path):
    served = []

    def begin(*options, **more):
        served.append(Served(tmp_path, *options, **more))
        return served[-1]

    yield begin
    for each in served:
        if each.process.poll() is None:
            each.end(signal.SIGKILL)


def line_of(world, number, off=0.0):
    joints, reading, _ = world.touch(number)
    return " ".join([*(f"{value:.4f}" for value in np.degrees(joints)), f"{reading + off:.3f}"])


def opened(browser, url):
    browser.get(url)
    page = Page(browser)
    page.until(lambda: page.text("#name") != "casacal", "the state")
    assert "token" not in browser.current_url
    return page


def kept(page):
    """Answer doubts about touches that were made well."""
    while page.text("#doubt"):
        before = page.text("#doubt")
        page.click("#doubt button[data-line=k]")
        page.until(lambda before=before: page.text("#doubt") != before, "an answer")


def test_a_session_of_forty_touches(browser, serve, planned, tmp_path):
    """Three slips are undone, the page is loaded again, a second window joins, the server is killed and goes on."""
    path, world = planned
    served = serve("--plan", str(path), "--out", "work")
    page = opened(browser, served.url)
    page.go("measure")
    slips, first = {20, 28, 36}, browser.current_window_handle
    while (number := page.number()) is not None:
        count = page.made()
        if number in slips:
            slips.discard(number)
            page.take(line_of(world, number, off=4.0), count + 1)
            page.until_doubt()
            assert not page.part("#reading-form").is_displayed()  # an answer comes first
            page.click(f"#doubt button[data-line='u {number}']")
            page.until_made(count)
            kept(page)
            continue
        if number == 10:  # as it is typed where the arm could not go to the posture
            page.click("#measuring summary")
            page.part("#stood").send_keys(line_of(world, number) + "\n")
            page.until_made(count + 1)
            assert page.part("#stood").get_attribute("value") == ""
        else:
            page.take(line_of(world, number), count + 1)
        kept(page)
        if number == 15:
            browser.refresh()
            page.until_made(15)
        if number == 18:
            browser.switch_to.new_window("tab")
            other = opened(browser, served.url)
            other.go("measure")
            other.until_made(18)
            other.take(line_of(world, other.number()), 19)
            kept(other)
            browser.close()
            browser.switch_to.window(first)
            page.until_made(19)
        if number == 25:
            served.end(signal.SIGKILL)
            served.begin()
            page = opened(browser, served.url)
            page.go("measure")
            page.until_made(25)
    assert not slips
    texts = [(tmp_path / "work" / name).read_text() for name in ("samples.csv", "samples_check.csv")]
    rows = [line for text in texts for line in text.splitlines()]
    assert len([line for line in rows if line[0].isdigit() or line[0] == "-"]) == 40
    assert "19 times of 20" in page.text("#progress")
    page.go("decide")
    page.click("#calibrate")
    page.until(lambda: page.text("#verdict").startswith("Calibrated"), "a verdict")
    page.until(lambda: page.part("#report").is_displayed(), "the report")
    browser.switch_to.frame(page.part("#report"))
    assert page.text(".kind").lower() == "calibration report"
    page.click("#space-fold summary")  # which draws in the frame as well
    page.until(lambda: page.part("#space-view").get_attribute("data-engine"), "the picture in space")
    browser.switch_to.default_content()
    page.go("verify")
    page.until(lambda: page.part("#verification button").is_enabled(), "the end of what was at work")
    page.part("#verify-tolerance").send_keys("\n")  # by a key: a click may land beside a button that moves meanwhile
    page.until(lambda: "Promise" in page.text("#verify .said"), "a verification")
    page.go("hand_over")
    targets = tmp_path / "targets.csv"
    targets.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,20,30,-50,-55,-50\n")
    page.part("#targets").send_keys(str(targets))
    page.click("#correction button")
    page.until(lambda: "Save corrected.csv" in page.text("#corrected"), "corrected targets")
    singular = tmp_path / "singular.script"
    singular.write_text("movej([0.2,0.3,0.5,-0.9,-1.0,-0.9])\nmovej([0,0,0,0,-1.5707963,0])\n")
    page.part("#targets").clear()
    page.part("#targets").send_keys(str(singular))
    page.click("#correction button")
    page.until(lambda: "with the box" in page.text("#trouble"), "one singular move keeps back the program")
    page.click("#leave")
    page.click("#correction button")
    page.until(lambda: "Left as it is" in page.text("#corrected"), "all but one corrected")
    page.part("#targets").clear()
    page.part("#targets").send_keys(str(targets))
    bad = tmp_path / "bad.csv"
    bad.write_text("q1_deg\nx\n")
    page.part("#targets").send_keys(str(bad))  # beside the first
    assert page.text("#corrected") == ""
    page.click("#correction button")
    page.until(lambda: "bad.csv" in page.text("#trouble"), "a refusal of both")
    assert page.text("#corrected") == ""
    severe = [each for each in browser.get_log("browser") if "Failed to load resource" not in each["message"]]
    assert [each for each in severe if "ERR_CONNECTION" not in each["message"]] == []


def test_a_gauge_and_a_controller(browser, serve, planned):
    """Readings of a serial gauge are taken with the joint values of the controller, without a key being pressed."""
    pty = pytest.importorskip("pty")
    path, world = planned
    main, line = pty.openpty()
    arm = PlayedArm(world.touch(1)[0])
    with rtde_controller(arm) as address:
        options = ("--serial", os.ttyname(line), "--joints", f"rtde:{address}")
        served = serve("--plan", str(path), "--out", "work", *options)
        page = opened(browser, served.url)
        page.go("measure")
        page.until(lambda: "now" in page.text("#posture"), "where the controller shows the arm")
        for number in (1, 2):
            joints, reading, _ = world.touch(number)
            arm.joints = list(joints)
            time.sleep(2.2)
            os.write(main, f"{reading:+.3f}\r\n".encode())
            page.until_made(number)
        os.write(main, f"{reading:+.3f}\r\n".encode())  # the button pressed twice
        page.until(lambda: "Not taken" in page.text("#measure .said"), "a note")
        assert page.made() == 2
    joints, reading, _ = world.touch(3)
    time.sleep(2.2)
    os.write(main, f"{reading:+.3f}\r\n".encode())
    page.until(lambda: "gives no joint values" in page.text("#measure .said"), "a lost link")
    assert page.made() == 2
    page.take(line_of(world, 3), 3)
    os.close(main)
    os.close(line)


def test_by_keyboard_alone(browser, serve, planned):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    served = serve("--plan", str(planned[0]), "--out", "work")
    page = opened(browser, served.url)

    def press(*keys):
        ActionChains(browser).send_keys(*keys).perform()

    def focused():
        return browser.execute_script(
            "const e = document.activeElement; return e.id || e.getAttribute('href') || e.dataset.line || e.tagName"
        )

    def tab_to(wanted):
        for _ in range(60):
            if focused() == wanted:
                return
            press(Keys.TAB)
        raise AssertionError(f"{wanted} is not reached by the tabulator")

    tab_to("#measure")
    press(Keys.ENTER)
    page.until(lambda: focused() == "reading", "the field has the focus")
    for number in range(1, 9):
        press(line_of(planned[1], number), Keys.ENTER)
        page.until_made(number)
        page.until(lambda: focused() == "reading", "the focus stays")
    tab_to("undo")
    press(Keys.ENTER)
    page.until_made(7)
    tab_to("view")
    press(Keys.ARROW_LEFT, "+")


@pytest.mark.parametrize("width", [390, 820, 1280])
def test_nothing_is_too_wide_and_axe_finds_nothing(browser, serve, planned, width):
    """Every gate in every width, and axe (WCAG 2.2 A and AA) on it."""
    axe = pytest.importorskip("axe_core_python")
    script = next(Path(axe.__file__).parent.rglob("axe.min.js")).read_text(encoding="utf-8")
    served = serve("--plan", str(planned[0]), "--out", "work")
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 1000}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page = opened(browser, served.url)
    browser.execute_script(script)
    for gate in ("cell", "conventions", "plan", "measure", "decide", "verify", "hand_over"):
        page.go(gate)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width, gate
        rules = {"runOnly": ["wcag2a", "wcag2aa", "wcag21aa", "wcag22aa", "best-practice"]}
        call = "const done = arguments[1]; axe.run(document, arguments[0]).then(done, e => done({error: String(e)}))"
        found = browser.execute_async_script(call, rules)
        assert "error" not in found
        bad = [each for each in found["violations"] if each["impact"] in ("serious", "critical")]
        assert [(each["id"], [node["html"][:120] for node in each["nodes"]]) for each in bad] == [], gate
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_script_in_names_stays_text(browser, serve, tmp_path):
    """A face called by markup is shown as it is called."""
    evil = "<img src=x onerror=document.title='owned'>"
    folder = tmp_path / "cell"
    shutil.copytree(HSR, folder)
    with (folder / "problem.py").open("a", encoding="utf-8") as file:
        named = f"replace(face, label={evil!r}) if face.label == 'floor' else face"
        file.write(f"\nfrom dataclasses import replace\ncell = replace(cell, faces=[{named} for face in cell.faces])\n")
    problem = load_problem(folder)
    made = plan(problem.problem, problem.cell, touches=30, pool=300, starts=1)
    write_plan(tmp_path / "plan.csv", made, problem.problem, problem.name)
    page = opened(browser, serve("--plan", str(tmp_path / "plan.csv"), problem=folder).url)
    for gate in ("cell", "plan", "measure"):
        page.go(gate)
        assert evil in page.text("main")
    page.take("<script>document.title='owned'</script>", 0)
    page.until(lambda: "0 numbers came" in page.text("#measure .said"), "an answer")
    assert browser.title == "casacal: cell"


def test_an_interrupt_ends_it_at_once(browser, serve, planned):
    served = serve("--plan", str(planned[0]), "--out", "work")
    opened(browser, served.url)  # whose events are still listened to
    began = time.monotonic()
    served.end()
    assert time.monotonic() - began < 5
    assert served.process.returncode in (0, 130)
