"""Which joints of a URDF are the arm: what cannot be driven is refused, what is left out is told with its cure."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from stereoservo.cli import main as cli
from stereoservo_sim.world.arms.arm_cell import urdf_path
from stereoservo_sim.world.physics import PybulletPlant
from stereoservo_sim.world.robots import Robot, flange_pose
from stereoservo_sim.world.urdf_file import MOST_MESH_BYTES, UrdfError, load_urdf

from ...corrupted import corrupted_copies

LIMIT = '<limit lower="-1" upper="1" effort="10" velocity="1"/>'


@dataclass(frozen=True)
class Row:
    """A joint of a test's URDF; its child link has its name with ``_link``, where ``child`` is not given."""

    name: str
    parent: str
    kind: str = "revolute"
    mimics: str = ""
    child: str = ""
    axis: str = "0 1 0"
    limit: str = LIMIT
    multiplier: float = -1.0

    @property
    def link(self) -> str:
        return self.child or f"{self.name}_link"

    @property
    def text(self) -> str:
        mimic = f'<mimic joint="{self.mimics}" multiplier="{self.multiplier}" offset="0.1"/>' if self.mimics else ""
        limit = "" if self.kind in ("fixed", "continuous") else self.limit
        return (
            f'<joint name="{self.name}" type="{self.kind}"><parent link="{self.parent}"/><child link="{self.link}"/>'
            f'<origin xyz="0 0 0.1"/><axis xyz="{self.axis}"/>{limit}{mimic}</joint>'
        )


def serial(*names: str, root: str = "base") -> list[Row]:
    """Joints one after the other."""
    parents = [root, *(f"{name}_link" for name in names)]
    return [Row(name, parent) for name, parent in zip(names, parents, strict=False)]


def robot_of(folder: Path, rows: list[Row], flange: str = "") -> Robot:
    links = dict.fromkeys([*(row.parent for row in rows), *(row.link for row in rows)])
    box = '<visual><geometry><box size="0.05 0.05 0.1"/></geometry></visual>'
    body = [*(f'<link name="{link}">{box}</link>' for link in links), *(row.text for row in rows)]
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(body)}</robot>', encoding="utf-8")
    return load_urdf(path, flange=flange)


ARM = serial("j1", "j2", "j3", "j4", "j5")
SO101 = [
    *serial("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex"),
    Row("wrist_roll", "wrist_flex_link", child="gripper_link"),
    Row("gripper_frame_joint", "gripper_link", "fixed", child="gripper_frame_link"),
    Row("gripper", "gripper_link", child="moving_jaw_so101_v1_link"),
]
"""The shape of the SO-101's own file: a tool frame and one jaw on the last link."""


@pytest.mark.parametrize(
    ("rows", "how"),
    [
        ([*serial("lift"), Row("c", "lift_link", "prismatic", "lift")], "along or about another line"),
        ([*serial("a"), Row("c", "a_link", mimics="a", axis="1 0 0")], "along or about another line"),
        ([*serial("a"), Row("c", "a_link", mimics="a")], "along or about another line"),  # a parallelogram
        ([*serial("a", "b"), Row("c", "b_link", mimics="a")], "with joints of the arm between them"),
        ([Row("a", "base", axis="0 0 1"), Row("c", "a_link", mimics="a", axis="0 0 1")], "so that nothing moves"),
    ],
)
def test_mimic_joints_that_are_no_single_joint_are_refused(tmp_path: Path, rows: list[Row], how: str) -> None:
    """Also where the flange is named; and the remedy works."""
    for flange in ("", "j2_link", "c_link"):
        with pytest.raises(UrdfError, match=rf"arm.urdf.*'c' mimics '.*{how}.*driven.*flange = '(\w+)'") as caught:
            robot_of(tmp_path, [*rows, *serial("j1", "j2", root="c_link")], flange)
    before = re.search(r"flange = '(\w+)'", str(caught.value))
    assert before is not None
    assert robot_of(tmp_path, rows, before[1]).joint_names == tuple(row.name for row in rows[:-1])


