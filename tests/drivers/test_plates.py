"""Plates to print: what the files hold, measured in them, and seen by the detectors."""

import json
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from stereoservo.ports.devices import DriverContext, Frame
from stereoservo.ports.dot_plates import FACES
from stereoservo_drivers.commands.print_plate import DotPlates, PlateError, faces_named, lay_out, print_plate
from stereoservo_drivers.detectors.aruco import TagDetector
from stereoservo_drivers.detectors.dots import DotDetector

app = typer.Typer()
app.command()(print_plate)
SVG = "{http://www.w3.org/2000/svg}"
FINE = 8
"""Pixels a millimetre in which a page is drawn before it is photographed."""


class Still:
    def now_ns(self) -> int:
        return 0


def run(*arguments) -> dict:
    answer = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    if answer.exception is not None:
        raise answer.exception
    return json.loads(answer.stdout)


def detector_of(cell: str):
    """The detector that the printed lines ask for."""
    camera = tomllib.loads("[[camera]]\n" + cell)["camera"][0]
    kind = {"dots": DotDetector, "aruco": TagDetector}[camera["detector"]]
    here = Path(".")
    context = DriverContext(clock=Still(), cell="c", runtime_dir=here, cell_dir=here, camera="left")
    return kind(camera.get("detector_options", {}), context)


def parsed(path):
    """Size [mm] of an SVG page, its circles (x, y, r, grey) and boxes (x, y, w, h, grey), in order of drawing."""
    root = ElementTree.parse(path).getroot()
    assert root.get("viewBox") == f"0 0 {root.get('width')[:-2]} {root.get('height')[:-2]}"
    assert root.get("width").endswith("mm")
    shapes = []
    for element in root:
        grey = int(element.get("fill", "#000000")[1:3], 16)
        if element.tag == SVG + "circle":
            shapes.append(("circle", *(float(element.get(k)) for k in ("cx", "cy", "r")), grey))
        elif element.tag == SVG + "rect":
            keys = ("x", "y", "width", "height")
            shapes.append(("box", *(float(element.get(k, 0.0)) for k in keys), grey))
    return (float(root.get("width")[:-2]), float(root.get("height")[:-2])), shapes


def drawn(path):
    """The page as an image, FINE pixels a millimetre; millimetre m is pixel FINE m - 1/2."""
    (width, height), shapes = parsed(path)
    image = np.full((round(height * FINE), round(width * FINE)), 255, np.uint8)
    for kind, *values, grey in shapes:
        if kind == "circle":
            x, y, r = values
            centre = (round((x * FINE - 0.5) * 64), round((y * FINE - 0.5) * 64))
            cv2.circle(image, centre, round(r * FINE * 64), grey, cv2.FILLED, cv2.LINE_AA, 6)
        else:
            x, y, w, h = (round(FINE * value) for value in values)
            image[y : y + h, x : x + w] = grey
    return image


def photographed(image, H, size=(640, 480), noise=2.0, seed=0):
    """A page (``drawn``) under the homography ``H`` from millimetres to pixels of a camera."""
    times = 4
    to_page = np.array([[1 / FINE, 0, 0.5 / FINE], [0, 1 / FINE, 0.5 / FINE], [0, 0, 1]])
    to_fine = np.array([[times, 0, 0.5 * times - 0.5], [0, times, 0.5 * times - 0.5], [0, 0, 1.0]])
    fine = cv2.warpPerspective(
        (30 + image * (190.0 / 255)).astype(np.float32), to_fine @ H @ to_page,
        (size[0] * times, size[1] * times), flags=cv2.INTER_LINEAR, borderValue=30.0,
    )  # fmt: skip
    fine = cv2.GaussianBlur(fine, (0, 0), 0.7 * times)
    picture = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    picture = picture + np.random.default_rng(seed).normal(0, noise, picture.shape)
    return np.clip(picture.round(), 0, 255).astype(np.uint8)


