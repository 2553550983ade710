"""The screw picture of 8.2 against finite differences of Euclidean motions, and in random projective frames."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from oracles.screw_transfer import (
    Screw,
    StratumError,
    base_from_hand,
    base_link,
    camera_frame,
    cartesian_velocity,
    command_operators,
    hand_from_base,
    hand_from_camera,
    hand_from_tool,
    joint_velocity,
    operator_screw,
    point_interaction,
    screw_of_points,
    screw_operator,
    screw_transfer,
    seen_from_other_end,
    tool_frame,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.composition import Composition, displacement
from stereoservo.kinematics.kernels import chain_forward
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import gantry_with_wrist, rx90

H = 1e-6


def random_pose(rng, size=1.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    T[:3, 3] = size * rng.normal(size=3)
    return T


def random_frame(rng):
    while True:
        T = np.eye(4) + 0.35 * rng.normal(size=(4, 4))
        if np.linalg.det(T) > 0.2 and np.linalg.cond(T) < 8:
            return T


def random_screw(rng):
    return Screw(rng.normal(size=3), rng.normal(size=3))


@pytest.mark.parametrize("seed", range(5))
def test_point_interaction_is_the_derivative_of_the_motion(seed):
    rng = np.random.default_rng(seed)
    S, screw = rng.normal(size=(7, 3)), random_screw(rng)
    T = screw_operator(screw)
    X = np.column_stack([S, np.ones(7)])
    moving = ((expm(H * T) - expm(-H * T)) / (2 * H) @ X.T).T[:, :3]
    np.testing.assert_allclose(point_interaction(S) @ np.concatenate(screw), moving, atol=1e-8)
    # the camera moves by the screw, the points stand: T_camera(t) = exp(tT̂), X_C = T_camera⁻¹ X
    seen = ((np.linalg.inv(expm(H * T)) - np.linalg.inv(expm(-H * T))) / (2 * H) @ X.T).T[:, :3]
    np.testing.assert_allclose(point_interaction(S, True) @ np.concatenate(screw), seen, atol=1e-8)
    for rates, camera in ((moving, False), (seen, True)):
        found = screw_of_points(S[:3], rates[:3], camera)
        np.testing.assert_allclose(np.concatenate(found), np.concatenate(screw), atol=1e-6)


def test_points_that_tell_no_screw_are_refused():
    S = np.array([[0.0, 0, 1], [1, 0, 1], [2, 0, 1]])
    with pytest.raises(GeometryError, match="one line"):
        screw_of_points(S, np.zeros((3, 3)))
    with pytest.raises(GeometryError, match="three"):
        screw_of_points(S[:2], np.zeros((2, 3)))
    with pytest.raises(GeometryError, match="finite"):
        screw_of_points(np.full((3, 3), np.nan), np.zeros((3, 3)))


@pytest.mark.parametrize("seed", range(5))
def test_transfer_of_vectors_and_operators_agree(seed):
    """(8.16): the same body, described from two frames that are rigidly linked."""
    rng = np.random.default_rng(seed)
    T_HC, screw = random_pose(rng), random_screw(rng)
    hand = operator_screw(hand_from_camera(T_HC, screw_operator(screw)))
    np.testing.assert_allclose(np.concatenate(hand), screw_transfer(T_HC) @ np.concatenate(screw), atol=1e-12)
    S = rng.normal(size=3)
    at_hand = T_HC[:3, :3] @ S + T_HC[:3, 3]
    np.testing.assert_allclose(
        point_interaction(at_hand) @ np.concatenate(hand),
        T_HC[:3, :3] @ point_interaction(S) @ np.concatenate(screw),
        atol=1e-12,
    )


@pytest.mark.parametrize("seed", range(5))
def test_tool_and_base_screws_close_the_circle_of_links(seed):
    """(8.18)-(8.21): camera - tool - hand and camera - base - hand lead to the same hand screw, projectively too."""
    rng = np.random.default_rng(seed)
    T_HB, T_BC, T_HL = random_pose(rng), random_pose(rng), random_pose(rng)
    T_LC = np.linalg.inv(T_HL) @ T_HB @ T_BC
    camera = screw_operator(random_screw(rng))
    base = hand_from_camera(T_BC, camera)
    by_base, by_tool = hand_from_base(T_HB, base), hand_from_tool(T_HL, T_LC, camera)
    np.testing.assert_allclose(by_base, by_tool, atol=1e-11)
    np.testing.assert_allclose(base_from_hand(T_HB, by_base), base, atol=1e-11)
    joints = np.array([screw_operator(random_screw(rng)) for _ in range(6)])
    np.testing.assert_allclose(
        base_from_hand(T_HB, joints.sum(axis=0)), base_from_hand(T_HB, joints).sum(axis=0), atol=1e-11
    )
    # any frame at each end: A_B hides the base, A_H the hand
    A_B, A_H = random_frame(rng), random_frame(rng)
    link = A_H @ T_HB @ np.linalg.inv(A_B)
    hidden = hand_from_base(link, A_B @ base @ np.linalg.inv(A_B))
    np.testing.assert_allclose(hidden, A_H @ by_base @ np.linalg.inv(A_H), atol=1e-9)


@pytest.mark.parametrize("make", [rx90, gantry_with_wrist])
def test_joint_velocity_inverts_the_sum_of_joint_screws(make):
    rng = np.random.default_rng(3)
    model = exact_model(make())
    n = len(model.joint_names)
    kinds = np.array([kind == "prismatic" for kind in model.joint_kinds], dtype=np.uint8)
    _, operators = chain_forward(model.generators, kinds, model.zero, model.zero + 0.2 * rng.normal(size=n))
    q_dot = rng.normal(size=n)
    total = np.tensordot(q_dot, operators, axes=1)
    np.testing.assert_allclose(joint_velocity(operators, total), q_dot, atol=1e-8)
    doubled = joint_velocity(np.concatenate([operators, operators[:1]]), total)
    np.testing.assert_allclose(doubled[0], doubled[-1], atol=1e-8)
    with pytest.raises(GeometryError, match="no joint velocity"):
        joint_velocity(operators[: n - 1], operators[n - 1])
    np.testing.assert_array_equal(joint_velocity(operators, np.zeros((4, 4))), np.zeros(n))


def test_the_other_end_of_the_arm_is_the_other_composition():
    """Operators moved along the arm, sign turned: what the hand's cameras see of the base, step by step."""
    rng = np.random.default_rng(4)
    model = exact_model(rx90())
    kinds = np.zeros(6, np.uint8)
    q, dq = model.zero + 0.2 * rng.normal(size=6), 0.3 * rng.normal(size=6)
    T, operators = chain_forward(model.generators, kinds, model.zero, q)
    then, _ = chain_forward(model.generators, kinds, model.zero, q + dq)
    A = random_frame(rng)
    here = A @ np.linalg.inv(T)  # points of this end to a frame that rides on the other
    other = seen_from_other_end(operators, here)
    step = displacement(other, Composition.TIP_FIRST, dq)
    np.testing.assert_allclose(step @ here, A @ np.linalg.inv(then), atol=1e-9)


