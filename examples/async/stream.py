"""Follow set-points that a program of asyncio makes: python stream.py CELL [PIXELS]

What the cameras see now is the first set-point; then it moves to the right by so many pixels, in two seconds.
"""

import asyncio
import sys
import time

from stereoservo.client import Client
from stereoservo.messages.goals import FeatureTarget
from stereoservo.messages.wire import FeaturesMessage

RATE_HZ, STEPS = 30.0, 60
Seen = dict[str, dict[int, tuple[float, float]]]


def look(cell: Client) -> Seen:
    """Marker -> pixel of every camera."""
    cameras = len(cell.info().cameras)
    seen: Seen = {}
    for message in cell.watch(features=True):
        if isinstance(message, FeaturesMessage) and len(message.ids) >= 4:
            seen[message.camera] = dict(zip(message.ids, message.pixels, strict=True))
        if len(seen) == cameras:
            break
    return seen


def moved(seen: Seen, shift: float) -> FeatureTarget:
    return FeatureTarget({c: {m: (u + shift, v) for m, (u, v) in markers.items()} for c, markers in seen.items()})


async def main() -> None:
    pixels = float(sys.argv[2]) if len(sys.argv) > 2 else 5.0
    cell = await asyncio.to_thread(Client, sys.argv[1])
    try:
        await asyncio.to_thread(cell.enable)
        seen = await asyncio.to_thread(look, cell)
        # It would be reached at once, at the first set-point: it is to be held for longer than the stream takes.
        goal = await asyncio.to_thread(cell.goal, moved(seen, 0.0), hold_frames=1000, lease_s=2.0)
        for k in range(1, STEPS + 1):
            goal.update(moved(seen, pixels * k / STEPS), time.monotonic())  # a put: it does not wait
            await asyncio.sleep(1.0 / RATE_HZ)
        progress = await asyncio.to_thread(goal.progress)
        print(f"followed {STEPS} set-points, {progress.error_px} px from the last one")
        await asyncio.to_thread(goal.cancel)
        await asyncio.to_thread(goal.wait, 10.0)
    finally:
        await asyncio.to_thread(cell.close)


asyncio.run(main())
