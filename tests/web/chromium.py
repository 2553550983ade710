"""A headless Chromium with the operators' page, for tests."""

from __future__ import annotations

import importlib.util
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

BROWSER = shutil.which("chromium"), shutil.which("chromedriver")


class Browser:
    """A headless Chromium with the page."""

    def __init__(self) -> None:
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = str(BROWSER[0])
        for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1280,1200"):
            options.add_argument(argument)
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(BROWSER[1])))

    def run(self, script: str) -> Any:
        return self.driver.execute_script(script)  # type: ignore[no-untyped-call]

    def value(self, script: str, seconds: float = 60.0) -> Any:
        until = time.monotonic() + seconds
        while not (found := self.run(f"return {script}")):
            assert time.monotonic() < until, (script, self.run("return window.stats"))
            time.sleep(0.05)
        return found

    def element(self, selector: str) -> Any:
        return self.driver.find_element("css selector", selector)

    def press(self, selector: str) -> None:
        before = self.run("return stats.answers.length")
        self.element(selector).click()
        self.value(f"stats.answers.length > {before}")
        _, accepted, text = self.run("return stats.answers.at(-1)")
        assert accepted, text

    def drag(self, camera: str, to: tuple[float, float]) -> None:
        """Drag the outline so that the middle of the markers comes to pixel ``to``."""
        from selenium.webdriver.common.action_chains import ActionChains

        canvas = self.element(f"canvas[data-camera={camera}]")
        self.run("window.scrollTo(0, 0); stats.dragged = stats.goal = null")
        width, height = canvas.size["width"], canvas.size["height"]
        scale = width / 640
        begin, end = ([round(scale * v) for v in pixel] for pixel in (self.value(f"stats.middle('{camera}')"), to))
        ActionChains(self.driver).move_to_element_with_offset(
            canvas, begin[0] - width // 2, begin[1] - height // 2
        ).click_and_hold().move_by_offset(end[0] - begin[0], end[1] - begin[1]).release().perform()
        self.value("stats.dragged")

    def require_room(self, width: int, folder: Path) -> None:
        """Nothing is cut off at the side of a window of this width, in the light and in the dark."""
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        for scheme in ("light", "dark"):
            features = [{"name": "prefers-color-scheme", "value": scheme}]
            self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
            assert self.value("document.documentElement.scrollWidth") <= width
            self.driver.save_screenshot(str(folder / f"page-{width}-{scheme}.png"))


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser; skips the test where there is none."""
    if None in BROWSER or importlib.util.find_spec("selenium") is None:
        pytest.skip("needs chromium and chromium-driver (Debian's packages) and selenium")
    found = Browser()
    try:
        yield found
    finally:
        found.driver.quit()