@pytest.mark.parametrize("make", [gantry_with_wrist])
def test_cartesian_velocity_of_a_metric_model_is_metres_and_radians(make):
    """In the left camera's frame: the derivative of the markers that the cell itself moves, in metres."""
    rng = np.random.default_rng(5)
    cell = make()
    model = exact_model(cell)
    kinds = np.array([kind == "prismatic" for kind in model.joint_kinds], dtype=np.uint8)
    q, q_dot = cell.home + 0.1 * rng.normal(size=len(cell.kinds)), rng.normal(size=len(cell.kinds))
    _, operators = chain_forward(model.generators, kinds, model.zero, q)
    scaled = exact_model(cell)
    any_scale = type(scaled)(
        **{
            **{name: getattr(scaled, name) for name in scaled.__struct_fields__},
            "projective_to_euclidean": np.diag([1, 1, 1, 0.37]) @ scaled.projective_to_euclidean * 2.1,
        }
    )
    screw = cartesian_velocity(operators, q_dot, camera_frame(any_scale))
    markers = cell.markers(np.stack([q, q + H * q_dot, q - H * q_dot])) @ cell.poses[0].T
    truth = (markers[1] - markers[2])[:, :3] / (2 * H)
    np.testing.assert_allclose(point_interaction(markers[0][:, :3]) @ np.concatenate(screw), truth, atol=1e-7)


def test_models_that_cannot_tell_say_what_is_missing():
    with pytest.raises(StratumError, match="projective") as told:
        camera_frame(exact_model(gantry_with_wrist(), stratum="projective"))
    assert told.value.stratum == "projective"
    assert "H_PE" in told.value.missing
    with pytest.raises(StratumError) as told:
        camera_frame(exact_model(gantry_with_wrist(), stratum="affine"))
    assert told.value.stratum == "affine"
    with pytest.raises(StratumError, match="one factor") as told:
        camera_frame(exact_model(rx90()))
    assert told.value.stratum == "metric"
    assert "length" in told.value.missing
    model = exact_model(gantry_with_wrist())
    with pytest.raises(GeometryError, match="no Euclidean twist"):
        cartesian_velocity(model.generators, np.ones(6), np.eye(4))


def reported(rng, count, turn=0.8, noise=0.0):
    """Poses that a robot reports, and displacements that a model in a random projective frame sees of its hand."""
    A, T_rig_base = random_frame(rng), random_pose(rng)
    poses = []
    for _ in range(count):
        T = random_pose(rng, 0.4)
        T[:3, :3] = Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix()
        poses.append(T)
    poses = np.array(poses)
    rig = T_rig_base @ poses @ np.linalg.inv(poses[0]) @ np.linalg.inv(T_rig_base)
    seen = A @ rig @ np.linalg.inv(A)
    shaken = seen + noise * rng.normal(size=seen.shape)
    return poses, shaken / np.linalg.det(shaken)[:, None, None] ** 0.25, np.linalg.inv(A @ T_rig_base)


