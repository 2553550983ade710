"""Every command of the documents is executed, page by page and in order, on fake cells of the names that it uses.

A command that cannot run here, or takes minutes, has a directive with its reason in `tests/documents.toml`.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from documented import PAGES, ROOT, Documented, documented, snippets
from oracles.waved_bodies import rendered_pictures
from stereoservo.cli import main as cli
from stereoservo.client import Client
from stereoservo.messages.directories import cell_directories
from stereoservo.messages.discovery import DaemonProcess

from .conftest import CELL, eventually, recover

pytestmark = pytest.mark.process
FAKES = ("mycell", "demo", "workpiece")
"""Names of cells in the documents, each played by the fake cell."""
GOALS = ("dock", "place", "pick", "insert")
"""Taught before a page is begun, as its reader has."""
SHELL = ("openssl", "printf")
"""Programs besides `stereoservo` that are run."""
SERVERS = ("watch", "web", "emulate")
"""Commands that run until Ctrl-C."""
QUICK = "README.md"
"""The page of the ordinary suite; the others are slow."""


class Desk:
    """A reader's terminal: a directory with the files that the page presumes, and the daemons that it has started."""

    def __init__(self, folder: Path, cell_file: Path) -> None:
        self.folder, self.daemons = folder, {}
        self.calibrated: set[str] = set()
        self.goal = ""
        text = cell_file.read_text(encoding="utf-8")
        (folder / "deploy" / "cells").mkdir(parents=True)
        for name in FAKES:
            own = text.replace(f'name = "{CELL}"', f'name = "{name}"')
            assert own != text
            for place in (folder, folder / "deploy" / "cells"):
                (place / f"{name}.toml").write_text(own, encoding="utf-8")
        for name in ("hil-can", "hil-video"):
            shutil.copy(ROOT / "deploy" / "cells" / f"{name}.toml", folder / "deploy" / "cells")
        nowhere = {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "basis": [0, 1, 2, 4, 7]}
        (folder / "step.json").write_text(json.dumps(nowhere), encoding="utf-8")
        self._given = set(folder.iterdir())

    def tidied(self) -> None:
        """Remove what a page has left, also one that failed and is tried again; daemons keep their logs."""
        for path in set(self.folder.iterdir()) - self._given:
            if path.is_dir():
                shutil.rmtree(path)
            elif path.suffix != ".log":
                path.unlink()

    def prepared(self, name: str, calibrates: bool = False) -> None:
        """A daemon of that cell that has calibrated itself, unless the page ``calibrates`` it, and knows the goals."""
        if name not in self.daemons or self.daemons[name].process.poll() is not None:
            self.started(name, self.folder / f"{name}.toml")
        with Client(name) as client:
            recover(client)
            if name not in self.calibrated and not calibrates:
                assert client.calibrate(timeout_s=240.0).covariance_ok
                self.taught(client, name)

    def taught(self, client: Client, name: str) -> None:
        """Teach the goals that a page presumes, with the model that the cell has now."""
        for goal in GOALS:
            client.teach(goal, frames=3)
        self.calibrated.add(name)

    def started(self, name: str, file: Path, *options: str) -> None:
        """A daemon of that cell in place of the one that runs."""
        self.stopped(name)
        self.daemons[name] = DaemonProcess(file, options=options, log=self.folder / f"{name}.log")
        try:
            self.daemons[name].wait_ready()
        except BaseException:  # a page that is tried again starts another
            self.stopped(name)
            raise

    def stopped(self, name: str) -> None:
        if name in self.daemons:
            self.daemons.pop(name).stop()

    def run(self, command: str) -> tuple[int, str]:
        """Execute one command line; its exit code and what it printed."""
        words = shlex.split(self.filled(command))
        if words[0] in SHELL:
            return self.program(["bash", "-c", command])
        assert words[0] == "stereoservo", f"{command}: no such program here: it needs a line in tests/documents.toml"
        words = words[1:]
        if words[0] == "run":
            name = Path(words[1]).stem  # a shipped cell, by its name alone, is played by a fake as well
            self.started(name, self.folder / f"{name}.toml", *words[2:])
            return 0, ""
        if "flight.mcap" in words and not (self.folder / "flight.mcap").exists():
            _, said = self.invoked(["record", "mycell", "--seconds", "1", "--json"])
            shutil.copy(json.loads(said.splitlines()[-1])["file"], self.folder / "flight.mcap")
        if words[0] in SERVERS:
            return self.served([sys.executable, "-m", "stereoservo.cli.main", *words])
        if words[0] == "init":
            (self.folder / words[1]).rename(self.folder / "kept")
        if words[0] == "setup":  # what a person would answer on the terminal
            (self.folder / "answers.toml").write_text('calibrate = "yes"\ngo = "yes"\n', encoding="utf-8")
            words += ["--answers", "answers.toml"]
        if "--rig" in words and not (self.folder / "pictures").exists():
            rendered_pictures(5, self.folder / "pictures", places=9)
        if words[0] == "acknowledge":  # once the goal waits, which `--no-wait` has not waited for
            eventually("an acknowledgement", lambda: self.invoked(words)[0] == 0)
            return 0, ""
        done = self.invoked(words)
        if words[0] == "init":
            (self.folder / "kept").replace(self.folder / words[1])
        if words[0] == "calibrate" and done[0] == 0 and not {"--check", "--rig"} & set(words):
            with Client(words[1]) as client:
                self.taught(client, words[1])
        return done

    def filled(self, command: str) -> str:
        """The command with values in place of what stands for one, and without the brackets of what may be left out."""
        values = {"CELL.toml": "mycell.toml", "CELL": "mycell", "ID": self.goal, "DIR": "seen"}
        command = command.replace("[", "").replace("]", "").removesuffix("&").strip()
        return re.sub(r"(?<=\s)(CELL\.toml|CELL|ID|DIR)\b", lambda found: values[found[0]], command)

    def program(self, words: list[str]) -> tuple[int, str]:
        done = subprocess.run(
            words, cwd=self.folder, check=False, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=240,
        )  # fmt: skip
        return done.returncode, done.stdout

    def invoked(self, words: list[str]) -> tuple[int, str]:
        """A command in this process, which saves the start of one."""
        said = io.StringIO()
        with contextlib.chdir(self.folder), redirect_stdout(said), redirect_stderr(said):
            code = cli.invoke(words)
        if "--acknowledge" in words:
            (self.goal,) = re.findall(r"goal ([0-9a-f-]{36})", said.getvalue())
        return code, said.getvalue()

    def served(self, words: list[str]) -> tuple[int, str]:
        """A server that is ended by Ctrl-C once it has said where it is, as people do."""
        with tempfile.TemporaryFile("w+") as out:
            child = subprocess.Popen(words, cwd=self.folder, stdin=subprocess.PIPE, stdout=out, stderr=out)
            try:
                eventually("a word", lambda: os.fstat(out.fileno()).st_size or child.poll() is not None, 60.0)
                time.sleep(0.5)
                if child.poll() is None:
                    child.send_signal(signal.SIGINT)
                code = child.wait(60)
            finally:
                child.kill()
            out.seek(0)
            return (0 if code in (0, 130, -signal.SIGINT) else code), out.read()