def random_homography(rng, page, across=420.0, tilt=45.0):
    """A camera of 900 px focal length looks at the middle of a page (w, h) [mm], some ``across`` px high."""
    axis = rng.normal(size=2)
    axis *= np.radians(rng.uniform(0, tilt)) / np.linalg.norm(axis)
    R = cv2.Rodrigues(np.array([*axis, 0.0]))[0] @ cv2.Rodrigues(np.array([0, 0, rng.uniform(0, 6.28)]))[0]
    K = np.array([[900.0, 0, 319.5], [0, 900.0, 239.5], [0, 0, 1]])
    depth = 900.0 * max(page) / across
    middle = np.array([[1, 0, -page[0] / 2], [0, 1, -page[1] / 2], [0, 0, 1.0]])
    return K @ np.column_stack([R[:, :2], [0, 0, depth]]) @ middle


def project(H, points):
    m = np.column_stack([points, np.ones(len(points))]) @ H.T
    return m[:, :2] / m[:, 2:]


def as_frame(image):
    return Frame("left", 0, 10**9, 10**9, np.ascontiguousarray(image))


# What the files hold


def test_an_svg_holds_the_faces_in_millimetres(tmp_path):
    answer = run(tmp_path / "plate.svg", "--dot-mm", 10)
    (width, height), shapes = parsed(tmp_path / "plate.svg")
    assert (width, height) == (210.0, 297.0)
    circles = np.array([values[:3] for kind, *values, _ in shapes if kind == "circle"])
    assert len(circles) == 14
    np.testing.assert_allclose(circles[:, 2], 5.0)
    for k, name in enumerate("ab"):
        face, seen = FACES[name], circles[7 * k : 7 * k + 7, :2]
        expected = face.positions * 1e3 * 10.0 / 16.0
        np.testing.assert_allclose(seen - seen[0], expected - expected[0], atol=1e-3)
    assert [face["ids"] for face in answer["faces"]] == [list(range(7)), list(range(7, 14))]
    grounds = [values for kind, *values, grey in shapes if kind == "box" and grey == 0]
    np.testing.assert_allclose([box[2:] for box in grounds], answer["faces"][0]["side_mm"])
    # the second face joins the first at the fold
    assert grounds[1][1] == pytest.approx(grounds[0][1] + grounds[0][3])


@pytest.mark.parametrize("name", ["plate.svg", "plate.pdf"])
def test_the_scale_bar_is_100_mm(tmp_path, name):
    if name.endswith("svg"):
        run(tmp_path / name)
        path = tmp_path / "plate-1.svg"
        lines = ElementTree.parse(path).getroot().iter(SVG + "line")
        ends = [[float(line.get(k)) for k in ("x1", "y1", "x2", "y2")] for line in lines]
    else:
        ends = [4 * [0.0]]
        with matplotlib.rc_context({"pdf.compression": 0}):
            run(tmp_path / name)
        number = rb"(-?[\d.]+)"
        path = rb"%s %s m\s+%s %s l\s+S" % (4 * (number,))
        ends = [[float(v) / 72 * 25.4 for v in match] for match in re.findall(path, (tmp_path / name).read_bytes())]
    lengths = [np.hypot(x1 - x0, y1 - y0) for x0, y0, x1, y1 in ends]
    assert max(lengths) == pytest.approx(100.0, abs=1e-3)


