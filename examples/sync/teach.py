"""What the cameras see now becomes a goal: python teach.py CELL NAME"""

import sys

from stereoservo.client import Client, ClientError

with Client(sys.argv[1]) as cell:
    try:
        event = cell.teach(sys.argv[2])
    except ClientError as error:
        sys.exit(f"not taught: {error}")
    print("taught", event.name)