@pytest.mark.parametrize("seed", range(4))
def test_a_base_link_makes_any_stratum_metric(seed):
    rng = np.random.default_rng(seed)
    poses, seen, truth = reported(rng, 3)
    link = base_link(poses, seen)
    scale = (link.H_base * truth).sum() / (truth**2).sum()
    np.testing.assert_allclose(link.H_base / scale, truth, atol=1e-8 * np.abs(truth).max())
    assert link.residual < 1e-12
    # what moves in the model's frame, said in the base's metres
    screw = random_screw(rng)
    operators = np.array([np.linalg.inv(truth) @ screw_operator(screw) @ truth])
    found = cartesian_velocity(operators, np.array([2.0]), link.H_base)
    np.testing.assert_allclose(np.concatenate(found), 2 * np.concatenate(screw), atol=1e-8)
    # and in the hand's, (8.19)
    T_HB = np.linalg.inv(poses[1])
    hand = cartesian_velocity(operators, np.array([2.0]), T_HB @ link.H_base)
    np.testing.assert_allclose(np.concatenate(hand), 2 * screw_transfer(T_HB) @ np.concatenate(screw), atol=1e-8)


def test_a_base_link_from_noisy_displacements():
    """The error falls with the noise and with the number of stops."""
    errors = {}
    for count, noise in ((6, 1e-3), (6, 1e-4), (60, 1e-3)):
        runs = []
        for seed in range(20):
            poses, seen, truth = reported(np.random.default_rng(seed), count, noise=noise)
            H_base = base_link(poses, seen).H_base
            scale = (H_base * truth).sum() / (truth**2).sum()
            runs.append(np.linalg.norm(H_base / scale - truth) / np.linalg.norm(truth))
        errors[count, noise] = float(np.median(runs))
    assert errors[6, 1e-4] < 0.2 * errors[6, 1e-3]
    assert errors[60, 1e-3] < 0.6 * errors[6, 1e-3]
    assert errors[6, 1e-3] < 0.02


def test_poses_that_fix_no_base_link_are_refused():
    rng = np.random.default_rng(6)
    poses, seen, _ = reported(rng, 5)
    with pytest.raises(GeometryError, match="three or more"):
        base_link(poses[:2], seen[:2])
    with pytest.raises(GeometryError, match="paired"):
        base_link(poses, seen[:4])
    A = random_frame(rng)
    turns = np.array([np.eye(4)] * 5)
    turns[:, :3, :3] = Rotation.from_rotvec(np.outer([0, 0.3, 0.8, 1.4, 0.2], [0, 0, 1.0])).as_matrix()
    turns[:, :3, 3] = rng.normal(size=(5, 3))
    flat = A @ turns @ np.linalg.inv(turns[0]) @ np.linalg.inv(A)
    with pytest.raises(GeometryError, match="two axes"):
        base_link(turns, flat)
    with pytest.raises(GeometryError, match="finite"):
        base_link(poses, np.full_like(seen, np.nan))


def test_the_tool_frame_from_markers_is_a_rigid_link():
    """(8.18): T_HL from markers on the tool stays the same at every pose of the hand."""
    rng = np.random.default_rng(7)
    poses, seen, truth = reported(rng, 6)
    H_base = base_link(poses, seen).H_base
    tool = np.column_stack([rng.normal(size=(3, 3)) * 0.05, np.ones(3)])
    links = []
    for T in poses:
        markers = tool @ T.T @ np.linalg.inv(truth).T  # in the model's frame
        links.append(np.linalg.inv(T) @ tool_frame(markers, H_base))
    np.testing.assert_allclose(links, np.broadcast_to(links[0], (6, 4, 4)), atol=1e-7)
    in_tool = tool @ np.linalg.inv(links[0]).T
    np.testing.assert_allclose(in_tool[0, :3], 0, atol=1e-7)
    np.testing.assert_allclose(in_tool[1, 1:3], 0, atol=1e-7)
    assert in_tool[1, 0] > 0
    assert in_tool[2, 1] > 0
    with pytest.raises(GeometryError, match="one line"):
        tool_frame(np.array([[0.0, 0, 0, 1], [1, 1, 1, 1], [2, 2, 2, 1]]), np.eye(4))
    with pytest.raises(GeometryError, match="infinity"):
        tool_frame(np.array([[0.0, 0, 0, 1], [1, 1, 1, 0], [2, 2, 0, 1]]), np.eye(4))


def test_command_operators_are_the_unit_commands():
    rng = np.random.default_rng(8)
    A, centre = random_frame(rng), rng.normal(size=3)
    H_frame = np.linalg.inv(A)
    for point, at in ((None, np.zeros(3)), (centre, centre)):
        operators = command_operators(H_frame, point)
        v, w = rng.normal(size=3), rng.normal(size=3)
        screw = cartesian_velocity(operators, np.concatenate([v, w]), H_frame)
        # v is the velocity of the body's point at the centre
        velocity = point_interaction(at) @ np.concatenate(screw)
        np.testing.assert_allclose(velocity, v, atol=1e-10)
        np.testing.assert_allclose(screw.w, w, atol=1e-10)
