"""Taught goals carried over by edges, faces and points mixed, without markers on the workpiece: against the truth."""

import msgspec
import numpy as np
import pytest

from stereoservo.cli.goal import target_tree
from stereoservo.cli.output import CommandError
from stereoservo.gateway.goal_transfer import resolve
from stereoservo.gateway.point_alignment import TransferError, fixed_line
from stereoservo.messages.goals import Feature, TaughtTarget

from .scene import BODY, WORK, Cameras, make_model, placed, some_pose, teach
from .test_goal_transfer import HAND, errors, stated

EDGES = ((10, 11), (11, 12), (12, 13), (14, 15), (10, 14), (13, 15))
LINES = tuple((100 + 2 * k, 101 + 2 * k) for k in range(len(EDGES)))
FACE = {200: (0.2, 0.1), 201: (0.7, 0.2), 202: (0.3, 0.8), 203: (0.9, 0.6), 204: (0.1, 0.5)}
"""Places in the plane of 10, 11 and 12."""


def slid(rng):
    """Two places on each edge, others at every call."""
    found = {}
    for (a, b), ids in zip(EDGES, LINES, strict=True):
        A, B = np.array(WORK[a]), np.array(WORK[b])
        for marker, share in zip(ids, (rng.uniform(-0.2, 0.3), rng.uniform(0.7, 1.2)), strict=True):
            found[marker] = tuple(A + share * (B - A))
    return found


def on_face(ids):
    A, B, C = (np.array(WORK[k]) for k in (10, 11, 12))
    return {k: tuple(A + s * (B - A) + t * (C - A)) for k, (s, t) in FACE.items() if k in ids}


def scene(seed, stratum="metric", sigma=0.05, wrong=False):
    rng = np.random.default_rng(seed)
    cameras, model = Cameras(), make_model(rng, Cameras(), placed(BODY, HAND), stratum=stratum)
    before, hand, after = some_pose(rng), some_pose(rng), some_pose(rng)
    then = WORK | slid(rng) | on_face((200, 201, 202))
    goal = teach(model, cameras, placed(BODY, hand) | placed(then, before), rng, sigma)
    now = WORK | slid(rng) | on_face((201, 203, 204))
    if wrong:
        now[104] = tuple(np.add(now[104], (0.0, 0.02, 0.01)))
    sights = cameras.sights(placed(BODY, some_pose(rng)) | placed(now, after), rng, sigma)
    return goal, model, sights, placed(BODY, after @ np.linalg.inv(before) @ hand)


@pytest.mark.parametrize(
    ("stratum", "common", "lines", "planes"),
    [
        ("metric", (), LINES, ()),
        ("metric", (10,), LINES[:2], ()),
        ("metric", (10,), LINES[1:3], ((200, 201, 202, 203, 204),)),
        ("affine", (), LINES, ()),
        ("projective", (10, 15), LINES, ()),
    ],
)
def test_a_goal_goes_along_by_edges_whose_ends_do_not_correspond(stratum, common, lines, planes):
    """The largest error stays within 5 stated deviations, and where all edges count near that by six markers."""
    ratios, ours, markers = [], [], []
    for seed in range(6):
        goal, model, sights, truth = scene(seed, stratum)
        found = resolve(TaughtTarget("pick", "workpiece", common, lines, planes), goal, model, sights)
        away = errors(found.target, Cameras(), truth)
        ratios.append(np.abs(away).max() / stated(found.note))
        ours.append(float((away**2).mean()))
        by = resolve(TaughtTarget("pick", "workpiece", tuple(WORK)), goal, model, sights)
        markers.append(float((errors(by.target, Cameras(), truth) ** 2).mean()))
        assert " edges (10" in found.note
    assert max(ratios) < 5.0
    if len(lines) == len(LINES) and stratum == "metric":
        assert np.sqrt(np.mean(ours)) < 1.5 * np.sqrt(np.mean(markers))


def test_without_noise_it_is_exact():
    goal, model, sights, truth = scene(3, sigma=0.0)
    found = resolve(TaughtTarget("pick", "workpiece", (), LINES[:4]), goal, model, sights)
    assert np.abs(errors(found.target, Cameras(), truth)).max() < 1e-3


def test_an_edge_in_a_plane_through_both_cameras_is_left_out_and_named():
    goal, model, sights, truth = scene(7)
    found = resolve(TaughtTarget("pick", "workpiece", (), LINES), goal, model, sights)
    assert "left out" in found.note
    assert np.abs(errors(found.target, Cameras(), truth)).max() < 5.0 * stated(found.note)


def test_what_does_not_tell_the_motion_is_refused_with_the_cause():
    goal, model, sights, _ = scene(0)
    for common, lines, said in [
        ((), LINES[:1], "needs three edges that are not parallel"),
        ((), LINES[:2], "two maps bring the features onto their images alike"),
        ((999,), LINES, "point 999 is seen by none when it was taught"),
        ((), (*LINES, (100, 998)), "edge 100-998 is seen by none when it was taught"),
    ]:
        with pytest.raises(TransferError, match=said):
            resolve(TaughtTarget("pick", "workpiece", common, lines), goal, model, sights)
    with pytest.raises(TransferError, match="of the plane of 900, 901, 902, two cameras see none"):
        resolve(TaughtTarget("pick", "workpiece", (), LINES, ((900, 901, 902),)), goal, model, sights)


def test_an_edge_that_is_another_one_is_named():
    goal, model, sights, _ = scene(1, wrong=True)
    with pytest.raises(TransferError, match=r"have not moved as one body.*without edge 104-105 the others agree"):
        resolve(TaughtTarget("pick", "workpiece", (), LINES), goal, model, sights)


def test_a_fixed_line_by_segments_is_the_line_whatever_their_ends():
    rng = np.random.default_rng(5)
    cameras, model = Cameras(), make_model(np.random.default_rng(6), Cameras(), placed(BODY, HAND))
    pose = some_pose(rng)
    ends = [slid(rng), slid(rng)]
    seen = [cameras.pixels(placed(places, pose))[name] for name, places in zip(cameras.names, ends, strict=True)]
    segments = {
        name: tuple(tuple(pixels[marker].tolist()) for marker in LINES[1])
        for name, pixels in zip(cameras.names, seen, strict=True)
    }
    line = fixed_line(Feature(segments=segments), model)
    third = cameras.pixels(placed({1: WORK[11]}, pose))
    for camera in model.cameras:
        from stereoservo.geometry.distortion import undistort

        a, b = (camera.matrix @ np.array(point) for point in line.points)
        image = np.cross(a, b)
        u = undistort(camera.lens, np.array([third[camera.name][1]]))[0]
        assert abs(image @ [*u, 1.0]) / np.hypot(*image[:2]) < 1e-4
    with pytest.raises(TransferError, match="a fixed line by its segments"):
        fixed_line(Feature(segments={"left": segments["left"]}), model)


def test_edges_and_faces_on_the_command_line():
    tree = target_tree("pick", None, None, {}, "workpiece", None, "400-401,402-407", "400-401-406")
    assert msgspec.convert(tree, TaughtTarget).lines == ((400, 401), (402, 407))
    assert tree["planes"] == [[400, 401, 406]]
    with pytest.raises(CommandError, match="groups of 2 ids are valid"):
        target_tree("pick", None, None, {}, "workpiece", None, "400-401-402")
    with pytest.raises(CommandError, match="groups of 3 or more ids"):
        target_tree("pick", None, None, {}, "workpiece", None, None, "400-a")
