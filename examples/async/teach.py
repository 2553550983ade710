"""What the cameras see now becomes a goal: python teach.py CELL NAME"""

import asyncio
import sys

from stereoservo.client import Client, ClientError


async def main() -> None:
    cell = await asyncio.to_thread(Client, sys.argv[1])
    try:
        event = await asyncio.to_thread(cell.teach, sys.argv[2])
        print("taught", event.name)
    except ClientError as error:
        sys.exit(f"not taught: {error}")
    finally:
        await asyncio.to_thread(cell.close)


asyncio.run(main())
