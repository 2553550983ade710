"""Follow set-points that move: python stream.py CELL [PIXELS]

What the cameras see now is the first set-point; then it moves to the right by so many pixels, in two seconds.
"""

import sys
import time
from collections.abc import Iterator

from stereoservo.client import Client
from stereoservo.messages.goals import FeatureTarget
from stereoservo.messages.wire import FeaturesMessage

RATE_HZ, STEPS = 30.0, 60
pixels = float(sys.argv[2]) if len(sys.argv) > 2 else 5.0

with Client(sys.argv[1]) as cell:
    cell.enable()
    cameras = [camera.name for camera in cell.info().cameras]
    seen: dict[str, dict[int, tuple[float, float]]] = {}
    for message in cell.watch(features=True):
        if isinstance(message, FeaturesMessage) and len(message.ids) >= 4:
            seen[message.camera] = dict(zip(message.ids, message.pixels, strict=True))
        if len(seen) == len(cameras):
            break

    def moved(shift: float) -> FeatureTarget:
        return FeatureTarget(
            {camera: {m: (u + shift, v) for m, (u, v) in markers.items()} for camera, markers in seen.items()}
        )

    def set_points() -> Iterator[tuple[float, FeatureTarget]]:
        for k in range(1, STEPS + 1):
            time.sleep(1.0 / RATE_HZ)
            yield time.monotonic(), moved(pixels * k / STEPS)

    # It would be reached at once, at the first set-point: it is to be held for longer than the stream takes.
    with cell.goal(moved(0.0), hold_frames=1000, lease_s=2.0) as goal:
        count = goal.stream(set_points())
        print(f"followed {count} set-points, {goal.progress().error_px} px from the last one")
