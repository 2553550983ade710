"""Plans and progress of goals in words, for people."""

from __future__ import annotations

from stereoservo.gateway.messages import StateMessage
from stereoservo.runtime.commands import Approach, PlanReport


def plan_table(plan: PlanReport) -> str:
    """Way, time, and the closest approach to every limit."""
    lines = [f"law {plan.law}, way {plan.way}, {plan.seconds:.2f} s"]
    if not plan.approaches:
        return lines[0]
    rows: list[tuple[str, ...]] = [("limit", "of", "nearest", "limit at", "room", "on the way")]
    rows += [_row(approach) for approach in plan.approaches]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines += [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join(lines)


def _row(approach: Approach) -> tuple[str, ...]:
    unit = approach.unit
    of = approach.subject if approach.marker is None else f"{approach.subject}, marker {approach.marker}"
    return (
        approach.code,
        of,
        f"{approach.value:.4g} {unit}",
        f"{approach.limit:.4g} {unit}",
        f"{approach.room:.4g} {unit}",
        f"{100.0 * approach.share:.0f} %",
    )


def progress_words(state: StateMessage) -> str:
    """How far the active goal is; empty where nothing is known of it."""
    words = []
    if state.progress is not None:
        words.append(f"{100.0 * state.progress:.0f} % of its way")
    if state.seconds_left is not None:
        words.append(f"{state.seconds_left:.1f} s left")
    if state.error_px is not None:
        words.append(f"error {state.error_px:.3f} px")
    return ", ".join(words)
