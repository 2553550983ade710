"""The operators' page on live cells: over its WebSocket, and in a real headless Chromium."""

from __future__ import annotations

import importlib.util
import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from stereoservo.client import Client, EventWatch, NoReplyError
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.wire import EventMessage

from .conftest import CELL, eventually

pytest.importorskip("websockets", reason="the page's server needs websockets (extra web)")

from websockets.sync.client import connect

from stereoservo.web.cell_link import CellLink
from stereoservo.web.leases import LEASE_S

BROWSER = shutil.which("chromium"), shutil.which("chromedriver")


@contextmanager
def serving(cell: str, *options: str) -> Iterator[dict[str, Any]]:
    """``stereoservo web`` as a process: what it prints as JSON. It ends by Ctrl-C."""
    command = [sys.executable, "-m", "stereoservo.cli.main", "web", cell, "--port", "0", "--json", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0


class Page:
    """A page without a browser."""

    def __init__(self, url: str) -> None:
        self._socket = connect(url.replace("http", "ws") + "socket")
        self._n = 0

    def until(self, wanted: Callable[[dict[str, Any]], Any], seconds: float = 60.0) -> dict[str, Any]:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            data = self._socket.recv(timeout=seconds)
            if isinstance(data, str) and wanted(message := msgspec.json.decode(data)):
                return message  # type: ignore[no-any-return]
        raise AssertionError("it never came")

    def ask(self, do: str, **fields: Any) -> dict[str, Any]:
        self._n += 1
        self._socket.send(json.dumps({"do": do, "n": self._n, **fields}))
        return self.until(lambda message: message.get("answer", {}).get("n") == self._n)["answer"]  # type: ignore[no-any-return]

    def close(self) -> None:
        self._socket.close()


def ended(message: dict[str, Any], goal: str) -> bool:
    event = message.get("event", {})
    return event.get("id") == goal and event["kind"] in ("goal_reached", "goal_aborted", "goal_cancelled")


@pytest.mark.process
def test_a_goal_dragged_in_one_picture_is_reached(shared: DaemonProcess) -> None:
    with serving(CELL, "--operate", "ann") as served:
        page = Page(served["url"])
        assert "does not hold the arm" in page.ask("enable")["message"]
        assert page.ask("take", token=served["token"])["ok"]
        assert page.ask("enable")["ok"]
        page.until(lambda message: message.get("predicted"))
        dragged = page.ask("drag", camera="left", shift=[12.0, -9.0], done=True)
        assert dragged["ok"], dragged
        assert dragged["left_px"] < 0.1
        checked = page.ask("check")
        assert checked["ok"], checked
        for camera, markers in checked["plan"]["pixels"].items():
            for marker, path in markers.items():
                assert path[-1] == pytest.approx(dragged["pixels"][camera][marker], abs=0.5), (
                    "the path ends there"
                )
        sent = page.ask("go")
        assert sent["ok"], sent
        end = page.until(lambda message: ended(message, sent["id"]))
        assert end["event"]["kind"] == "goal_reached", end
        assert end["event"]["error_px"] < 0.5
        assert not page.ask("check", name="nobody")["ok"]
        page.close()


@pytest.mark.process
def test_a_closed_page_lets_its_goal_end(shared: DaemonProcess) -> None:
    with serving(CELL, "--operate", "ann") as served, serving(CELL) as watching:
        page, watcher = Page(served["url"]), Page(watching["url"])
        assert page.ask("take", token=served["token"])["ok"]
        assert page.ask("enable")["ok"]
        page.until(lambda message: message.get("predicted"))
        assert page.ask("drag", camera="left", shift=[30.0, 20.0], done=True)["ok"]
        assert page.ask("check")["ok"]
        sent = page.ask("go")
        page.ask("hold")  # it would be reached before its lease runs out
        page.close()
        end = watcher.until(
            lambda message: (
                message.get("event", {}).get("kind") == "goal_aborted"
                and message["event"]["id"] == sent["id"]
            )
        )
        assert any(reason["code"] == "LEASE_EXPIRED" for reason in end["event"]["reasons"]), end
        assert "read-only" in watcher.ask("resume")["message"]
        assert watcher.ask("stop")["ok"]
        watcher.close()


@pytest.mark.process
def test_a_goal_outlives_a_session_of_its_page_that_failed(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: deque[bytes] = deque()
    link = CellLink(CELL, None, "ann", lambda slot, data, keep: told.append(data))
    polled, failing = EventWatch.poll, threading.Event()

    def poll(watch: EventWatch) -> list[EventMessage]:
        if failing.is_set():
            failing.clear()
            raise NoReplyError("state", 2.0)
        return polled(watch)

    try:
        link.start()
        eventually("the model is there", lambda: link.view.model)
        assert link.send(link.taught_goal("park")).accepted
        goal = client.status().goal
        client.hold()  # it would be reached before its lease runs out
        monkeypatch.setattr(EventWatch, "poll", poll)
        for _ in range(2):  # each costs the link its session
            failing.set()
            told.clear()
            eventually("it is open again", lambda: any(b'"up":true' in data for data in list(told)))
            time.sleep(0.75 * LEASE_S)
        assert client.status().goal == goal, "as long as its page is there"
        link.end_leases()
        eventually("it ends without it", lambda: not client.status().goal)
    finally:
        link.close()


@pytest.fixture
def demo(roots: Path) -> Iterator[str]:
    """The simulated cell with rendered pictures."""
    import stereoservo_sim.cells

    path = roots / "web_demo.toml"
    text = (Path(stereoservo_sim.cells.__path__[0]) / "demo.toml").read_text()
    path.write_text(
        text.replace("rate_hz = 30.0", "rate_hz = 15.0").replace('name = "demo"', 'name = "webdemo"')
    )
    with DaemonProcess(path, log=roots / "web_demo.log") as daemon:
        daemon.wait_ready()
        yield "webdemo"


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.timeout(900)
@pytest.mark.skipif(
    None in BROWSER or importlib.util.find_spec("selenium") is None,
    reason="needs chromium and chromium-driver (Debian's packages) and selenium",
)
def test_in_a_browser_the_cell_is_calibrated_and_dragged_goals_are_reached(demo: str, tmp_path: Path) -> None:
    from selenium import webdriver
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    options = webdriver.ChromeOptions()
    options.binary_location = str(BROWSER[0])
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1280,1200"):
        options.add_argument(argument)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(BROWSER[1])))

    def value(script: str, seconds: float = 60.0) -> Any:
        until = time.monotonic() + seconds
        while not (found := browser.execute_script(f"return {script}")):
            assert time.monotonic() < until, (script, browser.execute_script("return window.stats"))
            time.sleep(0.05)
        return found

    def press(selector: str) -> None:
        before = browser.execute_script("return stats.answers.length")
        browser.find_element(By.CSS_SELECTOR, selector).click()
        value(f"stats.answers.length > {before}")
        _, accepted, text = browser.execute_script("return stats.answers.at(-1)")
        assert accepted, text

    try:
        with serving(demo, "--operate", "ann") as served:
            browser.get(served["url"])
            value("window.stats && stats.pictures > 3")
            browser.find_element(By.ID, "token").send_keys(served["token"])
            press("#take button")
            press("[data-do=enable]")
            press("[data-do=calibrate]")
            value("stats.events.some(event => event[0] === 'calibrated')", 600.0)
            value("document.getElementById('calibration').textContent.startsWith('Calibrated')")
            for k, (du, dv) in enumerate(((40, 20), (-30, 25), (20, -35), (-35, -15))):
                canvas = browser.find_element(
                    By.CSS_SELECTOR, f"canvas[data-camera={('left', 'right')[k % 2]}]"
                )
                browser.execute_script("window.scrollTo(0, 0); stats.dragged = stats.goal = null")
                u, v = value(f"stats.middle('{('left', 'right')[k % 2]}')")
                scale = canvas.size["width"] / 640
                ActionChains(browser).move_to_element_with_offset(
                    canvas,
                    int(u * scale - canvas.size["width"] / 2),
                    int(v * scale - canvas.size["height"] / 2),
                ).click_and_hold().move_by_offset(int(du * scale), int(dv * scale)).release().perform()
                value("stats.dragged")
                press("#check")
                press("#go")
                goal = value("stats.goal")
                end = value(
                    f"stats.events.find(e => e[1] === '{goal}' && /goal_(reached|aborted)/.test(e[0]))"
                )
                assert end[0] == "goal_reached", end
                assert end[2] < 0.5, "px"
            for width in (1280, 390):
                size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
                browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
                assert value("document.documentElement.scrollWidth") <= width, (
                    "nothing is cut off at the side"
                )
                assert browser.find_element(By.ID, "stop").is_displayed()
                browser.save_screenshot(str(tmp_path / f"page-{width}.png"))
            browser.execute_script("dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
            value("stats.answers.at(-1)[0] === 'stop' && stats.answers.at(-1)[1]")
    finally:
        browser.quit()
