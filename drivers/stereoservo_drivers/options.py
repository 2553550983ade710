"""Driver options from a cell file, decoded strictly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from stereoservo.runtime.ports import DriverError

T = TypeVar("T", bound=msgspec.Struct)


def decode_options(kind: type[T], options: Mapping[str, Any], driver: str) -> T:
    """``options`` as ``kind``, a struct that forbids unknown fields.

    Raises:
        DriverError: code ``option``; names the driver, the option and the options there are.
    """
    known = ", ".join(field.encode_name for field in msgspec.structs.fields(kind))
    try:
        return msgspec.convert(dict(options), kind, strict=True)
    except msgspec.ValidationError as error:
        raise DriverError(
            "option",
            f"driver {driver!r}: {error}; options of this driver: {known}",
            driver=driver,
            options=dict(options),
        ) from error
