"""Strict decoding of driver options from a cell file; errors state key, value and valid values."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from stereoservo.messages.addresses import without_secrets
from stereoservo.ports.devices import DriverError

T = TypeVar("T", bound=msgspec.Struct)

_STEP = re.compile(r"\.(\w+)|\[(\d+|\.\.\.)\]")
_UNKNOWN = re.compile(r"unknown field `(.*)`")
_MISSING = re.compile(r"missing required field `(.*)`")


def decode_options(kind: type[T], options: Mapping[str, Any], driver: str) -> T:
    """Decode ``options`` as ``kind``, a struct that forbids unknown fields.

    Raises:
        DriverError: code ``option``; names the driver, the option, its value and the valid values.
    """
    try:
        return msgspec.convert(dict(options), kind, strict=True)
    except msgspec.ValidationError as error:
        raise DriverError(
            "option",
            f"driver {driver!r}: {invalid(kind, options, error)}",
            driver=driver,
            options=without_secrets(options),
        ) from error


def invalid(kind: type[msgspec.Struct], tree: Mapping[str, Any], error: msgspec.ValidationError) -> str:
    """Error text for ``error`` in ``tree``: key, value, and valid values, in a cell file's terms.

    An element of a list that has a name is identified by it: ``joint 'j3': gear_ratio = 0; valid: a number above 0``.
    """
    text, _, path = str(error).partition(" - at `")
    value, wanted, where, key = _walk(tree, inspect.type_info(kind), path.rstrip("`"))
    if unknown := _UNKNOWN.search(text):
        return f"{where}{key and f'{key}: '}no option {unknown[1]!r}{_instead(unknown[1], wanted)}"
    if missing := _MISSING.search(text):
        of = next((f.type for f in _fields(wanted) if f.encode_name == missing[1]), None)
        return f"{where}{key and f'{key}: '}{missing[1]} is missing; valid: {_words(of)}"
    return f"{where}{key} = {_shown(value)}; valid: {_words(wanted)}"


def _walk(value: Any, wanted: Any, path: str) -> tuple[Any, Any, str, str]:
    """Value and type at msgspec's ``path``, the named element that contains it, and the key from there."""
    where = key = ""
    for name, number in _STEP.findall(path):
        if name:
            field = next((f for f in _fields(wanted) if f.encode_name == name), None)
            value = value.get(name) if isinstance(value, Mapping) else None
            wanted = field.type if field is not None else None
            key = f"{key}.{name}" if key else name
            continue
        items = _element(wanted)
        if isinstance(value, Mapping):
            name, value = _failing(value, items)
            key = f"{key}.{name}"
        else:
            value = value[int(number)]
            if isinstance(value, Mapping) and isinstance(value.get("name"), str):
                where, key = f"{where}{key} {value['name']!r}: ", ""
            else:
                key = f"{key}[{number}]"
        wanted = items
    return value, wanted, where, key


def _fields(wanted: Any) -> tuple[inspect.Field, ...]:
    return next((one.fields for one in _either(wanted) if isinstance(one, inspect.StructType)), ())


def _element(wanted: Any) -> Any:
    for one in _either(wanted):
        if isinstance(one, inspect.DictType):
            return one.value_type
        if isinstance(one, inspect.VarTupleType | inspect.ListType):
            return one.item_type
    return None


def _either(wanted: Any) -> tuple[Any, ...]:
    bare = wanted.type if isinstance(wanted, inspect.Metadata) else wanted
    return bare.types if isinstance(bare, inspect.UnionType) else (bare,)


def _failing(table: Mapping[str, Any], wanted: Any) -> tuple[str, Any]:
    """Entry of a table that is not of its type, which msgspec does not report."""
    for name, value in table.items():
        if not any(_fits(value, one) for one in _either(wanted)):
            return name, value
    return "...", None


def _fits(value: Any, wanted: Any) -> bool:
    if isinstance(value, bool) or isinstance(wanted, inspect.BoolType):
        return isinstance(value, bool) and isinstance(wanted, inspect.BoolType)
    if isinstance(wanted, inspect.StrType):
        return isinstance(value, str)
    if not isinstance(value, int if isinstance(wanted, inspect.IntType) else int | float):
        return False
    low, high = (wanted.gt, wanted.ge), (wanted.lt, wanted.le)
    return (
        (low[0] is None or value > low[0])
        and (low[1] is None or value >= low[1])
        and (high[0] is None or value < high[0])
        and (high[1] is None or value <= high[1])
    )


def _instead(name: str, wanted: Any) -> str:
    known = [field.encode_name for field in _fields(wanted)]
    near = difflib.get_close_matches(name, known, n=1)
    return (f"; did you mean {near[0]!r}?" if near else ";") + f" valid: {', '.join(known)}"


def _shown(value: Any) -> str:
    """A value as a cell file writes it, without secrets."""
    value = without_secrets(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    text = f'"{value}"' if isinstance(value, str) else f"{value!r}"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _words(wanted: Any) -> str:
    """Valid values of a type, as text."""
    words = [_word(one) for one in _either(wanted) if not isinstance(one, inspect.NoneType)]
    return " or ".join(dict.fromkeys(words))


def _word(wanted: Any) -> str:
    match wanted:
        case inspect.LiteralType():
            return " or ".join(_shown(value) for value in sorted(wanted.values, key=str))
        case inspect.IntType() | inspect.FloatType():
            return f"{'an integer' if isinstance(wanted, inspect.IntType) else 'a number'}{_range(wanted)}"
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType():
            return "a text in quotes" + (f" that matches {wanted.pattern}" if wanted.pattern else "")
        case inspect.DictType():
            return f"a table of {{ NAME = {_words(wanted.value_type)} }}"
        case inspect.VarTupleType() | inspect.ListType() if isinstance(wanted.item_type, inspect.StructType):
            return f"one table in double brackets each, with {_keys(wanted.item_type)}"
        case inspect.VarTupleType() | inspect.ListType():
            return f"a list in brackets, of {_words(wanted.item_type)}"
        case inspect.StructType():
            return f"a table with {_keys(wanted)}"
    return "another type"


def _keys(wanted: Any) -> str:
    return ", ".join(
        [field.encode_name for field in _fields(wanted) if field.required]
        or [field.encode_name for field in _fields(wanted)]
    )


def _range(number: Any) -> str:
    low = f"from {number.ge:g}" if number.ge is not None else f"above {number.gt:g}" if number.gt is not None else ""
    if number.ge is not None and number.le is None:
        return f" of at least {number.ge:g}"
    if number.le is not None:
        return f" {low or 'up'} to {_plain(number.le)}"
    return f" {low}" if low else ""


def _plain(value: float) -> str:
    return str(int(value)) if value == int(value) else f"{value:g}"