COLUMN = [
    Row("lift", "base", "prismatic", axis="0 0 1"),
    Row("stage2", "lift_link", "prismatic", "lift", axis="0 0 2", multiplier=0.5),
]
TURNTABLE = [
    Row("turn", "base", axis="0 0 1"),
    Row("again", "turn_link", mimics="turn", axis="0 0 -1", multiplier=-2.0, limit=""),
]


@pytest.mark.parametrize(("rows", "limit"), [(COLUMN, 1.5), (TURNTABLE, 3.0)])
def test_coupled_joints_are_one_joint_that_moves_both(tmp_path: Path, rows: list[Row], limit: float) -> None:
    """A telescope, and two turns about one line: kinematics, limits, and the engine's own joints."""
    robot = robot_of(tmp_path, [*rows, *serial("j1", "j2", root=rows[1].link)])
    assert robot.joint_names == (rows[0].name, "j1", "j2")
    assert robot.joints[0].position_max == pytest.approx(limit)
    engine = PybulletPlant(robot, np.zeros(3), 1e-3)
    try:
        for q in np.random.default_rng(0).uniform(-0.9, 0.9, (5, 3)):
            engine.place(q)
            assert np.abs(engine.flange() - flange_pose(robot, q)).max() < 1e-6
        engine.place(np.zeros(3))
        for s in np.linspace(0.0, 1.0, 200):
            engine.follow(np.array([0.3 * s, 0.0, 0.0]), np.array([1.5, 0.0, 0.0]), 1e-3)
        assert engine.positions == pytest.approx([0.3, 0.0, 0.0], abs=0.02)
        assert np.abs(engine.flange() - flange_pose(robot, engine.positions)).max() < 5e-3
    finally:
        engine.close()


DATA = Path(os.environ.get("STEREOSERVO_DATA", Path(__file__).parents[4] / "shared" / "data"))


def reported(name: str) -> Path:
    path = DATA / "reports" / name
    if not path.is_file():
        pytest.skip(f"no reports/{name} in ../shared/data or $STEREOSERVO_DATA")
    return path


def test_the_reported_telescope_has_one_lift() -> None:
    path = reported("case_01_mimic_joint_on_the_chain/telescope.urdf")
    robot = load_urdf(path)
    assert robot.joint_names == ("lift", *(f"j{k}" for k in range(1, 7)))
    assert (robot.joints[0].position_min, robot.joints[0].position_max) == pytest.approx((0.0, 0.7))
    high, low = (flange_pose(robot, np.array([q, *np.zeros(6)]))[2, 3] for q in (0.7, 0.0))
    assert high - low == pytest.approx(0.7)


def test_the_reported_torso_names_its_arms() -> None:
    path = reported("case_03_two_arms_no_flange/two_arms.urdf")
    with pytest.raises(UrdfError) as caught:
        load_urdf(path)
    flanges = re.findall(r"flange = '(\w+)' \(6 joints\)", str(caught.value))
    assert flanges == ["left_l6", "right_l6"]
    assert [load_urdf(path, flange=flange).joints[0].name for flange in flanges] == ["left_j1", "right_j1"]


def test_a_single_jaw_is_left_out_and_that_is_told(tmp_path: Path) -> None:
    robot = robot_of(tmp_path, SO101)
    assert robot.joint_names == ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    assert robot.flange == "gripper_link"
    (note,) = robot.notes
    flange = re.search(r"'gripper' .*left out.* flange = '(\w+)'", note)
    assert flange is not None
    assert robot_of(tmp_path, SO101, flange[1]).joint_names[-1] == "gripper"
    assert robot_of(tmp_path, SO101, flange[1]).notes == ()
    assert robot_of(tmp_path, SO101, "gripper_frame_link").joint_names == robot.joint_names


