"""What moves between emulated drives and arm, against closed forms."""

import numpy as np
import pytest

from stereoservo_sim.emulators.bus.plant import AxisPlant, PlantSettings
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory
from stereoservo_sim.world.velocity_drives import IdealPlant

MS = 1_000_000


@pytest.fixture
def powered(scripted):
    """An axis with power and an open brake at rest at 0, and its plant."""
    axis = scripted.axis()
    axis.powered, axis.brake_closed, axis.acceleration = True, False, 4.0
    return axis, AxisPlant([axis], IdealPlant(np.zeros(1)), t_ns=0)


def run(plant, until_ms, start_ms=0):
    for t in range(start_ms + 1, until_ms + 1):
        plant.advance(t * MS)


def test_ramps_up_and_down_at_the_drives_acceleration(powered):
    axis, plant = powered
    axis.target = 0.5
    run(plant, 1)  # the command is in force from the first grid point after it
    run(plant, 51, 1)
    assert np.isclose(axis.velocity, 4.0 * 0.050)
    assert np.isclose(axis.position, 4.0 * 0.050**2 / 2)
    run(plant, 1001, 51)
    assert axis.velocity == 0.5
    assert np.isclose(axis.position, 0.5 * 1.0 - 0.5 * 0.125 / 2)
    axis.target = 0.0
    start = axis.position
    run(plant, 1300, 1001)
    assert axis.velocity == 0.0
    assert np.isclose(axis.position - start, 0.5 * 0.001 + 0.5**2 / (2 * 4.0))
    assert axis.following_error == 0.0


def test_a_command_never_acts_before_it_came(powered):
    axis, plant = powered
    run(plant, 500)
    assert plant.due_ns(500 * MS) > 501 * MS  # at rest, steps are skipped
    axis.target = 0.5
    due = plant.due_ns(500 * MS + 300_000)
    assert due == 501 * MS
    plant.advance(due)
    assert axis.position == 0.0
    plant.advance(502 * MS)
    assert np.isclose(axis.position, 4.0 * 0.001**2 / 2)


def test_between_grid_points_an_axis_goes_on_at_its_velocity(powered):
    axis, plant = powered
    axis.target = 0.5
    run(plant, 500)
    before = axis.position
    plant.observe(500 * MS + 400_000)
    assert np.isclose(axis.position - before, 0.5 * 0.0004)
    assert np.isclose(axis.following_error, 0.0, atol=1e-12)
    plant.advance(501 * MS)
    assert np.isclose(axis.position - before, 0.5 * 0.001)


def test_a_brake_stops_a_moving_axis_within_its_time(powered):
    axis, plant = powered
    axis.target = 0.5
    run(plant, 300)
    start = axis.position
    axis.brake_closed = True
    run(plant, 300 + 21, 300)
    assert axis.velocity == 0.0
    way = 0.5 * 0.001 + 0.5 * 0.020 / 2
    assert np.isclose(axis.position - start, way)
    run(plant, 400, 321)
    assert np.isclose(axis.position - start, way)
    assert axis.set_position == axis.position


def test_without_power_and_brake_an_axis_coasts_down(powered):
    axis, plant = powered
    axis.target = 0.5
    run(plant, 300)
    start = axis.position
    axis.powered = False
    run(plant, 400, 300)
    assert axis.velocity == 0.0
    deceleration = PlantSettings().coast_deceleration
    assert np.isclose(axis.position - start, 0.5 * 0.001 + 0.5**2 / (2 * deceleration))
    assert axis.effort == 0.0


def test_a_blocked_axis_stands_while_its_drive_goes_on_and_pushes_to_saturation(powered):
    axis, plant = powered
    axis.target = 0.5
    run(plant, 300)
    held = axis.position + 0.5 * 0.001
    axis.blocked = True
    efforts = []
    for t in range(301, 601):
        plant.advance(t * MS)
        efforts.append(axis.effort)
    assert np.isclose(axis.position, held)
    assert axis.velocity == 0.0
    assert np.isclose(axis.set_position - held, 0.5 * 0.299)
    assert np.isclose(axis.following_error, 0.5 * 0.299)
    assert np.all(np.diff(efforts[5:]) >= 0)
    assert np.isclose(efforts[-1], PlantSettings().effort_max, rtol=1e-3)
    axis.blocked, axis.target = False, 0.0
    run(plant, 1200, 600)
    assert np.isclose(axis.position, axis.set_position)
    assert axis.velocity == 0.0
    assert axis.position > held + 0.1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_mechanical_stop_is_behind_the_limits_and_shows_like_a_contact(scripted, side):
    axis = scripted.axis(position=side * 1.9)
    axis.powered, axis.brake_closed, axis.acceleration, axis.target = True, False, 4.0, side * 1.0
    plant = AxisPlant([axis], IdealPlant(np.array([side * 1.9])), t_ns=0)
    run(plant, 1000)
    assert np.isclose(axis.position, side * (2.0 + PlantSettings().end_stop_margin))
    assert axis.velocity == 0.0
    assert axis.following_error * side > 0.3
    assert np.isclose(axis.effort, side * PlantSettings().effort_max, rtol=1e-3)