@pytest.fixture(scope="module")
def desk(cell_file: Path, roots: Path) -> Iterator[Desk]:
    """Where all pages are worked through; whatever it started ends with it."""
    folder = roots / "desk"
    folder.mkdir()
    with ExitStack() as stack:
        desk = Desk(folder, cell_file)
        for name in FAKES:
            stack.callback(desk.stopped, name)
        yield desk


def runs(page: Path, slow: bool) -> list[Documented]:
    """Commands of a page that are to be executed, with those that are ``slow`` or without."""
    return [one for one in documented(page) if one.directive is None or (slow and one.directive.kind == "slow")]


def pages(with_something: Callable[[Path], bool]) -> list[object]:
    """Pages that have something to be tried, as parameters; all but one are slow."""
    return [
        pytest.param(page, id=page.name, marks=() if page.name == QUICK else pytest.mark.slow)
        for page in PAGES
        if with_something(page)
    ]


def worked_through(page: Path, desk: Desk, slow: bool) -> None:
    """Execute the commands of a page, each of which is to succeed."""
    found = runs(page, slow)
    desk.tidied()
    for name in FAKES:
        mine = [one.command for one in found if re.search(rf"\b{name}\b", desk.filled(one.command))]
        if mine:
            desk.prepared(name, calibrates=f"stereoservo calibrate {name}" in mine)
    for one in found:
        code, said = desk.run(one.command)
        assert code == 0, f"{page.name}, line {one.line}: {one.command}\n{said}"


@pytest.mark.timeout(900)
@pytest.mark.parametrize("page", pages(lambda page: bool(runs(page, True))))
def test_the_commands_of_a_page_do_what_it_says(page: Path, desk: Desk) -> None:
    worked_through(page, desk, slow=page.name != QUICK)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_slow_commands_of_the_readme_do_what_it_says(desk: Desk) -> None:
    worked_through(ROOT / QUICK, desk, slow=True)


def test_a_shell_completes_live_cells_and_taught_goals(desk: Desk) -> None:
    desk.prepared("mycell")
    for words, offered in (("status my", "mycell"), ("goal mycell do", "dock")):
        done = subprocess.run(
            [sys.executable, "-m", "stereoservo.cli.main"], check=True, text=True, capture_output=True, timeout=240,
            env={**os.environ, "_STEREOSERVO_COMPLETE": "complete_bash", "COMP_WORDS": f"stereoservo {words}",
                 "COMP_CWORD": str(len(words.split()))},
        )  # fmt: skip
        assert done.stdout.split() == [offered]


@pytest.mark.parametrize("page", pages(lambda page: bool(snippets(page))))
def test_the_clients_of_a_page_run(page: Path, desk: Desk) -> None:
    """Python blocks that speak to a cell, as they stand there."""
    for line, source in snippets(page):
        (name,) = set(re.findall(r'Client\("(\w+)"\)|stereoservo/v1/(\w+)/', source)[0]) - {""}
        desk.prepared(name)
        socket = cell_directories(name).runtime / "zenoh.sock"
        source = source.replace(f"/run/user/1000/stereoservo/{name}/zenoh.sock", str(socket))
        said = io.StringIO()
        with redirect_stdout(said):
            exec(compile(source, f"{page.name}, line {line}", "exec"), {})
        assert said.getvalue().strip(), f"{page.name}, line {line} printed nothing"
