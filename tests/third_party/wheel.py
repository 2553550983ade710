"""Builds a wheel with a law of a third party and installs it into a folder, offline, as pip does it anywhere."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

LAW = "thirdparty"
SOURCE = Path(__file__).with_name("resolved_rates.py")


def build_wheel(folder: Path, entry_points: dict[str, str]) -> Path:
    """A wheel that holds `SOURCE` as the module ``resolved_rates`` and offers laws by name -> object."""
    info = "resolved_rates-1.2.dist-info"
    files = {
        "resolved_rates.py": SOURCE.read_text(),
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: resolved-rates\nVersion: 1.2\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": "[stereoservo.laws]\n"
        + "".join(f"{name} = {value}\n" for name, value in entry_points.items()),
    }
    record = f"{info}/RECORD"
    path = folder / "resolved_rates-1.2-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        for name, text in files.items():
            wheel.writestr(name, text)
        wheel.writestr(record, "".join(f"{name},,\n" for name in (*files, record)))
    return path


def install_law(folder: Path, **more: str) -> Path:
    """A folder for PYTHONPATH in which the law `LAW` is installed, and ``more`` laws: name="module:object"."""
    target = folder / "site"
    wheel = build_wheel(folder, {LAW: "resolved_rates:LAW", **more})
    options = ("--quiet", "--no-deps", "--no-index", "--target", str(target))
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, str(wheel)],
        check=True,
        capture_output=True,
        timeout=120,
    )
    return target