def test_efforts_of_a_massless_plant_are_inertia_friction_and_gravity(powered):
    axis, plant = powered
    s = PlantSettings()
    run(plant, 100)
    assert np.isclose(axis.effort, s.gravity)
    axis.target = 0.5
    run(plant, 160, 100)
    assert np.isclose(axis.effort, s.inertia * 4.0 + s.friction + s.gravity * np.cos(axis.position), rtol=1e-2)
    run(plant, 700, 160)
    assert np.isclose(axis.effort, s.friction + s.gravity * np.cos(axis.position), rtol=1e-2)


def test_the_truth_is_readable_and_goes_on_where_it_ended(powered, tmp_path, scripted):
    axis, _ = powered
    path = tmp_path / FILE_NAME
    plant = AxisPlant(
        [axis],
        IdealPlant(np.zeros(1)),
        t_ns=0,
        history=TrueJointHistory.create(path, 1, now_ns=0, capacity=1000),
    )
    axis.target = 0.5
    run(plant, 800)
    reader = TrueJointHistory.open(path)
    t_ns = 402_700_000
    moving = t_ns * 1e-9 - 0.125 - 0.001
    assert np.isclose(reader.at(t_ns)[0], 0.5 * 0.125 / 2 + 0.5 * moving, atol=1e-9)
    newest = reader.newest()
    assert newest[0] == 800 * MS
    assert np.isclose(newest[1][0], axis.position)
    plant.close()
    again = TrueJointHistory.create(path, 1, now_ns=900 * MS, capacity=1000)
    assert again.newest()[1][0] == newest[1][0]


def test_at_rest_the_truth_is_written_at_250_hz(powered):
    axis, _ = powered
    history = TrueJointHistory.in_memory(1)
    plant = AxisPlant([axis], IdealPlant(np.zeros(1)), t_ns=0, history=history)
    now = 0
    while now < 2_000 * MS:
        now = plant.due_ns(now)
        plant.advance(now)
    _, times, positions = history.since(0)
    assert set(np.diff(times)) == {4 * MS}
    assert not positions.any()


def test_pybullets_arm_follows_and_its_torques_come_in_shares_of_the_rating():
    from stereoservo_sim.emulators.nodes.node import EmulatedAxis
    from stereoservo_sim.world.physics import PybulletPlant
    from stereoservo_sim.world.simulated_cell import demo_cell

    cell = demo_cell()
    axes = [EmulatedAxis(joint, float(q)) for joint, q in zip(cell.robot.joints, cell.base, strict=True)]
    bodies = PybulletPlant(cell.robot, cell.base, 1e-3)
    asked = bodies.efforts.copy()
    rated = np.array([400.0, 400.0, 250.0, 80.0, 80.0, 40.0])
    plant = AxisPlant(axes, bodies, t_ns=0, rated=rated.tolist())
    for axis in axes:
        axis.powered, axis.brake_closed, axis.acceleration = True, False, 4.0
    run(plant, 60)
    assert np.allclose([axis.effort for axis in axes], asked / rated, atol=1e-4)
    axes[3].target = 0.4
    run(plant, 600, 60)
    assert np.isclose(axes[3].velocity, 0.4, atol=1e-3)
    assert np.isclose(axes[3].position - cell.base[3], 0.4 * (0.539 - 0.05), atol=2e-3)
    assert abs(axes[3].following_error) < 2e-3
    assert np.allclose([axes[k].position for k in (0, 1, 2, 4, 5)], np.delete(cell.base, 3), atol=1e-4)
    plant.close()
