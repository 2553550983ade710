"""The operators' page on live cells: over its WebSocket, and in a real headless Chromium."""

from __future__ import annotations

import json
import random
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from recording.bench_flight import record_bench
from stereoservo.client import Client, EventWatch, NoReplyError
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.wire import EventMessage
from web.chromium import Browser, chromium

from .conftest import CELL, eventually, serving

pytest.importorskip("websockets", reason="the page's server needs websockets (extra web)")

from websockets.sync.client import connect

from stereoservo.web.cell_link import CellLink
from stereoservo.web.rights import LEASE_S


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
                assert path[-1] == pytest.approx(dragged["pixels"][camera][marker], abs=0.5), "the path ends there"
        sent = page.ask("go")
        assert sent["ok"], sent
        end = page.until(lambda message: ended(message, sent["id"]))
        assert end["event"]["kind"] == "goal_reached", end
        assert end["event"]["error_px"] < 0.5
        assert not page.ask("check", name="nobody")["ok"]
        page.close()


@pytest.mark.process
def test_the_goal_of_another_client_is_drawn_with_its_path_and_in_the_scene(client: Client) -> None:
    with serving(CELL) as served:
        page = Page(served["url"])
        page.until(lambda message: message.get("scene"))
        handle = client.goal("park", tolerance_px=0.5)
        drawn = page.until(lambda message: message.get("goal", {}).get("id") == handle.id)["goal"]
        handle.reached(60.0)
        at_rest = page.until(lambda message: message.get("state", {}).get("goal") == "" and message["scene"])
        page.close()
    for camera, markers in drawn["set_points"].items():
        for marker, pixel in markers.items():
            assert at_rest["predicted"][camera][marker] == pytest.approx(pixel, abs=1.0)
            assert drawn["plan"]["pixels"][camera][marker][-1] == pytest.approx(pixel, abs=1.0)
    markers, cameras = np.array(at_rest["scene"]["markers"]), at_rest["scene"]["cameras"]
    size = np.linalg.norm(np.array(cameras[0]["centre"]) - markers.mean(axis=0))
    assert np.allclose(drawn["scene"], markers, atol=5e-3 * size), "in the scene it is where the arm then stands"


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
                message.get("event", {}).get("kind") == "goal_aborted" and message["event"]["id"] == sent["id"]
            )
        )
        assert any(reason["code"] == "LEASE_EXPIRED" for reason in end["event"]["reasons"]), end
        assert "read-only" in watcher.ask("resume")["message"]
        assert watcher.ask("stop")["ok"]
        watcher.close()


@pytest.mark.process
def test_a_goal_outlives_a_session_of_its_page_that_failed(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
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
    path.write_text(text.replace("rate_hz = 30.0", "rate_hz = 15.0").replace('name = "demo"', 'name = "webdemo"'))
    with DaemonProcess(path, log=roots / "web_demo.log") as daemon:
        daemon.wait_ready()
        yield "webdemo"


@pytest.fixture
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.timeout(1200)
def test_in_a_browser_the_cell_is_calibrated_and_twenty_dragged_goals_are_reached(
    demo: str, browser: Browser, tmp_path: Path
) -> None:
    rng = random.Random(18)
    with serving(demo, "--operate", "ann") as served:
        browser.driver.get(served["url"])
        browser.value("window.stats && stats.pictures > 3")
        browser.element("#token").send_keys(served["token"])
        browser.press("#take button")
        browser.press("[data-do=enable]")
        browser.press("[data-do=calibrate]")
        browser.value("stats.events.some(event => event[0] === 'calibrated')", 600.0)
        browser.value("document.getElementById('calibration').textContent.startsWith('Calibrated')")
        middle = {camera: browser.value(f"stats.middle('{camera}')") for camera in ("left", "right")}
        ends = []
        for k in range(20):
            camera = ("left", "right")[k % 2]
            u, v = middle[camera]
            browser.drag(camera, (u + rng.uniform(-50.0, 50.0), v + rng.uniform(-40.0, 40.0)))
            browser.press("#check")
            browser.press("#go")
            goal = browser.value("stats.goal")
            ends.append(
                browser.value(
                    f"stats.events.find(e => e[1] === '{goal}' && /goal_(reached|aborted)/.test(e[0]))", 120.0
                )
            )
        assert [end for end in ends if end[0] != "goal_reached" or end[2] > 0.5] == [], "with their reasons"
        for width in (1280, 390):
            browser.require_room(width, tmp_path)
            assert browser.element("#stop").is_displayed()
        browser.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
        browser.value("stats.answers.at(-1)[0] === 'stop' && stats.answers.at(-1)[1]")


@pytest.mark.slow
@pytest.mark.process
def test_in_a_browser_a_recording_is_played(browser: Browser, tmp_path: Path) -> None:
    flight = tmp_path / "flight.mcap"
    record_bench(flight, 400)
    with serving("--flight", str(flight)) as served:
        browser.driver.get(served["url"])
        browser.value("document.getElementById('at').textContent.startsWith('3.99 of 3.99 s, ')")
        assert browser.value("document.getElementById('play').textContent") == "Play", "it is at its end"
        browser.run(
            "const bar = document.getElementById('time'); bar.value = 2.5; bar.dispatchEvent(new Event('input'))"
        )
        browser.value("document.getElementById('at').textContent.startsWith('2.50 of 3.99 s, ')")
        browser.value("stats.events.some(event => event[0] === 'goal_started')")
        green = """(() => {
            const canvas = document.querySelector('canvas[data-camera=left]');
            const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
            let found = 0;
            for (let i = 0; i < data.length; i += 4)
                found += data[i + 1] > 150 && data[i] < 120 && data[i + 2] < 160 && data[i + 3] > 0;
            return found;
        })()"""
        assert browser.value(green) > 100, "markers are drawn"
        browser.press("#play")
        browser.value("document.getElementById('at').textContent.startsWith('3.99 of 3.99 s, ')")
        for hidden in ("#stop", "#controls", "#go"):
            assert not browser.element(hidden).is_displayed()
        for width in (1280, 390):
            browser.require_room(width, tmp_path)
