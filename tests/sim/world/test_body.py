"""The marker body: what a viewer in front of it sees, and that its patterns can be told apart."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stereoservo.ports.dot_plates import CORNERS, DEFAULT_BODY, EDGE, DotFace
from stereoservo_sim.world.body import roof_body


def edge_fraction(face: DotFace) -> float:
    """The ratio at which the edge dot divides edge 0-1, from corner 0."""
    return float((face.positions[EDGE, 0] - face.positions[0, 0]) / (face.positions[1, 0] - face.positions[0, 0]))


def test_ids_are_unique_and_as_published():
    assert roof_body().ids.tolist() == list(range(14))
    assert [(face.name, face.ids) for face in DEFAULT_BODY] == [
        ("a", tuple(range(7))),
        ("b", tuple(range(7, 14))),
    ]


def test_faces_are_rigid_copies_of_their_patterns():
    body = roof_body(roll=0.3)
    points = body.marker_points
    for k, face in enumerate(body.faces):
        part = points[7 * k : 7 * k + 7]
        flat = np.column_stack([face.positions, np.zeros(7)])
        distances = np.linalg.norm(part[:, None] - part[None], axis=2)
        assert np.allclose(distances, np.linalg.norm(flat[:, None] - flat[None], axis=2), atol=1e-12)
        assert np.allclose((part - part[0]) @ body.marker_normals[7 * k], 0, atol=1e-12)


def test_roof_is_two_faces_inclined_by_36_degrees_with_the_ridge_in_front():
    body = roof_body(tilt=np.deg2rad(18))
    normals = body.marker_normals
    assert np.isclose(np.rad2deg(np.arccos(normals[0] @ normals[7])), 36)
    assert np.all(normals[:, 2] > 0)  # outwards, along the flange's z axis
    heights = body.marker_points[:, 2]
    inner = heights[[1, 2, 7, 10]]  # the corners next to the ridge
    outer = heights[[0, 3, 8, 9]]
    assert inner.min() > outer.max()


def test_roof_is_convex():
    """No marker lies in front of the other face's plane: neither face can hide the other."""
    body = roof_body()
    points, normals = body.marker_points, body.marker_normals
    assert np.all((points[7:] - points[0]) @ normals[0] < 0)
    assert np.all((points[:7] - points[7]) @ normals[7] < 0)


def test_corners_run_clockwise_for_the_viewer():
    body = roof_body()
    for k in range(2):
        corners = body.marker_points[7 * k : 7 * k + 4]
        outward = body.marker_normals[7 * k]
        turn = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        assert turn @ outward < 0  # clockwise as seen against the outward normal


def test_face_a_is_on_the_left_for_the_viewer():
    body = roof_body()
    # Seen from in front with image y along face y, x runs to the right.
    right = body.flange_to_face[0][:3, 0] + body.flange_to_face[1][:3, 0]
    middle_a, middle_b = body.marker_points[:7].mean(axis=0), body.marker_points[7:].mean(axis=0)
    assert (middle_b - middle_a) @ right > 0


@pytest.mark.parametrize("face", DEFAULT_BODY, ids=lambda face: face.name)
def test_only_the_edge_triple_is_collinear(face):
    side = np.linalg.norm(face.positions[1] - face.positions[0])
    for triple in itertools.combinations(range(7), 3):
        p, q, r = face.positions[list(triple)]
        area = abs((q - p)[0] * (r - p)[1] - (q - p)[1] * (r - p)[0])
        longest = max(np.linalg.norm(p - q), np.linalg.norm(q - r), np.linalg.norm(p - r))
        if triple == (CORNERS[0], CORNERS[1], EDGE):
            assert area == 0
        else:
            assert area / longest > 0.08 * side, triple


@pytest.mark.parametrize("face", DEFAULT_BODY, ids=lambda face: face.name)
def test_dots_stay_apart_and_on_the_plate(face):
    distances = np.linalg.norm(face.positions[:, None] - face.positions[None], axis=2)
    assert distances[np.triu_indices(7, 1)].min() > 3 * face.radius
    assert np.abs(face.positions).max() + face.radius < face.half_side


def test_faces_differ_in_every_extra_dot():
    a, b = DEFAULT_BODY
    side = a.positions[1, 0] - a.positions[0, 0]
    for extra in (4, 5, 6):
        assert np.linalg.norm(a.positions[extra] - b.positions[4:], axis=1).min() > 0.09 * side
    assert edge_fraction(a) == pytest.approx(0.66)
    assert edge_fraction(b) == pytest.approx(0.34)
