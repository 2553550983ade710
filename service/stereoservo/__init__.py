"""stereoservo: closes the loop between two uncalibrated cameras and a robot arm."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str
else:

    def __getattr__(name: str) -> str:
        """``__version__``, looked up when it is asked for: package metadata takes a third of a client's import time."""
        if name != "__version__":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib.metadata import version

        return version("stereoservo")
