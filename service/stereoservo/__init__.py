"""stereoservo: closes the loop between two uncalibrated cameras and a robot arm."""

from importlib.metadata import version

__version__: str = version("stereoservo")