@pytest.mark.parametrize(
    ("last", "jaw"),
    [
        ([Row("Jaw", "j5_link")], True),
        ([Row("6", "j5_link", child="moving_jaw")], True),
        ([Row("left_finger", "j5_link", "prismatic")], True),
        ([Row("6", "j5_link"), Row("tool", "j5_link", "fixed", child="tool0")], True),
        ([Row("gripper", "j5_link"), Row("tip", "gripper_link", mimics="gripper")], True),
        ([Row("j6", "j5_link")], False),
        ([Row("gripper_roll", "j5_link")], False),
        ([Row("wrist", "j5_link", child="gripper_link")], False),
        ([Row("j6", "j5_link"), Row("camera", "j5_link", "fixed", child="camera_link")], False),
    ],
)
def test_what_is_taken_for_a_jaw(tmp_path: Path, last: list[Row], jaw: bool) -> None:
    robot = robot_of(tmp_path, [*ARM, *last])
    assert len(robot.joints) == (5 if jaw else 6)
    assert bool(robot.notes) == jaw
    if jaw:
        assert repr(last[0].name) in robot.notes[0]
        assert f"flange = {last[0].link!r}" in robot.notes[0]


def test_fingers_are_left_out_and_that_is_told(tmp_path: Path) -> None:
    fingers = [Row("f1", "j5_link"), Row("f2", "j5_link", mimics="f1")]
    robot = robot_of(tmp_path, [*ARM, *fingers])
    assert robot.flange == "j5_link"
    assert len(robot.notes) == 1
    assert "'f1', 'f2' are left out" in robot.notes[0]
    assert "flange = 'f1_link'" in robot.notes[0]
    assert robot_of(tmp_path, [*ARM, *fingers], "f2_link").joint_names[-1] == "f2"


@pytest.mark.parametrize("before", [0, 1, 3])
def test_several_arms_are_refused_with_the_flanges_to_choose_from(tmp_path: Path, before: int) -> None:
    """Also behind a torso's own joints, which alone are no arm."""
    torso = serial(*(f"t{k}" for k in range(before)))
    root = f"t{before - 1}_link" if before else "base"
    arms = [serial(*(f"{side}{k}" for k in range(6)), root=root) for side in ("left", "right")]
    rows = [*torso, *arms[0], *arms[1], *serial("head", root=root)]
    with pytest.raises(UrdfError, match="several arms") as caught:
        robot_of(tmp_path, rows)
    flanges = re.findall(r"flange = '(\w+)'", str(caught.value))
    assert flanges[:2] == ["left5_link", "right5_link"]
    robot = robot_of(tmp_path, rows, flanges[1])
    assert len(robot.joints) == before + 6
    assert "'left0'" in robot.notes[0]


def test_a_linkage_that_an_arm_carries_ends_it_not(tmp_path: Path) -> None:
    """A parallelogram's rod, coupled to a joint before it or after it: the arm goes on, and the rod is told."""
    for at, mimics in (("j2_link", "j2"), ("j1_link", "j3")):
        robot = robot_of(tmp_path, [*ARM, Row("rod", at, mimics=mimics)])
        assert robot.joint_names == ("j1", "j2", "j3", "j4", "j5")
        assert len(robot.notes) == 1
        assert f"'rod' mimics the arm's {mimics!r}" in robot.notes[0]


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ([*ARM, Row("j6", "j5_link", "floating"), Row("j7", "j6_link")], "'floating' .* revolute, .* where it stands"),
        ([Row("world", "map", "screw", child="base"), *ARM], "'screw' .* revolute, continuous"),
        ([*ARM, Row("j6", "j5_link", mimics="nobody")], "'j6' mimics 'nobody'; joints beside it: j1, j2"),
        ([*ARM, Row("j6", "j5_link", mimics="j6")], "'j6' mimics 'j6'"),
        ([*ARM, Row("j5", "j5_link", child="other")], "two joints are named 'j5'"),
        ([*ARM, Row("j6", "j1_link", child="j5_link")], "child of joints 'j5' and 'j6'; closed chains"),
        ([Row("a", "x", child="y"), Row("b", "y", child="x"), *ARM], "below itself"),
        ([*ARM, *serial(*"abcde", root="other")], "several arms.*'j5_link' .5 joints. or flange = 'e_link'"),
        ([*ARM, Row("j6", "j5_link", axis="0 0 0")], "'j6': its axis"),
        ([*ARM, Row("j6", "j5_link", limit='<limit lower="1" upper="0"/>')], "'j6': limits 1 to 0"),
        ([*ARM, Row("j6", "j5_link", limit='<limit lower="nan" upper="0"/>')], "'j6': <limit lower='nan'>"),
        ([*ARM, Row("j6", "j5_link", limit='<limit lower="${low}" upper="0"/>')], "'j6': .* xacro FILE"),
    ],
)  # fmt: skip
def test_what_is_no_tree_of_known_joints_is_refused(tmp_path: Path, rows: list[Row], told: str) -> None:
    with pytest.raises(UrdfError, match=told) as caught:
        robot_of(tmp_path, rows)
    assert "arm.urdf" in str(caught.value)


