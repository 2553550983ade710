"""Orders to an emulator as text: a verb, its words, and when; each emulator has a grammar of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from stereoservo_sim.emulation.errors import OrderError
from stereoservo_sim.emulation.times import duration_ns

Grammar = Mapping[str, tuple[Callable[..., object], str, str]]
"""Verb -> parser of its words, usage, meaning."""


def split_order(text: str, grammar: Grammar) -> tuple[str, list[str], int | None]:
    """Verb, words and time [ns] (None: at once) of an order such as ``freeze left @ 1.5s``. Raises OrderError."""
    body, at, when = text.partition("@")
    words = body.split()
    if not words:
        raise OrderError(f"an empty order; orders: {', '.join(grammar)}")
    verb = words[0].lower()
    if verb not in grammar:
        raise OrderError(f"no order {words[0]!r}; orders: {', '.join(grammar)} (`help` explains them)")
    try:
        return verb, words[1:], duration_ns(when.strip()) if at else None
    except OrderError as error:
        raise misused(text, verb, grammar, error) from None


def misused(text: str, verb: str, grammar: Grammar, error: OrderError) -> OrderError:
    """The same error with the order and its usage."""
    return OrderError(f"{text.strip()!r}: {error}; usage: {grammar[verb][1]}")


def usage_lines(grammar: Grammar, *further: tuple[str, str]) -> list[str]:
    """One line an order, and one for each of ``further`` (usage, meaning)."""
    rows = [(usage, meaning) for _, usage, meaning in grammar.values()]
    width = max(len(usage) for usage, _ in rows)
    return [f"{usage:<{width}}  {meaning}" for usage, meaning in (*rows, *further)]
