"""The goal client, for programs that servo an arm: ``from stereoservo.client import Client``.

It needs zenoh and msgspec only. Goals, targets and messages are in `stereoservo.messages`.
"""

from stereoservo.client.client import Client, GoalOptions, as_target
from stereoservo.client.errors import (
    ClientError,
    DaemonLostError,
    FailedError,
    InvalidReplyError,
    NoReplyError,
    RefusedError,
    TimedOutError,
)
from stereoservo.client.events import EventWatch, HeardEvents
from stereoservo.client.goal_handle import GoalHandle, GoalProgress, GoalResult
from stereoservo.client.session import SessionError

__all__ = [
    "Client",
    "ClientError",
    "DaemonLostError",
    "EventWatch",
    "FailedError",
    "GoalHandle",
    "GoalOptions",
    "GoalProgress",
    "GoalResult",
    "HeardEvents",
    "InvalidReplyError",
    "NoReplyError",
    "RefusedError",
    "SessionError",
    "TimedOutError",
    "as_target",
]