@pytest.mark.parametrize(
    ("row", "highest", "told"),
    [
        (Row("j6", "j5_link", limit='<limit effort="1" velocity="1"/>'), 2 * np.pi, "no limits are stated"),
        (Row("j6", "j5_link", limit=""), 2 * np.pi, "no limits are stated"),
        (Row("j6", "j5_link", "prismatic", limit='<limit lower="0" upper="0"/>'), 1.0, "no limits are stated"),
        (Row("j6", "j5_link", limit='<limit lower="-170" upper="90"/>'), np.pi / 2, "-170 to 90 are taken for degrees"),
        (Row("j6", "j5_link", limit='<limit lower="-1e16" upper="1e16"/>'), 2 * np.pi, "are many turns"),
        (Row("j6", "j5_link", " Continuous "), 2 * np.pi, ""),
    ],
)
def test_limits_as_exporters_write_them(tmp_path: Path, row: Row, highest: float, told: str) -> None:
    robot = robot_of(tmp_path, [*ARM, row])
    assert robot.joints[-1].position_max == pytest.approx(highest)
    assert [told in note for note in robot.notes] == ([True] if told else [])


def test_what_is_beside_the_arm_or_before_it_stands_still_and_is_told(tmp_path: Path) -> None:
    """A base that drives, wheels, a head, a link without a joint; limits and axes beside the arm do not matter."""
    wheel = Row("wheel", "base", "continuous", axis="0 0 0")
    rows = [
        Row("drive", "map", "planar", child="base"), wheel, Row("caster", "base", limit='<limit lower="1" upper="0"/>'),
        *ARM, Row("pan", "j1_link"), Row("box", "j3_link", "floating"), Row("x", "loose", "fixed", child="frame"),
    ]  # fmt: skip
    robot = robot_of(tmp_path, rows)
    assert robot.joint_names == ("j1", "j2", "j3", "j4", "j5")
    told = " ".join(robot.notes)
    assert all(f"{name!r}" in told for name in ("drive", "wheel", "caster", "pan", "box"))
    assert "links that no joint connects to the arm are left out, with what is below: loose" in told


@pytest.mark.parametrize(
    ("encoded", "told"),
    [
        (lambda text: text.encode("utf-8-sig"), ""),
        (lambda text: text.encode("utf-16"), "in UTF-16-LE"),
        (lambda text: text.encode("utf-16-be"), "in UTF-16-BE"),
        (lambda text: text.encode("cp1252"), "is not UTF-8"),
        (lambda text: text.replace("utf-8", "cp1252").encode("cp1252"), ""),
        (lambda text: ("\r\n " + text).encode() + b"\0\0", "2 zero bytes"),
    ],
)
def test_files_of_any_encoding_are_read(tmp_path: Path, encoded: Callable[[str], bytes], told: str) -> None:
    joint = Row("Gelenk_ä", "base", child="hand").text.replace("<joint", "<joint xyz:undeclared='1'")
    text = f'<?xml version="1.0" encoding="utf-8"?>\n<robot name="Müller"><link name="base"/><link name="hand"/>{joint}'
    (tmp_path / "arm.urdf").write_bytes(encoded(text + "</robot>"))
    robot = load_urdf(tmp_path / "arm.urdf")
    assert (robot.name, robot.joint_names) == ("Müller", ("Gelenk_ä",))
    assert [told in note for note in robot.notes] == ([True] if told else [])


MESHED = """<robot name="arm"><link name="a"/><link name="b"><visual><geometry><mesh filename="{}"/></geometry></visual>
</link><joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>"""


