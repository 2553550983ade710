"""Construction of emulated buses from cell files: nodes of the cell's protocol, and the plant of
``[emulate.drives]``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

import stereoservo_drivers.canopen
from stereoservo.messages.cell_file import CellFile, Mount
from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.canopen.cia402_configuration import eds_path
from stereoservo_drivers.canopen.options import CanJoint, CanOptions, can_options
from stereoservo_drivers.options import invalid
from stereoservo_sim.emulators.bus.bus_emulator import BusEmulator
from stereoservo_sim.emulators.bus.plant import STEP_NS, AxisPlant, PlantBeside, PlantSettings
from stereoservo_sim.emulators.fault_engine import EmulationError
from stereoservo_sim.emulators.nodes.node import EmulatedAxis, EmulatedNode
from stereoservo_sim.world.arms.arm_cell import ArmPlace, cell_of, place_of
from stereoservo_sim.world.history import CAPACITY, FILE_NAME, HistoryError, TrueJointHistory
from stereoservo_sim.world.mechanics import MechanicalPlant, MechanicsOption, chosen_mechanics
from stereoservo_sim.world.simulated_cell import SimulatedCell
from stereoservo_sim.world.velocity_drives import IdealPlant, Plant

Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]

SHIPPED_EDS = Path(stereoservo_drivers.canopen.__file__).parent / "drive402.eds"
DEFAULT_RATED_TORQUE = 100.0
"""[N m] of a joint of the simulated arm if neither the driver's options nor ``[emulate.drives]`` state it."""


