"""What the page shows, in a headless Chromium, when something dies that it hears of: its server, the cell, a camera."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("websockets", reason="the page's server needs websockets (extra web)")

from stereoservo.daemon.preview import encode_jpeg
from stereoservo.messages.learning import JointLearning, LearningState
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Halt, Health
from stereoservo.messages.wire import (
    CameraInfo,
    CellInfo,
    FeaturesMessage,
    JointInfo,
    LoopInfo,
    PreviewInfo,
    Reply,
    StateMessage,
    encode,
)
from stereoservo.web.cell_link import picture_message
from web.chromium import Browser, chromium
from web.page_bench import NotedLink, serving

CAMERAS = ("left", "right")
JPEG = encode_jpeg(np.zeros((120, 160), np.uint8))
INFO = CellInfo(
    "noted", "0", "boot", (JointInfo("j1", "revolute", -1.0, 1.0, 1.0),),
    tuple(CameraInfo(name, 160, 120, 30.0, "eye_to_hand", (1, 2, 3)) for name in CAMERAS), ("stereo",), "stereo", 0.1,
)  # fmt: skip
STATE = StateMessage(
    cell="noted", boot="boot", t_ns=0, step=0, t_wall=0.0, lifecycle="active", model="valid", model_epoch=1,
    source="hold", goal="", law="", level="ok", reasons=(), joints={"j1": 0.1}, velocities={"j1": 0.0},
    command={"j1": 0.0},
    error_px=None, task_error=(), innovation_px={}, visible=dict.fromkeys(CAMERAS, 3),
    loop=LoopInfo(250.0, 1, 0, 0, {"p99": 1.0, "max": 2.0}, {}), health=Health("ok"),
    joints_age_s=0.004, camera_age_s=dict.fromkeys(CAMERAS, 0.02),
)  # fmt: skip
TEXT = "document.getElementById('{}').textContent"
CAPTION = "document.querySelector('canvas[data-camera={}]')?.parentNode.lastChild.lastChild.textContent"
OLD = "document.querySelector('canvas[data-camera={}]')?.parentNode.classList.contains('old')"
LOST = "document.body.classList.contains('lost')"
UNCONFIRMED = "!document.getElementById('unconfirmed').hidden"


class LiveCell:
    """A cell that publishes: ``state`` as it is, and frames of ``cameras``, while it is not ``silent``."""

    def __init__(self, link: NotedLink) -> None:
        self.link = link
        self.state = STATE
        self.cameras = set(CAMERAS)
        self.silent = False
        self._ended = Event()
        self._thread = Thread(target=self._publish, daemon=True)
        self._thread.start()

    def _publish(self) -> None:
        number = 0
        while not self._ended.wait(0.05):
            number += 1
            if self.silent:
                self.link.silent_s += 0.05
                continue
            self.link.silent_s = 0.0
            now, now_ns = time.time(), time.monotonic_ns()
            state = msgspec.structs.replace(self.state, t_ns=now_ns, t_wall=now)
            self._publish_slot("info", {"info": INFO})
            self._publish_slot("state", {"state": state, "predicted": {}, "scene": None, "refinement": ""})
            for name in list(self.cameras):
                pixels = ((30.0, 40.0), (60.0, 40.0), (60.0, 70.0))
                seen = FeaturesMessage(name, number, now_ns, now_ns, now, (1, 2, 3), pixels, (0.1,) * 3)
                self._publish_slot(f"features {name}", {"features": seen})
                header = encode(PreviewInfo(name, number, now_ns, now, 160, 120))
                self.link.publish(f"picture {name}", picture_message(header, JPEG), False)

    def _publish_slot(self, slot: str, tree: dict[str, Any]) -> None:
        self.link.publish(slot, msgspec.json.encode(tree), slot in ("info", "state"))

    def end(self) -> None:
        self._ended.set()
        self._thread.join()


@contextmanager
def hung(link: NotedLink) -> Iterator[None]:
    """The page's server hangs: its event loop does nothing."""
    free = Event()
    link.loop.call_soon_threadsafe(free.wait, 60.0)
    try:
        yield
    finally:
        free.set()


