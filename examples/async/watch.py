"""Print what a cell publishes for a while, in a program of asyncio: python watch.py CELL [SECONDS]

The client blocks, so it has a thread, which hands its messages over.
"""

import asyncio
import sys
import threading

from stereoservo.client import Client
from stereoservo.messages.wire import EventMessage, FeaturesMessage, StateMessage

Message = StateMessage | EventMessage | FeaturesMessage


async def main() -> None:
    loop = asyncio.get_running_loop()
    messages: asyncio.Queue[Message] = asyncio.Queue()
    ended = threading.Event()

    def read() -> None:
        with Client(sys.argv[1]) as cell:
            for message in cell.watch(features=True):
                if ended.is_set():
                    return
                loop.call_soon_threadsafe(messages.put_nowait, message)

    reader = asyncio.create_task(asyncio.to_thread(read))
    try:
        async with asyncio.timeout(float(sys.argv[2] if len(sys.argv) > 2 else 5)):
            while True:
                message = await messages.get()
                kind = type(message).__name__.removesuffix("Message").lower()
                print(kind, getattr(message, "kind", ""), getattr(message, "lifecycle", ""))
    except TimeoutError:
        pass
    ended.set()
    await reader


asyncio.run(main())