def test_a_pdf_holds_the_same_faces(tmp_path):
    with matplotlib.rc_context({"pdf.compression": 0}):
        run(tmp_path / "plate.pdf", "--dot-mm", 10)
    run(tmp_path / "plate.svg", "--dot-mm", 10)
    text = (tmp_path / "plate.pdf").read_bytes().decode("latin-1")
    box = [float(v) for v in re.search(r"/MediaBox \[ ([^\]]*)\]", text)[1].split()]
    np.testing.assert_allclose(np.array(box) / 72 * 25.4, [0, 0, 210, 297], atol=1e-3)
    discs = []
    for path in re.findall(r"^([-\d.]+ [-\d.]+ m\n(?:(?:[-\d.]+ ){6}c\n){8})", text, re.MULTILINE):
        ends = np.array([[float(v) for v in line.split()[-3:-1]] for line in path.strip().split("\n")])
        ends = np.concatenate([[[float(v) for v in path.split()[:2]]], ends[1:]]) / 72 * 25.4
        low, high = ends.min(axis=0), ends.max(axis=0)
        discs.append([*(low + high) / 2, *(high - low) / 2])
    discs = np.array(discs)
    circles = np.array([values[:3] for kind, *values, _ in parsed(tmp_path / "plate.svg")[1] if kind == "circle"])
    np.testing.assert_allclose(discs[:, :2] * [1, -1] + [0, 297], circles[:, :2], atol=2e-3)
    np.testing.assert_allclose(discs[:, 2:], 5.0, atol=2e-3)


def test_the_same_plate_is_the_same_file(tmp_path):
    for name in ("plate.svg", "plate.pdf"):
        run(tmp_path / name, "--dot-mm", 10)
        before = (tmp_path / name).read_bytes()
        run(tmp_path / name, "--dot-mm", 10, "--force")
        assert (tmp_path / name).read_bytes() == before


def test_faces_that_do_not_fit_together_get_pages_of_their_own(tmp_path):
    answer = run(tmp_path / "plate.svg", "--faces", "a,b,c")
    assert answer["pages"] == 3
    assert answer["files"] == [str(tmp_path / f"plate-{k}.svg") for k in (1, 2, 3)]
    for file in answer["files"]:
        assert sum(kind == "circle" for kind, *_ in parsed(file)[1]) == 7


def test_nothing_is_drawn_over_a_plate_or_off_the_page():
    for names in ("a", "a,b", "a,b,c,d,e,f"):
        for dot in (6.0, 10.0, 16.0):
            plates = DotPlates(faces_named(names), dot).plates()
            for page in lay_out(plates, (210.0, 297.0), ["x"] * 6):
                boxes = [s for s in page.shapes if hasattr(s, "width")]
                assert all(b.x >= 8 and b.x + b.width <= 202 and b.y + b.height <= 289 for b in boxes)
                for line in (s for s in page.shapes if hasattr(s, "x0")):
                    for x, y in ((line.x0, line.y0), (line.x1, line.y1)):
                        assert 0 < x < 210
                        assert 0 < y < 297
                        assert not any(b.x < x < b.x + b.width and b.y < y < b.y + b.height for b in boxes), names
                texts = [s for s in page.shapes if hasattr(s, "words")]
                assert all(not b.y < t.y < b.y + b.height or t.x > b.x + b.width for t in texts for b in boxes)


# What the detectors see


@pytest.mark.parametrize(
    "arguments",
    [
        ("--dot-mm", 10),
        ("--dot-mm", 10, "--polarity", "dark"),
        ("--dot-mm", 8, "--spacing", 60),
        ("--faces", "e,h", "--dot-mm", 10),
        ("--faces", "c", "--dot-mm", 12),
    ],
)
def test_printed_faces_are_found_as_the_printed_lines_say(tmp_path, arguments):
    """All ids, each where its circle is; of the print's mirror image none."""
    answer = run(tmp_path / "plate.svg", *arguments)
    detector = detector_of(answer["cell"])
    page, shapes = parsed(tmp_path / "plate.svg")
    circles = np.array([values[:2] for kind, *values, _ in shapes if kind == "circle"])
    ids = [i for face in answer["faces"] for i in face["ids"]]
    image, rng = drawn(tmp_path / "plate.svg"), np.random.default_rng(1)
    for seed in range(2):
        H = random_homography(rng, page)
        observation = detector.detect(as_frame(photographed(image, H, seed=seed)), None)
        assert observation.ids.tolist() == sorted(ids)
        truth = project(H, circles)[np.argsort(ids)]
        assert np.abs(observation.pixels - truth).max() < 0.1
        mirrored = photographed(np.ascontiguousarray(image[:, ::-1]), H, seed=seed)
        assert detector.detect(as_frame(mirrored), None).ids.tolist() == []
        assert detector.detect(as_frame(mirrored[:, ::-1]), None).ids.tolist() == sorted(ids)