@pytest.mark.parametrize(
    ("named", "at", "found"),
    [
        ("../meshes/part.obj", "pkg/meshes/part.obj", True),
        ("package://pkg/meshes/part.obj", "pkg/meshes/part.obj", True),
        ("package://pkg/meshes/part.obj", "pkg/urdf/meshes/part.obj", True),  # copied with its meshes
        ("package://other/part.obj", "other/part.obj", True),
        ("file:///home/maker/ws/meshes/part.obj", "pkg/urdf/part.obj", True),
        ("C:\\ws\\meshes\\part.obj", "pkg/urdf/meshes/part.obj", True),
        ("../../part.obj", "part.obj", False),
        ("package://pkg/../part.obj", "part.obj", False),
        ("/dev/zero", "part.obj", False),
        ("large.obj", "pkg/urdf/large.obj", False),
        ("pipe.obj", "", False),
    ],
)
def test_meshes_are_taken_from_the_files_own_tree_alone(tmp_path: Path, named: str, at: str, found: bool) -> None:
    folder = tmp_path / "pkg/urdf"
    for place in (folder, tmp_path / "other"):
        place.mkdir(parents=True)
        (place.parent / "package.xml" if place is folder else place / "package.xml").touch()
    os.mkfifo(folder / "pipe.obj")
    if at:
        (tmp_path / at).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / at).write_bytes(OBJ)
    if at.endswith("large.obj"):
        os.truncate(tmp_path / at, MOST_MESH_BYTES + 1)
    (folder / "arm.urdf").write_text(MESHED.format(named))
    robot = load_urdf(folder / "arm.urdf")
    assert bool(robot.shapes) == found
    assert (str(tmp_path / at) in robot.text) == found
    assert [Path(named).name in note for note in robot.notes] == ([] if found else [True])


def test_an_arm_of_too_many_joints_is_refused_with_a_flange_that_works(tmp_path: Path) -> None:
    rows = serial(*(f"j{k}" for k in range(1500)))
    with pytest.raises(UrdfError, match=r"1500 joints .* at most 12\. Valid: flange = '(\w+)'") as caught:
        robot_of(tmp_path, rows)
    flange = re.search(r"Valid: flange = '(\w+)'", str(caught.value))
    assert flange is not None
    assert len(robot_of(tmp_path, rows, flange[1]).joints) == 12


CELL = """schema = 1
[cell]
name = "mine"
[joints]
driver = "fake"
[joints.options]
urdf = "arm.urdf"
[[camera]]
name = "left"
driver = "fake"
[[camera]]
name = "right"
driver = "fake"
[safety]
[calibration]
"""


def test_doctor_tells_what_is_left_out_and_refuses_what_is_not_driven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STEREOSERVO_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("STEREOSERVO_STATE_DIR", str(tmp_path / "state"))
    source = urdf_path("rx90.urdf", tmp_path).read_text(encoding="utf-8")
    jaw = Row("gripper", "flange").text

    def told(name: str, text: str) -> tuple[int, dict]:
        (tmp_path / name).write_text(text.replace("</robot>", f'<link name="gripper_link"/>{jaw}</robot>'))
        (tmp_path / "cell.toml").write_text(CELL.replace("arm.urdf", name))
        code = cli.invoke(["doctor", str(tmp_path / "cell.toml"), "--seconds", "0", "--json"])
        return code, json.loads(capfd.readouterr().out)

    code, result = told("arm.urdf", source)
    assert code == 0
    (note,) = [check["message"] for check in result["checks"] if check["name"] == "arm"]
    assert "flange = 'gripper_link' makes it a joint of the arm" in note
    coupled = source.replace("</joint>", '<mimic joint="nobody"/></joint>', 1)
    code, result = told("coupled.urdf", coupled)
    assert code == 1
    assert "mimics 'nobody'; joints beside it" in result["error"]["message"]


