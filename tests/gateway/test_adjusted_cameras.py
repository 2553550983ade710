"""Mobile cameras that stand elsewhere: the gateway's model, and its file, follow."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereoservo.core.cycle import Event
from stereoservo.gateway.model_updates import RelocalizationJobs
from stereoservo.gateway.persistence import ModelStore
from stereoservo.kinematics.model import CellModel, load_model, save_model
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import rx90

MATRIX = np.array([[800.0, 1.0, 320.0, 3.0], [2.0, 790.0, 240.0, -4.0], [0.0, 0.01, 1.0, 1.5]])


class Log:
    """Keeps what is told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, Any]] = []

    def add(self, kind: str, **fields: Any) -> None:
        self.told.append((kind, fields))


@pytest.fixture
def gateway(tmp_path: Path) -> Any:
    model = exact_model(rx90())
    bench = SimpleNamespace(models=ModelStore(tmp_path), log=Log(), model=model)
    save_model(model, bench.models.path(model.epoch))
    bench.reanchoring = RelocalizationJobs(
        bench.models,
        None,
        bench.log,
        lambda: bench.model,
        lambda taken: setattr(bench, "model", taken),
    )
    return bench


def adjusted(model: CellModel, epoch: int) -> Event:
    return Event(5, 1, "camera_adjusted", name=model.cameras[1].name, matrix=MATRIX, epoch=epoch)


def test_camera_that_stands_elsewhere_is_so_in_the_model_and_in_its_file(gateway: Any) -> None:
    before = gateway.model
    gateway.reanchoring.on_core_event(adjusted(before, before.epoch), fresh=True)
    for model in (gateway.model, load_model(gateway.models.path(before.epoch))):
        assert np.array_equal(model.cameras[1].matrix, MATRIX)
        assert np.array_equal(model.cameras[0].matrix, before.cameras[0].matrix)
        assert np.array_equal(model.generators, before.generators)
    assert not gateway.log.told


@pytest.mark.parametrize(("ahead", "fresh"), [(1, True), (0, False)])
def test_of_another_model_or_told_again_it_changes_nothing(gateway: Any, ahead: int, fresh: bool) -> None:
    before = gateway.model
    gateway.reanchoring.on_core_event(adjusted(before, before.epoch + ahead), fresh=fresh)
    assert gateway.model is before


def test_file_that_cannot_be_written_is_reported(gateway: Any, tmp_path: Path) -> None:
    before = gateway.model
    path = gateway.models.path(before.epoch)
    path.unlink()
    path.mkdir()
    gateway.reanchoring.on_core_event(adjusted(before, before.epoch), fresh=True)
    assert np.array_equal(gateway.model.cameras[1].matrix, MATRIX)
    ((kind, fields),) = gateway.log.told
    assert kind == "warning"
    assert before.cameras[1].name in fields["message"]
