"""Print what a cell publishes for a while: python watch.py CELL [SECONDS]"""

import sys
import time

from stereoservo.client import Client
from stereoservo.messages.wire import EventMessage, FeaturesMessage

with Client(sys.argv[1]) as cell:
    until = time.monotonic() + float(sys.argv[2] if len(sys.argv) > 2 else 5)
    for message in cell.watch(features=True):
        if isinstance(message, EventMessage):
            print("event", message.seq, message.kind, message.message)
        elif isinstance(message, FeaturesMessage):
            print("features", message.camera, len(message.ids), "markers")
        else:
            print("state", message.lifecycle, message.goal or "no goal", message.error_px)
        if time.monotonic() > until:
            break