WHOLE = f"""<?xml version="1.0"?>
<robot name="arm">
<link name="a"><inertial><origin xyz="0 0 0.1"/><mass value="1.5"/></inertial>
<collision><origin xyz="0 0 0.1" rpy="0.1 0 0"/><geometry><cylinder radius="0.1" length="0.2"/></geometry>
</collision></link>
<link name="b"><visual><geometry><mesh filename="part.obj" scale="1 1 1"/></geometry></visual></link>
<link name="c"><visual><geometry><mesh filename="part.stl"/></geometry></visual></link>
<link name="d"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>
<joint name="j1" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>{LIMIT}</joint>
<joint name="j2" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>{LIMIT}</joint>
<joint name="j3" type="revolute"><parent link="c"/><child link="d"/><mimic joint="j2" multiplier="2"/>{LIMIT}</joint>
</robot>
""".encode()
OBJ = b"# a part\n" + 20 * b"v 0.0 0.0 0.0\nv 0.1 0.0 0.0\nv 0.0 0.1 0.2\n" + b"f 1 2 3\n"
STL = bytes(80) + (2).to_bytes(4, "little") + 2 * (np.linspace(0.0, 0.5, 12, dtype="<f4").tobytes() + bytes(2))


def parts(folder: Path) -> None:
    (folder / "part.obj").write_bytes(OBJ)
    (folder / "part.stl").write_bytes(STL)


def readable(path: Path) -> bool:
    """Whether a file is read, to a robot of finite numbers; refused: with the file's name and without a type's."""
    try:
        robot = load_urdf(path, flange="c")
    except UrdfError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert path.name in refusal
        assert not re.search(r"\b[A-Z]\w+(Error|Warning)\b", refusal), refusal
        return False
    for array in (robot.base, robot.links, robot.masses, robot.centres):
        assert np.isfinite(array).all()
    assert all(np.isfinite([*shape.start, *shape.end, shape.radius]).all() for shape in robot.shapes)
    return True


VALUES = (
    "", "nan", "inf", "-1", "1e400", "1e200", "1e-320", "x", "1 2", "0 0 0", "ü", "9" * 5000, "a/" * 3000, "\U0001f916",
    "&#0;",
)  # fmt: skip
TAGS = (
    "link", "joint", "robot", "mesh", "box", "limit", "mimic", "parent", "child", "axis", "origin", "fixed", "planar",
)  # fmt: skip


def structural_copies(whole: str, count: int, seed: int) -> list[str]:
    """Copies of a file whose attributes and elements are changed, moved, doubled or left out."""
    rng = np.random.default_rng(seed)
    copies = []
    for _ in range(count):
        text = whole
        for _ in range(int(rng.integers(1, 4))):
            pieces = re.split(r'("[^"]*"|<[^>]*>)', text) if rng.random() < 0.5 else re.split(r'("[^"]*")', text)
            k = int(rng.integers(len(pieces) // 2)) * 2 + 1
            match int(rng.integers(4)):
                case 0:
                    pieces[k] = f'"{rng.choice(VALUES)}"' if pieces[k].startswith('"') else ""
                case 1:
                    pieces[k] = pieces[int(rng.integers(len(pieces) // 2)) * 2 + 1]
                case 2:
                    pieces[k] = re.sub(r"\w+", str(rng.choice(TAGS)), pieces[k], count=1)
                case _:
                    pieces[k] *= 2
            text = "".join(pieces)
        copies.append(text)
    return copies


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("damaged", ["arm.urdf", "part.obj", "part.stl"])
def test_damaged_bytes_are_refused_or_read(tmp_path: Path, damaged: str) -> None:
    path = tmp_path / "arm.urdf"
    path.write_bytes(WHOLE)
    parts(tmp_path)
    assert readable(path)
    whole = (tmp_path / damaged).read_bytes()
    read = []
    for data in corrupted_copies(whole, 400, 4):
        (tmp_path / damaged).write_bytes(data)
        read.append(readable(path))
    assert not all(read)


@pytest.mark.filterwarnings("error")
def test_damaged_structure_is_refused_or_read(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    parts(tmp_path)
    read = []
    for text in structural_copies(WHOLE.decode(), 800, 7):
        path.write_text(text, encoding="utf-8", errors="surrogatepass")
        read.append(readable(path))
    assert 0 < sum(read) < len(read)
