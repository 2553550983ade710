"""Detection of a changed camera, marker or joint zero from one set of innovations (observed minus predicted pixels):
result types and the call of the numba kernel.

Hypotheses, each a change of few parameters:

    nothing                0
    camera k moved         6, a displacement; 8, a homography of its image, if the model is not metric; 2, a shift of
                           its image, if it sees too few points for that
    all cameras together   6, one displacement (metric)
    marker i slipped       3, its point; 2 if one camera sees it
    the zero of joint j    1
    all joints             n: their zeros, or a change with the same effect: a different tool, an arm that was pushed

Static points move with cameras only. Each hypothesis is estimated by Gauss-Newton iteration; `hypothesis_test` selects
among them. If two are nearly as good, both are returned: with one pose and no static point a displaced rig
cannot be distinguished from a displaced arm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereoservo.calibration.change import change_detection_kernel
from stereoservo.calibration.change.hypothesis_test import Thresholds
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import plain

ChangeKind = Literal["nothing", "camera", "cameras", "marker", "joint", "joints", "unexplained"]
KINDS: tuple[ChangeKind, ...] = ("nothing", "camera", "cameras", "marker", "joint", "joints", "unexplained")


@dataclass(frozen=True)
class IsolatedChange:
    """An estimated change: its ``kind`` and ``index`` (of the camera, marker or joint; -1 for all), its ``size`` in
    parameters and the remaining ``chi2``.

    ``amount``: angle [rad] of a displaced camera, offset [rad or m] of a joint's zero (for all joints: the largest),
    NaN for a motion of the image alone, 0 for a marker. ``effect_px``: rms displacement of the affected pixels.
    """

    kind: ChangeKind
    index: int
    size: int
    chi2: float
    amount: float
    effect_px: float


@dataclass(frozen=True)
class ChangeDiagnosis:
    """The change that best explains one set of innovations. ``measurements``: number of coordinates; ``chi2``
    without any change.

    ``kind`` ``unexplained``: not noise, and no single hypothesis explains it; ``cause`` is then the best one, or None.
    ``runner_up``: a cause that explains nearly as well, so that the two are indistinguishable; else None.
    """

    kind: ChangeKind
    cause: IsolatedChange | None
    runner_up: IsolatedChange | None
    chi2: float
    measurements: int

    @property
    def clear(self) -> bool:
        """Whether exactly one cause explains the innovations."""
        return self.kind not in ("nothing", "unexplained") and self.runner_up is None


def diagnose(
    matrices: FloatArray,
    points: FloatArray,
    innovations: FloatArray,
    weights: FloatArray,
    operators: FloatArray,
    twists: FloatArray | None,
    thresholds: Thresholds,
    static_points: FloatArray | None = None,
    static_innovations: FloatArray | None = None,
    static_weights: FloatArray | None = None,
) -> ChangeDiagnosis:
    """Diagnose one set of innovations with the compiled kernel; deterministic.

    ``matrices`` (c, 3, 4); ``points`` (m, 4) as predicted; ``innovations`` (c, m, 2) of ideal pixels [px] and
    ``weights`` (c, m) = 1/sigma [1/px], 0 if not seen; ``operators`` (n, 4, 4) at the current joints (5.21);
    ``twists`` (6, 4, 4) of a metric model, else None; static points (s, 4) likewise with (c, s, 2) and (c, s).
    """
    cameras, markers, joints = len(matrices), len(points), len(operators)
    X, e, w = points, innovations, weights
    if static_points is not None and static_innovations is not None and static_weights is not None:
        X = np.concatenate([points, static_points])
        e = np.concatenate([innovations, static_innovations], axis=1)
        w = np.concatenate([weights, static_weights], axis=1)
    count = cameras + 3 + markers + joints
    sizes, answer = np.zeros(count, dtype=np.int64), np.zeros(3, dtype=np.int64)
    chi2, amounts, effects = np.zeros(count), np.zeros(count), np.zeros(count)
    seen = change_detection_kernel.Innovations(
        np.ascontiguousarray(matrices),
        np.ascontiguousarray(X),
        markers,
        np.ascontiguousarray(e),
        np.ascontiguousarray(w),
        np.ascontiguousarray(operators),
        np.zeros((0, 4, 4)) if twists is None else twists,
    )
    found = change_detection_kernel.Explanations(sizes, chi2, amounts, effects, answer)
    change_detection_kernel.explain_innovations(
        plain(seen), thresholds.ratios, thresholds.log_alpha, thresholds.least_px, plain(found)
    )

    def cause(h: int) -> IsolatedChange | None:
        if h < 1:
            return None
        kind, index = hypothesis_subject(h, cameras, markers, joints)
        return IsolatedChange(kind, index, int(sizes[h]), float(chi2[h]), float(amounts[h]), float(effects[h]))

    return ChangeDiagnosis(
        KINDS[int(answer[0])],
        cause(int(answer[1])),
        cause(int(answer[2])),
        float(chi2[0]),
        2 * int((w > 0.0).sum()),
    )


def hypothesis_subject(h: int, cameras: int, markers: int, joints: int) -> tuple[ChangeKind, int]:
    """Kind and index of hypothesis ``h`` >= 1."""
    if h <= cameras:
        return "camera", h - 1
    if h == cameras + 1:
        return "cameras", -1
    if h < cameras + 2 + markers:
        return "marker", h - cameras - 2
    if h < cameras + 2 + markers + joints:
        return "joint", h - cameras - 2 - markers
    return "joints", -1
