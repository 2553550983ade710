"""Printed faces are told apart: six dots of one never nearly fit those of another, of its mirror image, of itself."""

from itertools import combinations, permutations

import numpy as np
import pytest

from stereoservo.ports.dot_plates import CORNERS, FACES, MORE

from .rendering import Scene, look, project
from .scenes import as_frame, make_detector

APART = 0.07
"""What the docstring of MORE states [half corner distances]."""
REACH = 0.3
"""How far off a dot may be with four of the six matched: a fit to all spreads that over six, but not to a quarter."""


def pattern(face):
    """Dots (7, 2) in units of half the corner distance."""
    return face.positions / (0.5 * np.linalg.norm(face.positions[1] - face.positions[0]))


def spare_bases():
    """Quadruples of which one is whole, whichever dot is missing: the corners, or three of them with an inner dot."""
    return [CORNERS, (1, 2, 3, 5), (0, 2, 3, 6), (0, 1, 3, 5), (0, 1, 2, 6)]


def homographies(source, targets):
    """Homographies (k, 3, 3) of four points (4, 2) to each of (k, 4, 2); NaN where degenerate."""

    def basis(points):
        M = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1).swapaxes(-1, -2)
        with np.errstate(all="ignore"):
            det = np.linalg.det(M[..., :3])
            M = np.where(np.abs(det)[..., None, None] > 1e-6, M, np.nan)
            weights = np.full((*M.shape[:-2], 3), np.nan)
            good = np.isfinite(M).all(axis=(-1, -2))
            weights[good] = np.linalg.solve(M[good][..., :3], M[good][..., 3:])[..., 0]
        return M[..., :3] * weights[..., None, :]

    H = basis(targets) @ np.linalg.inv(basis(source[None])[0])
    with np.errstate(all="ignore"):
        return H / H[:, 2:, 2:]


def fitted_misfit(A, B):
    """Largest residual of the least-squares homography from A (k, 2) to B (k, 2), reweighted twice."""
    x, y = A.T
    depth, one, zero = np.ones(len(A)), np.ones(len(A)), np.zeros(len(A))
    for _ in range(3):
        rows = np.concatenate(
            [
                np.column_stack([x, y, one, zero, zero, zero, -B[:, 0] * x, -B[:, 0] * y]) / depth[:, None],
                np.column_stack([zero, zero, zero, x, y, one, -B[:, 1] * x, -B[:, 1] * y]) / depth[:, None],
            ]
        )
        h = np.linalg.lstsq(rows, np.concatenate([B[:, 0] / depth, B[:, 1] / depth]), rcond=None)[0]
        H = np.append(h, 1.0).reshape(3, 3)
        depth = np.column_stack([A, one]) @ H[2]
        if (depth <= 0).any():
            return np.inf
    return float(np.linalg.norm(project(H, A) - B, axis=1).max())


def least_misfit(A, B, same):
    """Least largest residual [units of B] of six or seven dots of A as dots of B, seen from the same side.

    Every quadruple of B is tried for each of five of A, as a detector would. ``same``: the identity does not count.
    """
    quadruples = np.array(list(permutations(range(7), 4)))
    best = np.inf
    for basis in spare_bases():
        H = homographies(A[list(basis)], B[quadruples])
        with np.errstate(all="ignore"):
            m = np.column_stack([A, np.ones(7)]) @ H.swapaxes(1, 2)
            places = m[..., :2] / m[..., 2:]
            keep = np.isfinite(places).all(axis=(1, 2)) & (m[..., 2] > 1e-3).all(axis=1)
            keep &= np.linalg.det(np.where(keep[:, None, None], H, np.eye(3))) > 0
        away = np.linalg.norm(places[keep][:, :, None] - B, axis=3)
        owners, distances = away.argmin(axis=2), away.min(axis=2)
        for owner, distance in zip(owners, distances, strict=True):
            for missing in (None, *range(7)):
                used = [d for d in range(7) if d != missing]
                if distance[used].max() > REACH or len(set(owner[used])) < len(used):
                    continue
                if same and (owner[used] == used).all():
                    continue
                best = min(best, fitted_misfit(A[used], B[owner[used]]))
    return best


def check_apart(faces, others, least=APART):
    for face in faces:
        for other in others:
            A, B = pattern(face), pattern(other)
            for first, second in ((A, B), (B, A)):
                assert least_misfit(first, second, face is other) >= least, (face.name, other.name)
                assert least_misfit(first, second * [-1, 1], False) >= least, (
                    face.name,
                    other.name,
                    "mirrored",
                )


def test_the_measure_finds_what_is_alike():
    """A face and itself with two dots moved by little, and its mirror image mirrored."""
    A = pattern(FACES["e"])
    one, two = A.copy(), A.copy()
    one[5] += [0.03, 0.0]
    two[[5, 6]] += [[0.03, 0.0], [0.0, 0.04]]
    H = np.array([[1.1, 0.2, 0.3], [-0.1, 0.9, 0.2], [0.1, 0.05, 1.0]])
    assert least_misfit(A, project(H, A), False) < 1e-9
    assert least_misfit(A, one, False) < 1e-9
    assert 1e-3 < least_misfit(A, two, False) < 0.04
    assert least_misfit(A * [-1, 1], A * [-1, 1] + 1.0, False) < 1e-9


def test_two_of_the_faces_are_apart():
    check_apart([FACES["e"]], [FACES["a"], FACES["e"]])


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_every_further_face_is_apart_from_all():
    check_apart(MORE, FACES.values())


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_all_faces_are_expected_and_none_is_taken_for_another(seed):
    """Pictures with two faces of thirteen each, at tilts to 60 degrees; dots from 6 px on."""
    detector = make_detector(beside=[name for name in FACES if name not in "ab"])
    pairs = list(combinations(FACES.values(), 2))
    rng = np.random.default_rng(seed)
    found = asked = 0
    for k in rng.permutation(len(pairs))[: 8 if seed == 0 else None]:
        scene, truth = Scene(noise=2.0), {}
        for f, face in enumerate(pairs[k]):
            z = rng.uniform(1.0, 2.2) * face.radius / 0.008
            at = (180.0 + 280.0 * f + rng.uniform(-20, 20), 240.0 + rng.uniform(-60, 60))
            H = look(np.radians(rng.uniform(0, 60)), rng.uniform(0, 6.3), rng.uniform(0, 6.3), z, at)
            scene.faces.append((H, face.positions, face.radius, face.half_side))
            truth |= dict(zip(face.ids, project(H, face.positions), strict=True))
        image = scene.render(rng)
        observation = detector.detect(as_frame(image), None)
        asked += len(truth)
        found += len(observation.ids)
        for marker, pixel in zip(observation.ids.tolist(), observation.pixels, strict=True):
            assert np.linalg.norm(pixel - truth[marker]) < 0.5
        assert detector.detect(as_frame(np.ascontiguousarray(image[:, ::-1])), None).ids.tolist() == []
    assert found >= 0.95 * asked
