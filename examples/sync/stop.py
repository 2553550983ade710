"""Stop the arm, from anywhere: python stop.py CELL"""

import sys

from stereoservo.client import Client

with Client(sys.argv[1]) as cell:
    reply = cell.stop()  # raises where the servo process did not acknowledge it
    print("stopped:", reply.message or "accepted")
