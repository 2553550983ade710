"""Pictures from stdin (length in four bytes, JPEG) to every client, by aiohttp: chunked transfer coding."""

import asyncio
import struct
import sys

from aiohttp import MultipartWriter, web

clients = set()


async def stream(request):
    response = web.StreamResponse(headers={"Content-Type": "multipart/x-mixed-replace; boundary=frame"})
    response.enable_chunked_encoding()
    await response.prepare(request)
    queue = asyncio.Queue()
    clients.add(queue)
    try:
        while (data := await queue.get()) is not None:
            with MultipartWriter("image/jpeg", boundary="frame") as writer:
                writer.append(data, {"Content-Type": "image/jpeg"})
                await writer.write(response, close_boundary=False)
    finally:
        clients.discard(queue)
    return response


async def main():
    application = web.Application()
    application.router.add_get("/stream", stream)
    runner = web.AppRunner(application)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", int(sys.argv[1])).start()
    reader = asyncio.StreamReader(limit=1 << 22)
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin.buffer)
    try:
        while True:
            (length,) = struct.unpack(">I", await reader.readexactly(4))
            data = await reader.readexactly(length)
            for queue in clients:
                queue.put_nowait(data)
    except asyncio.IncompleteReadError:
        for queue in clients:
            queue.put_nowait(None)
    await runner.cleanup()


asyncio.run(main())