def test_printed_tags_are_found_as_the_printed_lines_say(tmp_path):
    answer = run(tmp_path / "plate.svg", "--tags", "36h11:0-3", "--tag-mm", 60)
    detector = detector_of(answer["cell"])
    page, _ = parsed(tmp_path / "plate.svg")
    image, rng = drawn(tmp_path / "plate.svg"), np.random.default_rng(2)
    black = cv2.boundingRect((image < 128).astype(np.uint8))  # from the first tag's corner to the last one's
    H = random_homography(rng, page)
    observation = detector.detect(as_frame(photographed(image, H)), None)
    assert observation.ids.tolist() == list(range(16))
    x, y, w, h = np.array(black) / FINE
    ends = project(H, [[x, y], [x + w, y + h]])
    np.testing.assert_allclose(observation.pixels[[0, 14]], ends, atol=0.1)
    mirrored = photographed(np.ascontiguousarray(image[:, ::-1]), H)
    assert detector.detect(as_frame(mirrored), None).ids.tolist() == []


# Bad input


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--faces", "a,z"), "face", "'z' is unknown; valid: different ones of a, b, c, d"),
        (("--faces", ""), "face", "none"),
        (("--faces", "a,a"), "face", "one twice"),
        (("--dot-mm", "1"), "dot_size", "2 mm and more.* 6 px"),
        (("--dot-mm", "nan"), "dot_size", "2 mm"),
        (("--dot-mm", "60"), "too_large", "510.0 mm wide; on 210 x 297 mm"),
        (("--dot-mm", "10", "--spacing", "20"), "spacing", "and more"),
        (("--spacing", "nan"), "dot_size", "nan"),
        (("--polarity", "blue"), "polarity", "light, dark"),
        (("--page", "b7"), "page", "a4, a3, letter"),
        (("--page", "20x20"), "page", "116"),
        (("--tags", "36h12:0"), "tags", "36h11, 36h10"),
        (("--tags", "36h11"), "tags", "DICTIONARY:IDS"),
        (("--tags", "16h5:28-30"), "tags", "0 to 29"),
        (("--tags", "16h5:3-1"), "tags", "0 to 29"),
        (("--tags", "16h5:1", "--tag-mm", "1"), "tag_size", "5 mm and more"),
        (("--tags", "16h5:1", "--dot-mm", "9"), "option", "--faces"),
    ],
)
def test_bad_arguments_are_refused_with_what_would_be_valid(tmp_path, arguments, code, words):
    with pytest.raises(PlateError, match=words) as caught:
        run(tmp_path / "plate.svg", *arguments)
    assert caught.value.code == code
    assert list(tmp_path.iterdir()) == []


def test_files_are_not_written_over_nor_where_they_cannot_be(tmp_path):
    (tmp_path / "plate.svg").write_text("mine")
    with pytest.raises(PlateError, match="--force") as caught:
        run(tmp_path / "plate.svg", "--faces", "c")
    assert caught.value.code == "exists"
    assert (tmp_path / "plate.svg").read_text() == "mine"
    for path in (tmp_path / "nowhere" / "plate.svg", tmp_path / "plate.svg" / "plate.pdf"):
        with pytest.raises(PlateError, match="can be written") as caught:
            run(path)
        assert caught.value.code == "file"
    with pytest.raises(PlateError, match=r"\.svg or \.pdf"):
        run(tmp_path / "plate.png")
    assert [path.name for path in tmp_path.iterdir()] == ["plate.svg"]
