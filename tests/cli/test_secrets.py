"""No secret of a cell file in what the service writes, planted in every option that can hold a text."""

from __future__ import annotations

import copy
import time
import tomllib
from pathlib import Path

import msgspec
import pytest

from stereoservo.cli import main as cli
from stereoservo.client.session import SessionError
from stereoservo.core.cycle import encode
from stereoservo.daemon.cell_preparation import describe_cell, make_plan
from stereoservo.daemon.channels.reports import Reporter
from stereoservo.daemon.ipc_messages import PlanOptions, load_plan, save_plan
from stereoservo.daemon.lockstep import MemoryVisionLinks
from stereoservo.daemon.process_control import write_log
from stereoservo.daemon.vision import CameraPipeline, camera_loop
from stereoservo.gateway.zenoh_config import gateway_config
from stereoservo.messages import addresses
from stereoservo.messages.addresses import keep_secret, redacted
from stereoservo.messages.cell_file import CellFileError, check_cell
from stereoservo.messages.locks import hardware_lock_path
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverError
from stereoservo_sim.cells import shipped_cell_path

SECRET = "Tulpe"
PLANTED = (
    f"http://operator:{SECRET}#77@127.0.0.1:9/video.mjpg",
    f"http://operator:{SECRET}/7@127.0.0.1:9/video.mjpg",
    f"operator:{SECRET}@10.0.0.1/x",
    f"rtsp://10.0.0.1/x?user=admin&password={SECRET}",
    f"socket://operator:{SECRET}@127.0.0.1:1",
    f"tls/operator:{SECRET}@router:7447",
)


def places(tree, path=()):
    """Paths to every text, list of texts and table of a cell file, with a key that no table has."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from places(value, (*path, key))
        yield (*path, "password")
    elif isinstance(tree, list):
        for number, value in enumerate(tree[:1]):
            yield from places(value, (*path, number))
    elif isinstance(tree, str) or path[-1] in ("source", "channel"):
        yield path


def planted(tree, path, value):
    tree = copy.deepcopy(tree)
    table = tree
    for step in path[:-1]:
        table = table[step]
    table[path[-1]] = value
    return tree


def told(error):
    return f"{error} {error!r} {vars(error)!r}"


@pytest.mark.parametrize("name", ["hil-video", "twist"])
def test_no_refusal_of_a_cell_file_shows_a_secret(name):
    """In drivers' options, detectors' options, names, endpoints, certificates; and where no key is known."""
    path = shipped_cell_path(name)
    tree = tomllib.loads(path.read_text())
    tree["zenoh"] = {"endpoints": ["tcp/127.0.0.1:7447"]}
    refused = {}
    for number, place in enumerate(places(tree)):
        text = PLANTED[number % len(PLANTED)]
        try:
            cell = check_cell(planted(tree, place, text), "cell.toml")
            gateway_config(cell, path.parent, Path("/run/cell.sock"))
            describe_cell(cell, path, Path("/run"), MonotonicClock())
        except (CellFileError, DriverError, plugins.PluginError, SessionError) as error:
            refused[place] = told(error)
    assert len(refused) >= 20
    assert not {place: text for place, text in refused.items() if SECRET in text}


def test_doctor_writes_no_secret(tmp_path, capfd):
    """To the terminal, to files and to their names: passwords with a '#', and cameras that do not answer."""
    head, _, rest = shipped_cell_path("demo").read_text().partition("[[camera]]")
    cameras = "".join(
        f'[[camera]]\nname = "{name}"\ndriver = "video"\ndetector = "dots"\n[camera.options]\nwidth = 64\nheight = 48\n'
        f'source = "http://operator:{SECRET}#77@127.0.0.1:9/{name}.mjpg"\n'
        for name in ("left", "right")
    )
    file = tmp_path / "cell.toml"
    file.write_text(head + cameras + rest[rest.index("[servo]") :])
    assert cli.invoke(["doctor", str(file), "--seconds", "0.2", "--json"]) == 1
    out = "".join(capfd.readouterr())
    assert "http://***@127.0.0.1:9/left.mjpg" in out
    assert SECRET not in out
    file.unlink()
    for written in tmp_path.rglob("*"):
        assert SECRET not in str(written)
        assert not written.is_file() or SECRET.encode() not in written.read_bytes()


class Quoting:
    """A driver of others, which quotes its options in what it raises."""

    def __init__(self, options, context):
        self.options = options

    def configure(self):
        raise DriverError("refused", f"{self.options}: no login as {self.options['token']}", url=self.options["url"])

    def deactivate(self):
        """Nothing moves."""

    def close(self):
        """Nothing is open."""


def test_what_a_foreign_driver_says_is_told_without_secrets(tmp_path, capfd):
    """In a process of the daemon, which has the cell from its plan: in errors, reports and the log."""
    options = {"url": f"http://operator:{SECRET}#77@cam/", "token": f"{SECRET}-token"}
    keep_secret(options)
    pipeline = CameraPipeline(Quoting(options, None), None, MemoryVisionLinks(), MonotonicClock())
    reports = []
    reporter = Reporter(tmp_path / "reports", "vision-left", MonotonicClock())

    def report(kind, message):
        reports.append((kind, message))
        reporter.report(kind, message)

    next(camera_loop(pipeline, report, time.monotonic_ns, camera="left", poll_s=0.01))
    ((kind, message),) = reports
    assert kind == "camera_lost"
    assert "http://***@cam/" in message
    with pytest.raises(DriverError) as caught:
        Quoting(options, None).configure()
    write_log("vision", f"zenoh's own words: {options['url']} by operator:{SECRET}#77")
    written = "".join(capfd.readouterr())
    assert "zenoh's own words: http://***@cam/ by ***" in written
    assert SECRET not in written + message + told(caught.value)


def test_a_plan_that_is_read_keeps_its_secrets(tmp_path):
    """No recording and no lock file has them; the plan itself is in the daemon's own directory, which others cannot
    read.
    """
    tree = tomllib.loads(shipped_cell_path("hil-video").read_text())
    tree["camera"][0]["options"]["source"] = f"http://reader:{SECRET}-of-the-plan@127.0.0.1:9/left.mjpg"
    cell = check_cell(tree)
    plan = make_plan(shipped_cell_path("hil-video"), tmp_path, tmp_path, PlanOptions("doctor"))
    plan = msgspec.structs.replace(plan, cell=cell)
    save_plan(plan)
    assert SECRET.encode() not in encode(plan.settings()), "a recording begins with these"
    options = cell.camera[0].options
    assert SECRET not in str(hardware_lock_path(tmp_path, "video", options))
    addresses._kept.clear()
    load_plan(tmp_path)
    assert redacted(f"reader:{SECRET}-of-the-plan") == "***"
