import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereoservo.geometry.cameras import project_many
from stereoservo.kinematics.chain import ChainError, ProjectiveChain

KINDS = ("revolute", "prismatic")
seeds = st.integers(0, 2**32 - 1)
kinds_of_arms = st.lists(st.sampled_from(KINDS), min_size=1, max_size=8).map(tuple)


class EuclideanArm:
    """An arm as robotics writes it: fixed link transforms with a joint about or along the local z in
    between.
    """

    def __init__(self, rng, kinds):
        self.kinds = kinds
        self.links = []
        for _ in range(len(kinds) + 1):
            link = np.eye(4)
            link[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
            link[:3, 3] = rng.uniform(-0.5, 0.5, 3)
            self.links.append(link)

    def joint(self, j, q):
        T = np.eye(4)
        if self.kinds[j] == "revolute":
            T[:3, :3] = Rotation.from_euler("z", q).as_matrix()
        else:
            T[2, 3] = q
        return T

    def pose(self, q, upto=None):
        T = self.links[0]
        for j in range(len(self.kinds) if upto is None else upto):
            T = T @ self.joint(j, q[j]) @ self.links[j + 1]
        return T

    def displacement(self, q, zero):
        return self.pose(q) @ np.linalg.inv(self.pose(zero))

    def twists(self, zero):
        about_z = np.zeros((4, 4))
        about_z[0, 1], about_z[1, 0] = -1.0, 1.0
        along_z = np.zeros((4, 4))
        along_z[2, 3] = 1.0
        twists = []
        for j, kind in enumerate(self.kinds):
            frame = self.pose(zero, j) @ self.joint(j, zero[j])
            twists.append(frame @ (about_z if kind == "revolute" else along_z) @ np.linalg.inv(frame))
        return np.stack(twists)


def random_frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


def random_arm(seed, kinds):
    rng = np.random.default_rng(seed)
    arm, H = EuclideanArm(rng, kinds), random_frame(rng)
    zero = rng.uniform(-1, 1, len(kinds))
    chain = ProjectiveChain(kinds, H @ arm.twists(zero) @ np.linalg.inv(H), zero)
    return rng, arm, H, chain


def random_cameras(rng, H, c=2):
    """Cameras (c, 3, 4) in the projective frame that look at the arm from about four metres."""
    Ps = []
    for _ in range(c):
        R = Rotation.from_euler("xy", rng.uniform(-0.3, 0.3, 2)).as_matrix()
        K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
        Ps.append(K @ np.hstack([R, [[0.1], [0.0], [12.0]]]) @ np.linalg.inv(H))
    return np.stack(Ps)


@given(seeds, kinds_of_arms)
@settings(max_examples=150)
def test_chain_is_the_euclidean_arm_in_a_random_projective_frame(seed, kinds):
    rng, arm, H, chain = random_arm(seed, kinds)
    q = rng.uniform(-3, 3, len(kinds))
    truth = H @ arm.displacement(q, chain.zero) @ np.linalg.inv(H)
    assert np.allclose(chain.displacement(q), truth, atol=1e-10)
    assert np.allclose(chain.displacement(chain.zero), np.eye(4))
    partial = chain.partial_displacements(q)
    for j in range(len(kinds) + 1):
        mixed = np.concatenate([q[:j], chain.zero[j:]])
        assert np.allclose(partial[j], H @ arm.displacement(mixed, chain.zero) @ np.linalg.inv(H), atol=1e-10)


@given(seeds, kinds_of_arms)
def test_operators_are_the_twists_at_the_configuration(seed, kinds):
    rng, arm, H, chain = random_arm(seed, kinds)
    q = rng.uniform(-3, 3, len(kinds))
    assert np.allclose(chain.operators_at(q), H @ arm.twists(q) @ np.linalg.inv(H), atol=1e-9)
    # Errata to (5.21): the printed partial product with joint j included gives the same.
    partial = chain.partial_displacements(q)[1:]
    assert np.allclose(chain.operators_at(q), partial @ chain.generators @ np.linalg.inv(partial), atol=1e-9)


@given(seeds, kinds_of_arms)
def test_point_jacobians_agree_with_finite_differences(seed, kinds):
    rng, _, H, chain = random_arm(seed, kinds)
    M0 = np.hstack([rng.uniform(-0.5, 0.5, (3, 3)), np.ones((3, 1))]) @ H.T
    q = rng.uniform(-2, 2, len(kinds))
    J = chain.point_jacobian(q, M0 @ chain.displacement(q).T)
    h = 1e-5
    for j in range(len(kinds)):
        step = h * np.eye(len(kinds))[j]
        difference = (chain.displacement(q + step) - chain.displacement(q - step)) / (2 * h)
        assert np.allclose(J[:, :, j], M0 @ difference.T, atol=1e-8)
    assert np.allclose(chain.point_jacobian(q, M0 @ chain.displacement(q).T), J, atol=1e-12)


@given(seeds, kinds_of_arms)
def test_image_jacobian_agrees_with_finite_differences(seed, kinds):
    rng, _, H, chain = random_arm(seed, kinds)
    Ps = random_cameras(rng, H, 3)
    M0 = np.hstack([rng.uniform(-0.5, 0.5, (4, 3)), np.ones((4, 1))]) @ H.T
    q = rng.uniform(-2, 2, len(kinds))
    J = chain.image_jacobian(Ps, q, M0 @ chain.displacement(q).T)
    assert J.shape == (3, 4, 2, len(kinds))
    h = 1e-5
    for j in range(len(kinds)):
        step = h * np.eye(len(kinds))[j]
        ahead, behind = (project_many(Ps, M0 @ chain.displacement(x).T) for x in (q + step, q - step))
        assert np.abs((ahead - behind) / (2 * h) - J[..., j]).max() < 1e-5 * max(1.0, np.abs(J).max())


def rezeroed(chain, Q):
    """The same arm with its zero at ``Q`` (n,): generators become ``Ĥ_j|_Q`` (5.22)."""
    return ProjectiveChain(chain.kinds, chain.operators_at(Q), Q, chain.tip_first)


@given(seeds, kinds_of_arms)
def test_rezeroed_chain_is_the_same_arm(seed, kinds):
    rng, _, _, chain = random_arm(seed, kinds)
    Q, q = rng.uniform(-2, 2, (2, len(kinds)))
    moved = rezeroed(chain, Q)
    assert np.array_equal(moved.zero, Q)
    assert np.allclose(moved.displacement(q) @ chain.displacement(Q), chain.displacement(q), atol=1e-9)
    assert np.allclose(moved.operators_at(q), chain.operators_at(q), atol=1e-9)
    assert np.allclose(rezeroed(moved, chain.zero).generators, chain.generators, atol=1e-9)


def test_malformed_chains_and_configurations_are_refused():
    G = np.zeros((2, 4, 4))
    with pytest.raises(ChainError, match=r"\(2, 4, 4\), zero \(3,\)") as error:
        ProjectiveChain(("revolute", "revolute"), G, np.zeros(3))
    assert error.value.data["zero"] == (3,)
    with pytest.raises(ChainError, match="joint 1 is of kind 'helical'; known: revolute, prismatic"):
        ProjectiveChain(("revolute", "helical"), G, np.zeros(2))
    with pytest.raises(ChainError, match="finite"):
        ProjectiveChain(("revolute", "revolute"), G + np.nan, np.zeros(2))
    chain = ProjectiveChain(("revolute", "prismatic"), G, np.zeros(2))
    assert chain.kind_codes.tolist() == [0, 1]
    assert chain.kind_codes.dtype == np.uint8
    with pytest.raises(ChainError, match=r"shape \(3,\)"):
        chain.displacement(np.zeros(3))
    with pytest.raises(ChainError, match="not finite"):
        chain.operators_at(np.array([0.0, np.inf]))


def test_the_loops_kinematics_load_no_scipy_and_no_opencv():
    code = (
        "import sys, stereoservo.kinematics.chain, stereoservo.kinematics.kernels;"
        "print([m for m in ('scipy.optimize', 'scipy.linalg', 'cv2') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_cameras_on_the_tip_see_the_inverse_motion(seed):
    kinds = ("revolute", "prismatic", "revolute", "revolute")
    rng, arm, H, _ = random_arm(seed, kinds)
    zero, q = rng.uniform(-1, 1, (2, len(kinds)))
    back = np.linalg.inv(H)
    # What stands still before a camera on the tip moves by the inverse of the tip's own displacement.
    base_to_tip = arm.pose(zero)
    seen = np.linalg.inv(arm.pose(q)) @ base_to_tip
    twists = -np.linalg.inv(base_to_tip) @ arm.twists(zero) @ base_to_tip
    chain = ProjectiveChain(kinds, H @ twists @ back, zero, tip_first=True)
    np.testing.assert_allclose(chain.displacement(q), H @ seen @ back, atol=1e-9)
    point = H @ np.append(rng.uniform(-1, 1, 3), 1.0)
    slope = chain.point_jacobian(q, point[None] @ chain.displacement(q).T)[0]
    for j in range(len(kinds)):
        step = np.zeros(len(kinds))
        step[j] = 1e-6
        difference = (chain.displacement(q + step) - chain.displacement(q - step)) @ point / 2e-6
        np.testing.assert_allclose(slope[:, j], difference, atol=1e-7 * max(1.0, np.abs(slope).max()))
