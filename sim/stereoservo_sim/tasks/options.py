"""Options of a campaign, separate so that its command can state them without heavy imports: defaults, and the error of
invalid options.
"""

from __future__ import annotations

DEFAULT_RATE_HZ, DEFAULT_GAIN = 25.0, 0.5
STOPS, FRAMES = 41, 25
"""Of the calibration motion: stops per joint, and frames averaged at each."""


class SettingsError(Exception):
    """Invalid settings of a campaign. The text states what would be valid."""

    code = "settings"
