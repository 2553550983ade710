"""Gray pictures of WIDTH x HEIGHT from stdin, as H.264 over RTSP, by gst-rtsp-server."""

import os
import sys
import threading

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

port, width, height, rate = sys.argv[1], *map(int, sys.argv[2:5])
Gst.init(None)
sources = []


def configure(_factory, media):
    sources[:] = [media.get_element().get_by_name("pictures")]


server = GstRtspServer.RTSPServer.new()
server.set_address("127.0.0.1")
server.set_service(port)
factory = GstRtspServer.RTSPMediaFactory.new()
factory.set_shared(True)
factory.set_launch(
    f"( appsrc name=pictures is-live=true do-timestamp=true format=time caps=video/x-raw,format=GRAY8,width={width},"
    f"height={height},framerate={rate}/1 ! videoconvert ! video/x-raw,format=I420 ! x264enc tune=zerolatency "
    "speed-preset=ultrafast key-int-max=10 bitrate=4000 ! rtph264pay name=pay0 pt=96 config-interval=1 )"
)
factory.connect("media-configure", configure)
server.get_mount_points().add_factory("/stream", factory)
server.attach(None)
loop = GLib.MainLoop()


def feed():
    pictures = os.fdopen(0, "rb")
    while len(data := pictures.read(width * height)) == width * height:
        for source in sources:
            source.emit("push-buffer", Gst.Buffer.new_wrapped(data))
    loop.quit()


threading.Thread(target=feed, daemon=True).start()
loop.run()