class DrivesSettings(ArmPlace, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Section ``[emulate.drives]`` of a cell file, with the options on the arm and its pose (`ArmPlace`).

    ``plant``: ``pybullet``, the simulated arm as rigid bodies (joints of its names), or ``ideal``, any joints, without
    mass. ``bit_time``: frames take their time on the wire. ``start``: initial positions by joint [rad or m];
    ``resume``: if the arm's truth file exists, start at its last positions. ``brake_ms``: time the brakes take to open
    and to close. ``rated_torques`` by joint [N m or N] if they differ from the driver's. ``eds``: of the emulated
    drives if it differs from the driver's, relative to the cell file. ``machine``: see PlantSettings.
    ``mechanics``: a preset, or imperfections by joint, see `stereoservo_sim.world.mechanics`; encoders have the
    driver's counts.
    """

    plant: Literal["pybullet", "ideal"] = "pybullet"
    bit_time: bool = False
    start: dict[str, float] = msgspec.field(default_factory=dict)
    resume: bool = True
    brake_ms: NonNegative = 50.0
    rated_torques: dict[str, Positive] = msgspec.field(default_factory=dict)
    eds: str = ""
    machine: PlantSettings = PlantSettings()
    mechanics: MechanicsOption = "none"


def drives_of_cell(cell: CellFile, cell_dir: Path = Path()) -> tuple[CanOptions, DrivesSettings]:
    """The CAN options and the emulation's settings of a cell in ``cell_dir``. Raises EmulationError, DriverError."""
    if cell.joints.driver != "canopen":
        raise EmulationError(
            f"cell {cell.cell.name!r}: joints.driver is {cell.joints.driver!r}; drives are emulated for 'canopen' "
            "(the shipped cell 'hil-can' is one)"
        )
    unknown = [name for name in cell.emulate if name not in ("drives", "cameras", "conveyor")]
    if unknown:
        raise EmulationError(
            f"cell {cell.cell.name!r}: emulate.{unknown[0]} is unknown; valid: emulate.drives, emulate.cameras, "
            "emulate.conveyor"
        )
    options = can_options(cell.joints.options, cell_dir)
    try:
        settings = msgspec.convert(cell.emulate.get("drives", {}), DrivesSettings)
    except msgspec.ValidationError as error:
        what = invalid(DrivesSettings, cell.emulate["drives"], error)
        raise EmulationError(f"cell {cell.cell.name!r}: emulate.drives: {what}") from error
    return options, settings


def make_bus_emulator(
    options: CanOptions,
    settings: DrivesSettings | None = None,
    *,
    t_ns: int,
    runtime_dir: Path | None = None,
    cell_dir: Path = Path(),
    mount: Mount = "eye_to_hand",
) -> BusEmulator:
    """The emulated drives of ``options``, switched on at ``t_ns``.

    ``runtime_dir``: folder of the arm's truth file; None: it is not written. ``cell_dir``: folder to which paths of EDS
    and URDF are relative. ``mount``: of the cell's cameras. Raises EmulationError.
    """
    settings = settings or DrivesSettings()
    names = [joint.name for joint in options.joint]
    for key, given in (("start", settings.start), ("rated_torques", settings.rated_torques)):
        for name in given:
            if name not in names:
                raise EmulationError(f"emulate.drives.{key}: no joint {name!r}; joints: {', '.join(names)}")
    history = _history(runtime_dir, len(names), t_ns)
    newest = history.newest() if history is not None and settings.resume else None
    arm = _arm(options, settings, mount, cell_dir)
    start = _start(options, settings, arm)
    positions = newest[1] if newest is not None else start
    plant, rated = _plant(options, settings, positions, arm)
    grippers = tuple(gripper.joint() for gripper in options.gripper)
    if grippers:  # all start open
        plant = PlantBeside(plant, IdealPlant(np.array([joint.position_max for joint in grippers])))
        rated = None if rated is None else [*rated, *([1.0] * len(grippers))]
    drives = (*options.joint, *grippers)
    axes = [EmulatedAxis(joint.spec(), float(q)) for joint, q in zip(drives, plant.motors, strict=True)]
    files = [
        *([_eds(options, settings, cell_dir)] * len(names)),
        *(eds_path(msgspec.structs.replace(options, eds=gripper.eds), cell_dir) for gripper in options.gripper),
    ]
    nodes = [_node(options, joint, axis, settings, eds) for joint, axis, eds in zip(drives, axes, files, strict=True)]
    moved = AxisPlant(axes, plant, settings.machine, t_ns=t_ns, history=history, rated=rated)
    return BusEmulator(nodes, moved, bitrate=options.bitrate if settings.bit_time else None, t_ns=t_ns)


def _eds(options: CanOptions, settings: DrivesSettings, cell_dir: Path) -> Path:
    named = settings.eds or options.eds
    path = cell_dir / named
    if not named or (path.name == SHIPPED_EDS.name and not path.exists()):
        return SHIPPED_EDS
    if not path.is_file():
        key = "emulate.drives.eds" if settings.eds else "joints.options.eds"
        raise EmulationError(f"{key} = {named!r}: there is no file {path}; leave eds out for the shipped one")
    return path


def _node(
    options: CanOptions, joint: CanJoint, axis: EmulatedAxis, settings: DrivesSettings, eds: Path
) -> EmulatedNode:
    if options.protocol == "odrive":
        from stereoservo_sim.emulators.nodes.odrive_node import OdriveNode

        return OdriveNode(joint.node_id, axis, joint)
    from stereoservo_sim.emulators.nodes.cia402_node import Cia402Node
    from stereoservo_sim.emulators.nodes.node import NodeSettings

    return Cia402Node(joint.node_id, axis, joint, eds=eds, settings=NodeSettings(brake_ms=settings.brake_ms))


def _arm(options: CanOptions, settings: DrivesSettings, mount: Mount, cell_dir: Path) -> SimulatedCell | None:
    """The simulated cell of the arm that the drives move; None for massless joints of other names."""
    if settings.plant == "ideal" and not settings.urdf:
        return None
    try:
        cell = cell_of(place_of(msgspec.to_builtins(settings)), mount, cell_dir)
    except ValueError as error:
        raise EmulationError(f"emulate.drives: {error}") from error
    names = tuple(joint.name for joint in options.joint)
    kinds = tuple(joint.kind for joint in options.joint)
    if names != cell.robot.joint_names or kinds != tuple(joint.kind for joint in cell.robot.joints):
        what = "emulate.drives.plant = 'pybullet'" if not settings.urdf else f"emulate.drives.urdf = {settings.urdf!r}"
        has = ", ".join(
            joint.name if joint.kind == "revolute" else f"{joint.name} ({joint.kind})" for joint in cell.robot.joints
        )
        raise EmulationError(
            f"{what} is the simulated arm with joints {has}; this cell has {', '.join(names)}: name them so, or take "
            "plant = 'ideal'" + "".join(f". {note}" for note in cell.robot.notes)
        )
    return cell


def _start(options: CanOptions, settings: DrivesSettings, arm: SimulatedCell | None) -> FloatArray:
    """Initial joint positions: as configured, else those of the simulated cell's base, else mid-range."""
    positions = np.array([min(max(0.0, joint.position_min), joint.position_max) for joint in options.joint])
    if arm is not None:
        positions = arm.base.copy()
    for k, joint in enumerate(options.joint):
        value = settings.start.get(joint.name, float(positions[k]))
        if not joint.position_min <= value <= joint.position_max:
            raise EmulationError(
                f"emulate.drives.start.{joint.name}: {value:g} is outside the joint's range, "
                f"{joint.position_min:g} to {joint.position_max:g}"
            )
        positions[k] = value
    return positions


def _plant(
    options: CanOptions, settings: DrivesSettings, positions: FloatArray, arm: SimulatedCell | None
) -> tuple[Plant, list[float] | None]:
    """The plant, and the rated torques to which its efforts are relative."""
    names = tuple(joint.name for joint in options.joint)
    try:
        mechanics = chosen_mechanics(settings.mechanics, names, [joint.kind == "prismatic" for joint in options.joint])
    except ValueError as error:
        raise EmulationError(f"emulate.drives.{error}") from error
    if settings.plant == "ideal":
        ideal = IdealPlant(positions)
        robot = None if arm is None else arm.robot
        return ideal if mechanics is None else MechanicalPlant(ideal, mechanics, robot), None
    from stereoservo_sim.world.physics import PhysicsError, PybulletPlant

    assert arm is not None  # plant "pybullet" has an arm
    robot = arm.robot
    ratings: Mapping[str, Any] = settings.rated_torques
    rated = [float(ratings.get(joint.name) or joint.rated_torque or DEFAULT_RATED_TORQUE) for joint in options.joint]
    try:
        links = PybulletPlant(robot, positions, STEP_NS * 1e-9)
    except PhysicsError as error:
        raise EmulationError(str(error)) from error
    return links if mechanics is None else MechanicalPlant(links, mechanics, robot), rated


def _history(runtime_dir: Path | None, joints: int, t_ns: int) -> TrueJointHistory | None:
    if runtime_dir is None:
        return None
    try:
        return TrueJointHistory.create(runtime_dir / FILE_NAME, joints, now_ns=t_ns, capacity=CAPACITY)
    except HistoryError as error:
        raise EmulationError(str(error)) from error
