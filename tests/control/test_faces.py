"""Faces: found from markers alone, told apart from chance."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles.coplanar_groups import faces_of_all_triples
from stereoservo.control.cartesian_components import minors
from stereoservo.control.faces import find_faces, select_faces
from stereoservo.control.marker_groups import (
    EXHAUSTIVE,
    find_groups,
    marker_covariances,
    marker_distances,
    marker_information,
    off_plane,
    triangle_altitudes,
    turned_average,
)
from stereoservo.geometry.homogeneous import plane_of_points

from .bodies import SIGMA, Body, corner, many_plates, outward_is_right, six_faces, upright


@pytest.mark.parametrize("seed", range(4))
def test_faces_of_a_box_are_its_faces(virtual, seed):
    rng = np.random.default_rng(seed)
    T = upright(virtual, rng.uniform(-20, 60))
    body = Body(virtual, rng, (0, 90, 180, 270), T)
    faces = body.find(T, noise=SIGMA, rng=rng)
    assert sorted(faces.markers()) == [(0, 1, 2, 3), (4, 5, 6, 7), (8, 9, 10, 11), (12, 13, 14, 15)]
    assert faces.sided.all()
    assert outward_is_right(body, faces, T)


@pytest.mark.parametrize("seed", range(3))
def test_a_regular_box_seen_from_anywhere(virtual, seed):
    """Six faces with chamfers and diagonals in plenty, most of them hidden."""
    rng = np.random.default_rng(40 + seed)
    T = virtual.pose(Rotation.random(random_state=seed), [0, 0, 1.1])
    body = six_faces(virtual, rng, T)
    faces = body.find(T, noise=0.02, rng=rng, sigma=0.05)
    assert sorted(faces.markers()) == [tuple(range(4 * k, 4 * k + 4)) for k in range(6)]
    assert outward_is_right(body, faces, T)


@pytest.mark.parametrize("turn", [40, -40])
def test_shallow_and_inner_corners(virtual, turn):
    """What the cameras see tells the outward side, also of an inner corner, before whose planes the rest stands."""
    body, T = corner(virtual, np.random.default_rng(5), turn, 0.01)
    assert body.seen(T).all()
    faces = body.find(T)
    assert sorted(faces.markers()) == [(0, 1, 2, 3), (4, 5, 6, 7)]
    assert outward_is_right(body, faces, T)


def test_sights_from_several_poses_tell_faces_from_chamfers(virtual):
    """Plates as far apart as they are wide: their chamfer is a face as good as they are, until one of them hides."""
    body, T = corner(virtual, np.random.default_rng(5), 60, 0.035)
    world, points = body.world, body.world.hidden(body.at(T))
    assert sorted(body.find(T).markers()) != [(0, 1, 2, 3), (4, 5, 6, 7)]
    poses = [upright(virtual, turn) for turn in (-60, 30, 110)]
    eyes = np.concatenate([world.hidden(world.eyes @ (T @ np.linalg.inv(pose)).T) for pose in poses])
    seen = np.concatenate([body.seen(pose) for pose in poses])
    faces = find_faces(points, world.matrices, SIGMA, eyes, seen)
    assert sorted(faces.markers()) == [(0, 1, 2, 3), (4, 5, 6, 7)]
    assert outward_is_right(body, faces, T)


def test_a_plate_is_one_face_towards_the_cameras(virtual):
    rng = np.random.default_rng(6)
    T = upright(virtual, 25)
    body = Body(virtual, rng, (0,), T)
    faces = body.find(T)
    assert faces.markers() == [(0, 1, 2, 3)]
    assert outward_is_right(body, faces, T)
    unseen = find_faces(faces.body, body.world.matrices, SIGMA, body.world.camera_centres, np.zeros((2, 4)))
    assert unseen.markers() == [(0, 1, 2, 3)]
    assert not unseen.sided.any()


def test_small_bodies(virtual):
    rng = np.random.default_rng(7)
    T = upright(virtual)
    body = Body(virtual, rng, (0,), T)
    world, points = body.world, body.world.hidden(body.at(T))

    def found(points):
        return find_faces(points, world.matrices, SIGMA, world.camera_centres, np.ones((2, len(points))))

    assert found(points[:3]).markers() == [(0, 1, 2)]
    assert found(points[:2]).markers() == []
    line = np.stack([points[0], 0.7 * points[0] + 0.3 * points[1], points[1]])
    assert found(line).markers() == []
    with pytest.raises(ValueError, match="finite"):
        found(np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="sigma_px"):
        find_faces(points, world.matrices, 0.0, world.camera_centres, np.ones((2, 4)))
    with pytest.raises(ValueError, match="needed"):
        find_faces(points, world.matrices, SIGMA, world.camera_centres, np.ones((2, 3)))
    lone = (points, world.matrices[:1], SIGMA, world.camera_centres[:1], np.ones((1, 4)))
    assert find_faces(*lone).markers() == [], "one camera in one pose fixes no marker"
    assert find_faces(*lone, world.operators()).markers() == [(0, 1, 2, 3)], "known from the arm's motions"
    # one camera, the body in three poses: views P H
    steps = [np.eye(4), upright(virtual, 20) @ np.linalg.inv(T), upright(virtual, -20, 30) @ np.linalg.inv(T)]
    moved = [world.frame @ step @ np.linalg.inv(world.frame) for step in steps]
    views = np.array([world.matrices[0] @ H for H in moved])
    one = find_faces(points, views, SIGMA, world.camera_centres[:1], np.ones((1, 4)))
    assert one.markers() == [(0, 1, 2, 3)]


def test_off_plane_is_standard_normal_for_coplanar_markers(virtual):
    """Triangulated with noise, the determinant of four markers of a plane has the variance that is claimed."""
    rng = np.random.default_rng(8)
    T = upright(virtual, 30)
    body = Body(virtual, rng, (0, 60), T)
    world, exact = body.world, body.pixels(T)
    samples = []
    for _ in range(400):
        points = world.triangulated(exact + SIGMA * rng.normal(size=exact.shape))
        information = marker_information(points, world.matrices, SIGMA)
        covariances = marker_covariances(points, information)
        samples.append((off_plane(points, covariances, 0, 1, 2)[3], off_plane(points, covariances, 0, 1, 4)[2]))
    flat, off = np.array(samples).T
    # 400 samples: the variance is within 4 sqrt(2 / 400) of 1, the mean within 4 / 20 of 0
    assert abs(flat.var() - 1.0) < 4 * np.sqrt(2 / 400)
    assert abs(flat.mean()) < 0.2
    assert (np.abs(off) > 20).all()


def test_kernels_are_the_references(virtual):
    rng = np.random.default_rng(9)
    T = upright(virtual, 30)
    body = Body(virtual, rng, (0, 80), T)
    world = body.world
    points = world.hidden(body.at(T))
    information = marker_information(points, world.matrices, SIGMA)
    covariances = marker_covariances(points, information)
    triples = np.array(list(combinations(range(8), 3)), dtype=np.int64)

    def project(M):
        m = world.matrices @ M
        return (m[:, :2] / m[:, 2:]).ravel()

    expected_off, expected_altitude = np.zeros((len(triples), 8)), np.zeros(len(triples))
    roots = []
    for M, known in zip(points, information, strict=True):
        J = np.column_stack([(project(M + h) - project(M - h)) / 2e-6 for h in 1e-6 * np.eye(4)])
        np.testing.assert_allclose(known, J.T @ J / SIGMA**2, rtol=0, atol=1e-6 * np.abs(known).max())
        values, vectors = np.linalg.eigh(known)
        roots.append(vectors[:, 1:] / np.sqrt(values[1:]))  # covariance across the blind direction
    mean = information.mean(axis=0)
    half = np.linalg.cholesky(mean + 1e-12 * np.trace(mean) * np.eye(4)).T
    np.testing.assert_allclose(turned_average(information, np.zeros((0, 4, 4))), mean, rtol=1e-12)
    np.testing.assert_allclose(
        marker_distances(points, mean),
        np.linalg.norm((points[:, None] - points[None]) @ half.T, axis=-1),
        rtol=0, atol=1e-6 * np.sqrt(np.trace(mean)),
    )  # fmt: skip
    for t, triple in enumerate(triples):
        for other in set(range(8)) - set(triple.tolist()):
            four = points[[*triple, other]]
            variance = 0.0
            for row, p in enumerate([*triple, other]):
                cofactors = np.array([
                    np.linalg.det(np.vstack([four[:row], unit, four[row + 1 :]])) for unit in np.eye(4)
                ])  # fmt: skip
                along = points[p] / np.linalg.norm(points[p])
                blind = (cofactors @ along) ** 2 / np.trace(information[p])
                variance += float(((cofactors @ roots[p]) ** 2).sum()) + blind
            expected_off[t, other] = np.linalg.det(four) / np.sqrt(variance)
        altitudes = []
        for turn in range(3):
            i, j, k = np.roll(triple, -turn)
            side, way = half @ (points[k] - points[j]), half @ (points[j] - points[i])
            altitudes.append(np.linalg.norm(way - side * (side @ way) / (side @ side)))
        expected_altitude[t] = min(altitudes)
        np.testing.assert_allclose(minors(*points[triple]), plane_of_points(*points[triple]), atol=1e-12)
    scale = np.abs(expected_off).max()
    np.testing.assert_allclose(
        [off_plane(points, covariances, *triple) for triple in triples],
        expected_off,
        rtol=0,
        atol=1e-9 * scale,
    )
    np.testing.assert_allclose(triangle_altitudes(points, mean, triples), expected_altitude, rtol=1e-5)


def test_turns_make_lengths_comparable(virtual):
    """Averaged over the arm's turns, the images' measure of differences is the Euclidean one, up to its unit."""
    rng = np.random.default_rng(10)
    T = upright(virtual, 30)
    body = Body(virtual, rng, (0, 80), T)
    world = body.world
    points = world.hidden(body.at(T))
    information = marker_information(points, world.matrices, SIGMA)
    truth = np.linalg.norm(body.markers[:, None] - body.markers[None], axis=-1) + np.eye(8)

    def spread(form):
        ratios = (marker_distances(points, form) / truth)[~np.eye(8, dtype=bool)]
        return ratios.max() / ratios.min()

    assert spread(turned_average(information, world.operators())) < 1.02
    assert spread(information.mean(axis=0)) > 3
    assert spread(turned_average(information, world.operators()[:3])) > 3, "translations turn nothing"


def cloud(virtual, rng, T, count):
    """Markers anywhere in a cube."""
    body = Body(virtual, rng, (0,), T)
    body.markers = np.column_stack([rng.uniform(-0.08, 0.08, (count, 3)), np.ones(count)])
    body.normals = np.tile([0, 0, -1.0], (count, 1))
    return body


def same(found, expected):
    np.testing.assert_array_equal(found.triples, expected.triples)
    np.testing.assert_array_equal(found.members, expected.members)
    np.testing.assert_array_equal(found.sided, expected.sided)


@pytest.mark.parametrize("seed", range(12))
def test_faces_are_those_of_all_triples(virtual, seed):
    """Bodies of faces, of few markers anywhere, and of both, with noise: as by trying every plane."""
    rng = np.random.default_rng(200 + seed)
    T = virtual.pose(Rotation.random(random_state=seed), [0, 0, 1.1])
    if seed % 3 == 0:
        body = six_faces(virtual, rng, T)
    elif seed % 3 == 1:
        body = cloud(virtual, rng, T, 3 + seed)
    else:
        body = Body(virtual, rng, tuple(rng.uniform(0, 360, 3)), T)
        loose = cloud(virtual, rng, T, 4)
        body.markers = np.concatenate([body.markers, loose.markers])
        body.normals = np.concatenate([body.normals, loose.normals])
    world = body.world
    pixels = body.pixels(T)
    points = world.triangulated(pixels + 0.02 * rng.normal(size=pixels.shape))
    arguments = points, world.matrices, 0.05, world.camera_centres, body.seen(T), world.operators()
    assert len(points) <= EXHAUSTIVE
    same(find_faces(*arguments), faces_of_all_triples(*arguments))


@pytest.mark.parametrize(("plates", "seed"), [(k, seed) for k in (6, 9, 12, 16) for seed in range(4)])
def test_planes_of_near_markers_give_the_same_faces(virtual, plates, seed):
    """Where not every triple is tried: the faces of a body of many plates are those of all triples."""
    rng = np.random.default_rng(300 + seed)
    T = virtual.pose(Rotation.random(random_state=seed), [0, 0, 1.2])
    body = many_plates(virtual, rng, plates, T)
    world, seen = body.world, body.seen(T)
    pixels = body.pixels(T)
    points = world.triangulated(pixels + 0.001 * rng.normal(size=pixels.shape))
    views = points, world.matrices, 0.002, world.operators()
    everything = select_faces(find_groups(*views, exhaustive=len(points)), points, world.camera_centres, seen)
    assert sorted(everything.markers()) == [tuple(range(4 * k, 4 * k + 4)) for k in range(plates)]
    near = select_faces(find_groups(*views, exhaustive=0), points, world.camera_centres, seen)
    order = [near.markers().index(face) for face in everything.markers()]
    assert len(order) == len(near.sided)
    same(near._replace(triples=near.triples[order], members=near.members[order]), everything)


def test_faces_of_256_markers(virtual):
    rng = np.random.default_rng(310)
    T = virtual.pose(Rotation.random(random_state=310), [0, 0, 1.2])
    body = many_plates(virtual, rng, 64, T)
    faces = body.find(T, noise=0.001, rng=rng, sigma=0.002)
    # of 174 million fours some are in one plane by chance
    assert len({tuple(range(4 * k, 4 * k + 4)) for k in range(64)} & set(faces.markers())) >= 62
    plates = [len({k // 4 for k in face}) == 1 for face in faces.markers()]
    assert outward_is_right(body, faces._replace(triples=faces.triples[plates], members=faces.members[plates]), T)
