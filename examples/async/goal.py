"""Go to a taught goal and show its progress meanwhile: python goal.py CELL NAME"""

import asyncio
import sys

from stereoservo.client import Client, RefusedError


async def main() -> None:
    cell = await asyncio.to_thread(Client, sys.argv[1])
    try:
        await asyncio.to_thread(cell.enable)
        goal = await asyncio.to_thread(cell.goal, sys.argv[2], lease_s=2.0)
        end = asyncio.create_task(asyncio.to_thread(goal.wait, 120.0))
        while not end.done():
            progress = await asyncio.to_thread(goal.progress)
            print("progress", progress.progress, progress.error_px)
            await asyncio.wait([end], timeout=0.2)
        result = end.result()
        print(result.outcome, result.error_px, "px")
        if result.outcome != "reached":
            sys.exit(1)
    except RefusedError as error:
        sys.exit(f"refused: {error}")
    finally:
        await asyncio.to_thread(cell.close)


asyncio.run(main())
