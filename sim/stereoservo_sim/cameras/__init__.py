"""Emulated cameras: the simulated cell as MJPEG streams on loopback, with what goes wrong with real ones."""
