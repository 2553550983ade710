"""What ``--help`` tells of the commands beside their own texts: the group and an example of each."""

from __future__ import annotations

GROUPS: dict[str, tuple[str, ...]] = {
    "Set up": (
        "setup",
        "init",
        "doctor",
        "drivers",
        "print-plate",
        "learn-corners",
        "driver-check",
        "warmup",
    ),
    "Run": ("run", "status", "ls", "enable", "disable", "reset", "hold", "resume", "stop"),
    "Move": ("calibrate", "teach", "goal", "ik", "acknowledge", "cancel", "jog", "home", "auxiliary"),
    "Look": ("watch", "web", "record", "replay", "export", "examine"),
    "Simulate and measure": ("demo", "emulate", "simulate", "reproduce", "bench"),
}
"""Headings and their commands, in the order in which they are needed; any other command stands below ``OTHERS``."""
OTHERS = "Others"
EXAMPLES: dict[str, str] = {
    "setup": "setup mycell.toml",
    "init": "init mycell.toml",
    "doctor": "doctor mycell.toml",
    "drivers": "drivers",
    "print-plate": "print-plate plate.pdf",
    "learn-corners": "learn-corners mycell.toml landmarks.npz --ask-to-move",
    "driver-check": "driver-check mycell.toml",
    "warmup": "warmup demo",
    "run": "run mycell.toml --commissioning",
    "status": "status mycell",
    "ls": "ls",
    "enable": "enable mycell",
    "disable": "disable mycell",
    "reset": "reset mycell",
    "hold": "hold mycell",
    "resume": "resume mycell",
    "stop": "stop mycell",
    "calibrate": "calibrate mycell --check",
    "teach": "teach mycell dock",
    "goal": "goal mycell dock --check",
    "ik": "ik mycell dock",
    "acknowledge": "acknowledge mycell ID",
    "cancel": "cancel mycell",
    "jog": "jog mycell j1=0.05 --seconds 1",
    "home": "home mycell",
    "auxiliary": "auxiliary mycell gripper=0.04",
    "watch": "watch mycell",
    "web": "web mycell --operate ann",
    "record": "record mycell --images --seconds 60",
    "replay": "replay flight.mcap",
    "export": "export flight.mcap",
    "examine": "examine flight.mcap",
    "demo": "demo --lockstep",
    "emulate": "emulate drives hil-can",
    "simulate": "simulate TASKS.csv --law cartesian3",
    "reproduce": "reproduce all --html thesis.html",
    "bench": "bench cycle --json",
}
"""By command, without the program's name."""


def grouped(names: list[str]) -> list[tuple[str, list[str]]]:
    """Headings with those of the commands that are there; what is in no group comes last."""
    known = {name for members in GROUPS.values() for name in members}
    groups = [(heading, [name for name in members if name in names]) for heading, members in GROUPS.items()]
    groups.append((OTHERS, [name for name in names if name not in known]))
    return [(heading, members) for heading, members in groups if members]
