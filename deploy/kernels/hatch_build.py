"""Builds the distribution ``stereoservo-kernels``: has the installed stereoservo compile its kernels into an empty
cache, for each level of processors that runs here, and packs what numba wrote there.
"""

import os
import pickle
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

try:
    from stereoservo.numerics.kernel_cache import levels_here
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"{error}: kernels are compiled in an environment that holds the whole release: pip install '.[demo]' hatchling"
    ) from error

RUNS = (["warmup"], ["demo", "--lockstep", "--json"], ["bench", "features", "--json", "--repetitions", "1"])
"""Commands that run every kernel: of the loop; of the fit, and of dots; of all detectors."""
PACKED = """
import importlib.util, pickle, sys
from pathlib import Path
from numba.core.caching import UserProvidedCacheLocator
from stereoservo.daemon.kernel_compilation import ShippedRecord, compiled
from stereoservo.numerics.kernel_cache import file_hash

sources = {}
for name in ("stereoservo", "stereoservo_drivers", "stereoservo_sim"):
    root = Path(importlib.util.find_spec(name).origin).parent
    for file in sorted(root.rglob("*.py")):
        package = ".".join([name, *file.parent.relative_to(root).parts])
        folder = UserProvidedCacheLocator.get_suitable_cache_subpath(str(file))
        sources.setdefault(folder, package)
overloads = compiled()
modules = {overload.module for overload in overloads}
hashes = {module: file_hash(importlib.util.find_spec(module).origin) for module in modules}
record = ShippedRecord(ShippedRecord.maker(), hashes, overloads)
sys.stdout.buffer.write(pickle.dumps((sources, tuple(record))))
"""


class CompiledFor(MetadataHookInterface):
    """The same version as the stereoservo that is compiled, and that alone."""

    def update(self, metadata: dict[str, Any]) -> None:
        metadata["version"] = version("stereoservo")
        metadata["dependencies"] = [f"{name}=={version(name)}" for name in ("stereoservo", "numba", "llvmlite")]


class Kernels(BuildHookInterface):
    """The wheel's content: a folder for each package that has kernels, and the record of what is there."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        self._scratch = Path(tempfile.mkdtemp(prefix="stereoservo-kernels-"))
        cache, packed = self._scratch / "cache", self._scratch / "stereoservo_kernels"
        environment = os.environ | {
            "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(cache),
            "XDG_RUNTIME_DIR": str(self._scratch), "OPENBLAS_NUM_THREADS": "1",
        }  # fmt: skip

        def run(processor: str, *arguments: str) -> bytes:
            done = subprocess.run(
                [sys.executable, *arguments],
                env=environment | {"NUMBA_CPU_NAME": processor},
                cwd=self._scratch,
                stdout=subprocess.PIPE,
                check=True,
            )
            return done.stdout

        for processor in levels_here():
            for record in cache.rglob("compiled-*"):  # of the level before: nothing is compiled yet for this one
                record.unlink()
            for command in RUNS:
                run(processor, "-m", "stereoservo.cli.main", *command)
        packages, record = pickle.loads(run(processor, "-c", PACKED))
        for folder in cache.iterdir():
            if folder.name in packages:
                shutil.copytree(folder, packed / packages[folder.name], ignore=shutil.ignore_patterns("compiled-*"))
        (packed / "__init__.py").write_text('"""Compiled kernels of stereoservo."""\n')
        (packed / "compiled.pickle").write_bytes(pickle.dumps(record))
        build_data["force_include"][str(packed)] = "stereoservo_kernels"
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"cp{sys.version_info.major}{sys.version_info.minor}-none-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        shutil.rmtree(self._scratch)
