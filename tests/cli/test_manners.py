"""Help in groups with examples, shell completion, colour, plain lines of progress, where state is kept."""

import io
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from stereoservo.cli.calibrate.command import TRIALS_SHARE, _telling
from stereoservo.cli.dispatch import COMMANDS, OTHERS, OWN, app, example_of, grouped
from stereoservo.cli.output import cells_beginning, coloured, log
from stereoservo.messages.directories import state_root
from stereoservo.messages.learning import tenths
from stereoservo.messages.wire import EventMessage
from stereoservo.ports import plugins
from stereoservo_sim.progress import LINE_EVERY_S, progress_lines


def completed(words: str, shell: str = "bash", **environment: str) -> list[str]:
    """What the program offers a shell whose line ends with the last of these words."""
    done = subprocess.run(
        [sys.executable, "-m", "stereoservo.cli.main"], capture_output=True, text=True, check=True, timeout=240,
        env={**os.environ, "_STEREOSERVO_COMPLETE": f"complete_{shell}", "COMP_WORDS": f"stereoservo {words}",
             "COMP_CWORD": str(len(words.split(" "))), **environment},
    )  # fmt: skip
    return done.stdout.split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_completion_script_is_produced(shell):
    done = subprocess.run(
        [sys.executable, "-m", "stereoservo.cli.main", "--show-completion", shell],
        capture_output=True, text=True, check=True, timeout=240,
        env={**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
    )  # fmt: skip
    assert "_STEREOSERVO_COMPLETE" in done.stdout
    assert f"complete_{shell}" in done.stdout


def test_verbs_options_and_files_are_completed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mycell.toml").touch()
    assert sorted(completed("re")) == ["record", "replay", "reproduce", "reset", "resume"]
    assert "--law" in completed("goal mycell --l")
    assert completed("status my") == ["mycell.toml"]
    assert cells_beginning("other") == []


def test_every_command_has_a_group_and_an_example_that_is_one():
    installed = [*OWN, *plugins.names(plugins.COMMANDS)]
    assert OTHERS not in dict(grouped(installed))
    assert dict(grouped([*installed, "third-party"]))[OTHERS] == ["third-party"]
    assert set(COMMANDS) == set(installed)
    group = get_command(app)
    context = group.make_context("stereoservo", [], resilient_parsing=True)
    for name in COMMANDS:
        example = example_of(name)
        words = shlex.split(example)
        assert words[0] == name
        verb = group.get_command(context, name)
        assert f"Example: stereoservo {example}" in verb.get_help(
            verb.make_context(name, [], parent=context, resilient_parsing=True)
        )
        verb.make_context(name, words[1:], parent=context)


def test_help_has_groups_and_cuts_nothing_off(capsys):
    get_command(app).main(["--help"], prog_name="stereoservo", standalone_mode=False, terminal_width=80)
    said = capsys.readouterr().out
    for heading, names in grouped(list(COMMANDS)):
        assert f"\n{heading}:\n" in said
        assert all(f"\n  {name} " in said for name in names)
    assert "..." not in said.partition("\n\n")[2]
    assert "…" not in said


def test_colour_is_for_terminals(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.delenv("NO_COLOR", raising=False)
    assert coloured("error:", "red", io.StringIO()) == "error:"
    assert coloured("error:", "red", Terminal()).startswith("\x1b[")
    monkeypatch.setenv("NO_COLOR", "1")
    assert coloured("error:", "red", Terminal()) == "error:"


def test_calibration_tells_its_progress_in_lines_without_a_terminal(capsys):
    progress = _telling("mycell", tenths(log, "calibrating:"))
    for share in (0.0, 0.01, 0.5, 0.51, 1.0):
        progress(EventMessage(1, "boot", 0, 0.0, "calibration", message="joint j1", progress=share))
    lines = capsys.readouterr().err.splitlines()
    reached = [int(10 * share * TRIALS_SHARE) for share in (0.5, 1.0)]
    assert lines == [f"calibrating: {10 * tenth} %: joint j1" for tenth in reached]
    progress(EventMessage(2, "boot", 0, 0.0, "held", message="held by ann"))
    assert capsys.readouterr().err == "held by ann: nothing moves until `stereoservo resume mycell`\n"


def test_experiments_tell_their_progress_in_lines_without_a_terminal():
    now, out = [0.0], io.StringIO()
    tell = progress_lines(out, lambda: now[0])
    for done in range(11):
        tell("seeds", done, 10)
        now[0] += LINE_EVERY_S / 2
    tell("seeds", 10, 10)
    assert out.getvalue().splitlines() == [f"seeds: {done} of 10" for done in (0, 2, 4, 6, 8, 10)]


def test_state_is_kept_where_the_desktop_says(monkeypatch):
    monkeypatch.delenv("STEREOSERVO_STATE_DIR", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", "/var/elsewhere")
    assert state_root() == Path("/var/elsewhere/stereoservo")
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    assert state_root() == Path.home() / ".local" / "state" / "stereoservo"
    monkeypatch.setenv("STEREOSERVO_STATE_DIR", "/srv/cells")
    assert state_root() == Path("/srv/cells")
