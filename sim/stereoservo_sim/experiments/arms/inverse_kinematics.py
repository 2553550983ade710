"""Experiment: inverse kinematics of all families of arms (thesis 6) on random arms in random projective frames.

The projective solver is given operators and points or displacements; a metric solver that shares nothing with it judges
whether all solutions are found and how far their joints are off.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.inverse.recognition import Recognition, recognise
from stereoservo.kinematics.inverse.self_motion import corrected
from stereoservo.kinematics.inverse.solutions import InverseSolutions
from stereoservo.kinematics.inverse.solver import inverse_kinematics
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.arms.arm_families import FAMILIES, ArmFamily, SingularPose
from stereoservo_sim.experiments.arms.euclidean_inverse import EuclideanAxes
from stereoservo_sim.experiments.comparison import Comparison, of_statement
from stereoservo_sim.progress import ProgressCall

POSES = 100
"""Poses of each family by default."""
ARMS = 20
"""Arms, each in its own frame, that share the poses of a family."""
SAME = 1e-5
"""Largest difference of joints [rad or m] of a solution found and the metric one."""
SOLVED = 1e-8
FAR = 5.0
"""Way [m] by which a goal is moved out of reach."""
LEAST_DRAWN = 1e-17
WALK = 0.3
"""Motion [rad] along a self-motion that has to leave the goal reached."""

KEPT = 0.05
"""Motion [rad] along a self-motion of a singular pose that has to leave the goal reached."""

THESIS = "chapter 6 derives the solutions and prints no figure of their accuracy"


@dataclass(frozen=True, eq=False)
class Hidden:
    """An arm in a random projective frame (4, 4), as the projective solver sees it."""

    axes: EuclideanAxes
    frame: FloatArray
    chain: ProjectiveChain
    recognition: Recognition

    def solve(self, pose: FloatArray, point: FloatArray | None) -> InverseSolutions:
        """Projective solution for a Euclidean ``pose`` (4, 4), or for its effect on a ``point`` (3,)."""
        if point is None:
            H = self.frame @ pose @ np.linalg.inv(self.frame)
            return inverse_kinematics(self.chain, displacement=H, recognition=self.recognition)
        at_zero = np.append(point, 1.0)
        return inverse_kinematics(
            self.chain,
            points=(self.frame @ at_zero)[None],
            targets=(self.frame @ pose @ at_zero)[None],
            recognition=self.recognition,
        )


def hide(axes: EuclideanAxes, rng: np.random.Generator) -> Hidden:
    """Transform ``axes`` into a random, well-conditioned frame; random joint zeros."""
    while True:
        frame = np.eye(4) + 0.35 * rng.normal(size=(4, 4))
        if np.linalg.det(frame) > 0.2 and np.linalg.cond(frame) < 8.0:
            break
    kinds = tuple("revolute" if turns else "prismatic" for turns in axes.revolute)
    zero = rng.uniform(-1.0, 1.0, len(kinds))
    chain = ProjectiveChain(kinds, frame @ axes.twists() @ np.linalg.inv(frame), zero)
    return Hidden(axes, frame, chain, recognise(chain))


def run_inverse_kinematics(*, seeds: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Run every family over ``seeds`` poses, with a tenth as many singular and unreachable ones."""
    rows = []
    for i, (name, family) in enumerate(FAMILIES.items()):
        progress("inverse kinematics", i, len(FAMILIES))
        rows.append(family_row(name, family, seeds, np.random.default_rng([seed, i])))
    progress("inverse kinematics", len(FAMILIES), len(FAMILIES))
    return {
        "experiment": "inverse-kinematics",
        "seed": seed,
        "seeds": seeds,
        "rows": rows,
        "thesis": {},
        "assumptions": [
            THESIS,
            f"seeds are poses of a family, shared by up to {ARMS} random arms; joints uniform over a turn or 1 m",
            "found: solutions of the metric solver that the projective one has, too; others: further ones that forward "
            "kinematics confirms",
            "joint errors against the metric solver, rad or m; singular, unreachable, self-motion: handled of tried",
        ],
    }


