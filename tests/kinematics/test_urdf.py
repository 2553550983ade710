"""Models as URDF, read back by pybullet: markers and cameras where the model has them."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from stereoservo.cli.main import invoke
from stereoservo.kinematics.denavit_hartenberg import ReadOutError, denavit_hartenberg
from stereoservo.kinematics.model import save_model
from stereoservo.kinematics.urdf import metric_arm, urdf_text
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.known_length import KnownLength, known_length_of
from stereoservo_drivers.twist import seen_as_joints
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.truth import true_cell
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.physics import import_pybullet
from stereoservo_sim.world.robots import flange_pose
from stereoservo_sim.world.simulated_cell import SimulatedCell


def cell_named(name: str) -> SimulatedCell:
    path = shipped_cell_path(name)
    file = load_cell_file(path)
    cell = true_cell(file, path.parent)
    return seen_as_joints(file.joints.options, cell) if name == "twist" else cell


def links_of(path: Path, names: tuple[str, ...], q: np.ndarray) -> dict[str, np.ndarray]:
    """Poses (4, 4) of all links in the root, as pybullet computes them."""
    bullet = import_pybullet()
    client = bullet.connect(bullet.DIRECT)
    try:
        body = bullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
        infos = [bullet.getJointInfo(body, k, physicsClientId=client) for k in range(bullet.getNumJoints(body, client))]
        for info in infos:
            if info[1].decode() in names:
                value = float(q[names.index(info[1].decode())])
                bullet.resetJointState(body, info[0], value, physicsClientId=client)
        poses = {}
        for info in infos:
            state = bullet.getLinkState(body, info[0], computeForwardKinematics=True, physicsClientId=client)
            pose = np.eye(4)
            pose[:3, :3] = np.array(bullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
            pose[:3, 3] = state[4]
            poses[info[12].decode()] = pose
        return poses
    finally:
        bullet.disconnect(client)


@pytest.mark.parametrize("name", ["demo", "eye_in_hand", "panda", "scara", "gantry", "pan_tilt", "twist"])
def test_pybullet_reads_the_model_back_and_sees_what_it_sees(tmp_path: Path, name: str) -> None:
    """Markers in the frames of the cameras are where the truth has them, at other joints."""
    cell = cell_named(name)
    model = exact_simulated_model(cell, 3)
    ids = model.marker_ids
    a, b = cell.body.marker_points[0], cell.body.marker_points[-1]
    known = KnownLength("markers", (ids[0], ids[-1]), float(np.linalg.norm(a - b)))
    arm = metric_arm(model, known)
    path = tmp_path / "arm.urdf"
    path.write_text(urdf_text(model, arm, "arm", {}))
    assert arm.scales == pytest.approx(1.0, abs=1e-9)
    rng = np.random.default_rng(1)
    for _ in range(4):
        q = cell.base + rng.uniform(-0.3, 0.3, len(cell.base)) * np.where(cell.robot.prismatic, 0.3, 1.0)
        links = links_of(path, model.joint_names, q)
        points = np.array([links[f"marker_{k}"][:3, 3] for k in ids])
        between = np.linalg.norm(points[:, None] - points[None], axis=2)
        body = cell.body.marker_points
        assert np.allclose(
            between, np.linalg.norm(body[:, None] - body[None], axis=2), atol=2e-6
        )  # pybullet computes in single precision
        for camera in cell.rig.cameras:
            pose = links[f"camera_{camera.name}"]
            here = (points - pose[:3, 3]) @ pose[:3, :3]
            true = cell.in_world(camera, q)
            there = cell.marker_positions(q) @ true.world_to_camera[:3, :3].T + true.world_to_camera[:3, 3]
            assert np.allclose(here, there, atol=2e-6)  # pybullet computes in single precision


def test_the_base_of_an_arm_that_takes_twists_is_the_robots_own() -> None:
    """Cameras stand in the root frame where they stand in the frame in which the robot tells its poses."""
    cell = cell_named("twist")
    model = exact_simulated_model(cell, 5)
    arm = metric_arm(model, KnownLength("prismatic", (model.joint_names[0],), 1.0))
    base = np.linalg.inv(cell.robot.base @ np.eye(4)[:, [2, 0, 1, 3]])
    for pose, camera in zip(arm.cameras, cell.rig.cameras, strict=True):
        assert np.allclose(pose, base @ np.linalg.inv(camera.world_to_camera), atol=1e-9)
    assert np.allclose(flange_pose(cell.robot, np.zeros(6))[:3, 3], cell.robot.mounted[:3, 3], atol=1e-12)


def test_the_command_writes_it_with_the_limits_of_the_cell_and_asks_for_a_length(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = exact_simulated_model(cell_named("demo"), 3)
    save_model(model, tmp_path / "m.json")
    out = tmp_path / "arm.urdf"
    assert invoke(["export", str(tmp_path / "m.json"), "--urdf", str(out), "--json"]) == 1
    assert "turning joints alone" in msgspec.json.decode(capsys.readouterr().out)["error"]["message"]
    length = f"markers:{model.marker_ids[0]},{model.marker_ids[1]}=0.05"
    cell = str(shipped_cell_path("demo"))
    command = [
        "export",
        str(tmp_path / "m.json"),
        "--urdf",
        str(out),
        "--length",
        length,
        "--cell",
        cell,
        "--json",
    ]
    assert invoke(command) == 0
    assert msgspec.json.decode(capsys.readouterr().out)["joints"] == list(model.joint_names)
    limit = load_cell_file(shipped_cell_path("demo")).safety.limit[0]
    assert f'lower="{limit.min!r}" upper="{limit.max!r}"' in out.read_text()
    stated = tmp_path / "cell.toml"
    text = Path(cell).read_text(encoding="utf-8")
    stated.write_text(text.replace("[calibration]\n", f'[calibration]\nknown_length = "{length}"\n', 1))
    assert invoke(["export", str(tmp_path / "m.json"), "--dh", "--cell", str(stated), "--json"]) == 0
    told = msgspec.json.decode(capsys.readouterr().out)
    assert told["known"]["metres"] == 0.05
    for one in told["structure"]:
        assert one["holds"]
        assert set(one["joints"]) <= set(model.joint_names)
    rows = denavit_hartenberg(model, known_length_of(length))
    assert [row["a"] for row in told["denavit_hartenberg"]] == [row.a for row in rows]
    with pytest.raises(ReadOutError, match="99"):
        metric_arm(model, KnownLength("markers", (99, model.marker_ids[0]), 0.05))
