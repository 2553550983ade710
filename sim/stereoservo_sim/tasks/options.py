"""Options of a campaign that its command states before it imports anything heavier: defaults, and the error of options
that do not fit.
"""

from __future__ import annotations

DEFAULT_RATE_HZ, DEFAULT_GAIN = 25.0, 0.5
STOPS, FRAMES = 41, 25
"""Of trial motions: stops a joint, and frames averaged at each."""


class SettingsError(Exception):
    """Invalid settings of a campaign. The text states what would be valid."""

    code = "settings"