def seconds(text: str) -> float:
    found = re.search(r"([0-9.]+) s", text)
    assert found is not None, text
    return float(found[1])


def counts_on(browser: Browser, script: str) -> None:
    """The seconds in a text grow."""
    first = seconds(browser.value(script))
    browser.value(f"parseFloat(/([0-9.]+) s/.exec({script})[1]) > {first + 0.3}")


@pytest.fixture(scope="module")
def chrome() -> Iterator[Browser]:
    with chromium() as found:
        yield found


@pytest.fixture
def cell(chrome: Browser) -> Iterator[LiveCell]:
    """A live cell that the page shows."""
    with serving("ann") as (port, _, _, link):
        live = LiveCell(link)
        try:
            chrome.driver.get(f"http://127.0.0.1:{port}/")
            for camera in CAMERAS:
                chrome.value(f"{CAPTION.format(camera)}?.includes('ms old, 3 markers')")
            chrome.value(f"{TEXT.format('lifecycle')} === 'active'")
            assert not chrome.run(f"return {LOST} || {UNCONFIRMED}")
            yield live
        finally:
            chrome.driver.get("about:blank")
            live.end()


def test_when_the_server_hangs_the_page_is_grey_counts_on_and_comes_back(cell: LiveCell, chrome: Browser) -> None:
    with hung(cell.link):
        chrome.value(LOST)
        assert "No word from the page's server" in chrome.value(TEXT.format("link"))
        assert chrome.run(f"return {TEXT.format('lifecycle')}").startswith("LOST for ")
        counts_on(chrome, TEXT.format("lifecycle"))
        chrome.value(f"{CAPTION.format('left')}.startsWith('nothing for')")
        assert chrome.run("return document.getElementById('commands').disabled")
        assert not chrome.run(
            "return document.querySelector('.badge.good') !== null && !document.body.matches('.lost')"
        )
    chrome.value(f"!{LOST} && {TEXT.format('lifecycle')} === 'active'")
    assert chrome.run("return document.getElementById('link').hidden")


def test_a_stop_that_the_hung_server_does_not_confirm_names_the_emergency_stop(cell: LiveCell, chrome: Browser) -> None:
    with hung(cell.link):
        chrome.element("#stop").click()
        chrome.value(UNCONFIRMED)
        text = chrome.element("#unconfirmed").text
        assert "STOP NOT CONFIRMED" in text
        assert "emergency stop" in text
        box = chrome.run(
            "const b = document.getElementById('unconfirmed').getBoundingClientRect(); return [b.width, b.height]"
        )
        assert box == chrome.run("return [document.documentElement.clientWidth, innerHeight]"), "across the screen"
        counts_on(chrome, TEXT.format("unconfirmed-since"))
    chrome.value(f"!({UNCONFIRMED})")
    assert chrome.run("return stats.answers.at(-1)[0] === 'stop' && stats.answers.at(-1)[1]"), "it has reached the cell"


def test_a_stop_that_is_refused_is_asked_for_again_until_it_is_confirmed(cell: LiveCell, chrome: Browser) -> None:
    taken, asked = Event(), []

    def stop(operator: str) -> Reply:
        asked.append(operator)
        if not taken.is_set():
            raise TimeoutError("the servo process has not taken it")
        return Reply(True, "taken")

    cell.link.stop = stop  # type: ignore[method-assign, assignment]
    chrome.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
    chrome.value(UNCONFIRMED)
    assert "has not taken it" in chrome.value(TEXT.format("unconfirmed-why"))
    taken.set()
    chrome.value(f"!({UNCONFIRMED})")
    assert len(asked) >= 2


def test_a_confirmed_stop_covers_nothing(cell: LiveCell, chrome: Browser) -> None:
    chrome.press("#stop")
    assert not chrome.run(f"return {UNCONFIRMED}")


def test_when_the_cell_is_silent_the_page_is_grey_though_its_server_lives(cell: LiveCell, chrome: Browser) -> None:
    cell.silent = True
    chrome.value(LOST)
    assert "No word from the cell" in chrome.value(TEXT.format("link"))
    counts_on(chrome, TEXT.format("lifecycle"))
    cell.silent = False
    chrome.value(f"!{LOST}")


