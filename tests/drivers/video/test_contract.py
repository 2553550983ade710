"""The video driver keeps the contract of camera drivers, on recordings and on a live stream."""

from __future__ import annotations

import cv2
import pytest

from stereoservo.ports.devices import CameraDriver, DriverContext
from stereoservo_drivers.contracts import CameraDriverContract
from stereoservo_drivers.video.driver import VideoCameraDriver

from .conftest import HEIGHT, WIDTH, MjpegServer, picture


class TestNumberedPictures(CameraDriverContract):
    def make_driver(self, context: DriverContext) -> CameraDriver:
        for number in range(12):
            cv2.imwrite(str(context.cell_dir / f"p{number:04d}.png"), picture(number))
        return VideoCameraDriver({"source": "p%04d.png", "width": WIDTH, "height": HEIGHT, "loop": True}, context)


class TestMjpegStream(CameraDriverContract):
    real_time = True

    @pytest.fixture(autouse=True)
    def _served(self, server: MjpegServer) -> None:
        self.server = server

    def make_driver(self, context: DriverContext) -> CameraDriver:
        options = {"source": self.server.url, "width": WIDTH, "height": HEIGHT, "rate_hz": 100.0}
        return VideoCameraDriver(options, context)
