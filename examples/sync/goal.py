"""Plan a taught goal, go there, wait for its end: python goal.py CELL NAME"""

import sys

from stereoservo.client import Client, RefusedError

with Client(sys.argv[1]) as cell:
    cell.enable()
    goal = cell.make_goal(sys.argv[2], lease_s=2.0)  # the lease is renewed while this program lives
    try:
        plan = cell.check(goal).plan  # nothing moves
        handle = cell.send(goal)
    except RefusedError as error:
        sys.exit(f"refused: {error}")
    if plan is not None:
        print(f"planned {plan.seconds:.1f} s")
    result = handle.wait(120.0)
    print(result.outcome, result.error_px, "px")
    sys.exit(result.outcome != "reached")
