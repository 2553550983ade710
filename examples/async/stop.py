"""Stop the arm, from anywhere: python stop.py CELL"""

import asyncio
import sys

from stereoservo.client import Client


async def main() -> None:
    cell = await asyncio.to_thread(Client, sys.argv[1])
    try:
        reply = await asyncio.to_thread(cell.stop)  # raises where the servo process did not acknowledge it
        print("stopped:", reply.message or "accepted")
    finally:
        await asyncio.to_thread(cell.close)


asyncio.run(main())