def compare_inverse_kinematics(answer: dict[str, Any]) -> list[Comparison]:
    """Chapter 6: whether every solution of a metric solver is found, a family a row."""
    found = []
    for row in answer["rows"]:
        metric = row["solutions"] is not None
        tried = {name: row[name] for name in ("singular", "unreachable", "self_motion") if row[name]}
        handled = all(told.split(" of ")[0] == told.split(" of ")[1] for told in tried.values())
        ours = (
            f"{row['found_share']:.1%} of {row['solutions']}"
            if metric
            else f"{row['solved']} of {row['poses']} reached"
        )
        complete = row["solved"] == row["poses"] and (not metric or row["found_share"] == 1.0)
        ours += "".join(f"; {name.replace('_', '-')} {told}" for name, told in tried.items())
        found.append(
            of_statement("chapter 6", row["family"], "all solutions, from operators alone", ours, complete and handled,
                         "see the row's columns")
        )  # fmt: skip
    return found


def family_row(name: str, family: ArmFamily, poses: int, rng: np.random.Generator) -> dict[str, Any]:
    """The figures of one family."""
    solved = known = found = others = 0
    errors: list[float] = []
    residual = 0.0
    singular, unreachable, walked = [0, 0], [0, 0], [0, 0]
    cases: set[str] = set()
    extra = max(1, poses // 10)
    for count, corner in zip(_shares(poses), _shares(extra, len(_shares(poses))), strict=True):
        hidden = hide(family.axes(rng), rng)
        cases.add(hidden.recognition.case)
        axes = hidden.axes
        low, high = np.where(axes.revolute, -np.pi, -0.5), np.where(axes.revolute, np.pi, 0.5)
        q = rng.uniform(low, high, (count, len(low)))
        points = rng.uniform(-0.5, 0.5, (count, 3)) if family.single_point else None
        goals = axes.displacements(q)
        truth = family.judge(axes, goals, points, rng)
        for k in range(count):
            point = None if points is None else points[k]
            answer = hidden.solve(goals[k], point)
            solved += answer.reached
            residual = max(residual, float(answer.residuals.max(initial=0.0)))
            if truth is None:
                walked[1] += 1
                walked[0] += walk_handled(hidden, answer, goals[k])
                continue
            right = truth[k][~np.isnan(truth[k]).any(axis=1)]
            apart = differences(axes, right, answer.joints - hidden.chain.zero)
            matched = apart <= SAME
            known, found = known + len(right), found + int(matched.sum())
            others += max(0, len(answer.joints) - int(matched.sum()))
            errors += apart[matched].tolist()
        for _ in range(corner):
            if family.singular is not None:
                singular[1] += 1
                singular[0] += singular_handled(family.singular(hidden.axes, rng), hidden)
            if family.bounded:
                unreachable[1] += 1
                unreachable[0] += unreachable_handled(hidden, family, rng)
    return {
        "family": name,
        "case": " ".join(sorted(cases)),
        "poses": poses,
        "solved": solved,
        "solutions": known or None,
        "found_share": found / known if known else None,
        "others": others if known else None,
        "worst_joint_error": max(errors, default=None),
        "median_joint_error": float(np.median(errors)) if errors else None,
        "worst_residual": residual,
        "singular": _of(singular),
        "unreachable": _of(unreachable),
        "self_motion": _of(walked),
    }


def differences(axes: EuclideanAxes, right: FloatArray, joints: FloatArray) -> FloatArray:
    """Largest difference (s,) [rad or m] of each valid solution (s, n) to the nearest of ``joints`` (r, n)."""
    if not len(joints):
        return np.full(len(right), np.inf)
    apart = right[:, None] - joints[None]
    turned = np.where(axes.revolute, np.mod(apart + np.pi, 2.0 * np.pi) - np.pi, apart)
    return np.asarray(np.abs(turned).max(axis=2).min(axis=1), dtype=np.float64)


def singular_handled(pose: SingularPose, hidden: Hidden) -> bool:
    """Whether the result at a singular pose reaches it and reports the free joint, or is the isolated solution.

    Where a wrist is nearly aligned (``w`` rad from it) before a stretched elbow, the elbow has to move in proportion to
    ``w`` times the wrist's turn, and the goal is left by the order of the square of that: a continuum to within the
    tolerance, if metric kinematics confirms it.
    """
    goal = hidden.axes.displacements(pose.joints[None])[0]
    answer = hidden.solve(goal, pose.point)
    if not answer.reached or answer.residuals.max() > SOLVED:
        return False
    if pose.free is not None:
        return answer.outcome == "continuum" and any(pose.free in free for free in answer.free_joints)
    apart = differences(hidden.axes, pose.joints[None], answer.joints - hidden.chain.zero)
    return bool(apart[0] <= 1e-3) and (
        answer.outcome == "isolated" or kept_along(hidden, answer, goal, pose.point)
    )


def kept_along(hidden: Hidden, answer: InverseSolutions, goal: FloatArray, point: FloatArray | None) -> bool:
    """Whether metric forward kinematics is at the ``goal`` (4, 4), or at what it does to ``point`` (3,), all along the
    self-motions of ``answer``, over `KEPT` either way; False where it has none.
    """
    back = np.linalg.inv(hidden.frame)
    points = np.eye(4) if point is None else (hidden.frame @ np.append(point, 1.0))[None]
    targets = points @ (hidden.frame @ goal @ back).T
    kept = []
    for q, motions in zip(answer.joints, answer.self_motions, strict=True):
        for motion in (sense * motion for motion in motions for sense in (1.0, -1.0)):
            ahead = corrected(hidden.chain, points, targets, q + KEPT * motion, SOLVED)[0]
            pose = hidden.axes.displacements((ahead - hidden.chain.zero)[None])[0]
            left = points @ (hidden.frame @ pose @ back).T - targets
            reached = np.linalg.norm(left) <= SOLVED * np.linalg.norm(targets)
            kept.append(bool(reached and (ahead - q) @ motion > 0.5 * KEPT))
    return bool(kept) and all(kept)


def unreachable_handled(hidden: Hidden, family: ArmFamily, rng: np.random.Generator) -> bool:
    """Whether a distant goal is reported as unreachable, with the closest approach."""
    q = rng.uniform(-0.5, 0.5, (1, len(hidden.axes.revolute)))
    goal = hidden.axes.displacements(q)[0]
    away = rng.normal(size=3)
    goal[:3, 3] += FAR * away / np.linalg.norm(away)
    point = rng.uniform(-0.5, 0.5, 3) if family.single_point else None
    answer = hidden.solve(goal, point)
    short = answer.shortfall
    return bool(answer.outcome == "unreachable" and short is not None and short.residual > SOLVED)


def walk_handled(hidden: Hidden, answer: InverseSolutions, goal: FloatArray) -> bool:
    """Whether the reported self-motion of a redundant arm keeps the goal reached over `WALK`."""
    if not answer.reached or not len(answer.self_motions[0]):
        return False
    target = (hidden.frame @ goal @ np.linalg.inv(hidden.frame)).T
    q, motion = answer.joints[0], answer.self_motions[0][0]
    for _ in range(10):
        q, residual = corrected(hidden.chain, np.eye(4), target, q + 0.1 * WALK * motion, SOLVED)
        if residual > SOLVED:
            return False
    return bool(np.abs(q - answer.joints[0]).max() > 0.1 * WALK)


def _of(handled: list[int]) -> str | None:
    return f"{handled[0]} of {handled[1]}" if handled[1] else None


def _shares(poses: int, arms: int | None = None) -> list[int]:
    """Number of ``poses`` of each arm."""
    arms = max(1, min(ARMS, poses // 5)) if arms is None else arms
    return [poses // arms + (i < poses % arms) for i in range(arms)]


def draw_inverse_kinematics(answer: dict[str, Any], folder: Path) -> list[Path]:
    """Joint errors of each family against the metric solver: median and worst."""
    rows = [row for row in answer["rows"] if row["worst_joint_error"] is not None]
    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    places = np.arange(len(rows))
    for key, label, colour in (
        ("median_joint_error", "median", "#0072b2"),
        ("worst_joint_error", "worst", "#d55e00"),
    ):
        axis.plot([max(row[key], LEAST_DRAWN) for row in rows], places, "o", color=colour, label=label)
    axis.set_yticks(places, [f"{row['family']} ({row['found_share']:.0%})" for row in rows], fontsize=8)
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.set_xlabel(
        f"joint error [rad or m] over {answer['seeds']} poses; in brackets: share of solutions found",
        fontsize=8,
    )
    axis.legend(fontsize=8)
    path = folder / "inverse-kinematics.png"
    figure.savefig(path, dpi=110)
    return [path]