def test_the_picture_of_a_dead_camera_is_grey_without_markers_and_its_age_counts_on(
    cell: LiveCell, chrome: Browser
) -> None:
    cell.cameras.discard("right")
    chrome.value(OLD.format("right"))
    counts_on(chrome, CAPTION.format("right"))
    assert "markers" not in chrome.run(f"return {CAPTION.format('right')}")
    assert not chrome.run(f"return {OLD.format('left')} || {LOST}")
    cell.cameras.add("right")
    chrome.value(f"!{OLD.format('right')} && {CAPTION.format('right')}.includes('3 markers')")


def test_the_head_states_that_the_arm_is_stopped_and_by_whom(cell: LiveCell, chrome: Browser) -> None:
    at = 1_700_000_000.0
    cell.state = msgspec.structs.replace(
        STATE,
        level="hold",
        reasons=(Reason("STOPPED", "hold", hint="resume"),),
        halt=Halt("stopped by viewer 2", at),
    )
    head = chrome.value(f"{TEXT.format('lifecycle')}.startsWith('STOPPED by viewer 2, ') && {TEXT.format('lifecycle')}")
    assert chrome.run("return document.getElementById('lifecycle').className") == "badge bad", head
    assert chrome.run("return document.title").startswith("STOPPED")
    cell.state = msgspec.structs.replace(
        STATE, level="hold", reasons=(Reason("HELD", "hold", hint="resume"),), halt=Halt("held by bob", at)
    )
    chrome.value(f"{TEXT.format('lifecycle')}.startsWith('HELD by bob, ')")
    assert chrome.run("return document.getElementById('lifecycle').className") == "badge warn"


def test_a_model_that_no_camera_sees_is_not_green_and_silent_cameras_are_named(cell: LiveCell, chrome: Browser) -> None:
    assert chrome.run("return document.getElementById('model').className") == "badge good"
    cell.state = msgspec.structs.replace(
        STATE, level="slow", visible={}, health=Health("unknown", text="no camera delivers frames"),
        camera_age_s={"left": 3.0, "right": None},
        reasons=(Reason("CAMERA_SILENT", "slow", "left", 3.0, 0.6, "s", "its process has ended"),),
    )  # fmt: skip
    chrome.value(f"{TEXT.format('reasons')}.includes('CAMERA_SILENT left: its process has ended')")
    assert chrome.run("return document.getElementById('model').className") == "badge warn"
    assert chrome.run("return document.getElementById('lifecycle').className") == "badge warn"


def test_while_the_arm_is_learnt_a_tile_a_joint_fills_with_its_accuracy(cell: LiveCell, chrome: Browser) -> None:
    hidden = "document.getElementById('learning').hidden"
    fills = (
        "[...document.querySelectorAll('#learning-joints li')].map((tile) => tile.style.getPropertyValue('--known'))"
    )
    assert chrome.run(f"return {hidden}")
    tiles = (JointLearning("j1", 0.5, 0.1), JointLearning("j2", 0.4), JointLearning("j3"))
    learning = LearningState("moving", 2, 4, 118, tiles, 7.2, 0.12, {"left": 0.25})
    cell.state = msgspec.structs.replace(STATE, learning=learning)
    chrome.value(f"!{hidden} && {TEXT.format('learning-head')} !== ''")
    assert chrome.run(f"return {TEXT.format('learning-head')}") == "Learning the arm: joint 2 of 3, predicted 0.12 px"
    assert chrome.run(f"return {TEXT.format('learning-count')}") == "118 images, 25 % of left seen, 7 s left"
    assert chrome.run(f"return {fills}") == ["50%", "0%", "0%"]
    texts = chrome.element("#learning-joints").text
    assert texts.split("\n") == ["j1: 0.10 px", "j2: not known yet", "j3: not moved yet"]
    assert chrome.run("return document.querySelector('#learning-joints .now').textContent").startswith("j2")
    cell.state = msgspec.structs.replace(STATE, learning=msgspec.structs.replace(learning, doing="fitting", motion=4))
    chrome.value(f"{TEXT.format('learning-head')}.includes('fitting the model')")
    cell.state = STATE
    chrome.value(hidden)
