"""The protocols that the CAN driver speaks, by their name in the cell file."""

from __future__ import annotations

from pathlib import Path

from stereoservo_drivers.canopen.bringup import Bringup
from stereoservo_drivers.canopen.cia402 import Cia402Codec
from stereoservo_drivers.canopen.cia402_bringup import Cia402Bringup
from stereoservo_drivers.canopen.codec import Codec
from stereoservo_drivers.canopen.odrive import OdriveCodec
from stereoservo_drivers.canopen.odrive_bringup import OdriveBringup
from stereoservo_drivers.canopen.options import CanOptions


def make_codec(options: CanOptions) -> Codec:
    """The cyclic part. Raises DriverError (``option``) where the options do not fit the protocol."""
    if options.protocol == "odrive":
        return OdriveCodec(options)
    return Cia402Codec(options)


def make_bringup(options: CanOptions, codec: Codec, cell_dir: Path) -> Bringup:
    """What goes before the cycle of ``codec``, which ``make_codec`` gave for the same ``options``."""
    if isinstance(codec, OdriveCodec):
        return OdriveBringup(options, codec, cell_dir)
    assert isinstance(codec, Cia402Codec)
    return Cia402Bringup(options, codec, cell_dir)
