"""Image-based stereo servoing: the pixel errors of all cameras stacked (thesis 8.36)."""

from __future__ import annotations

import numpy as np

from stereoservo.control.image_servoing import image_reasons, image_velocity_step
from stereoservo.control.law import Law, LawProperties, LawStep, Options, Scene, Task


def stereo(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(s* − s)``, all cameras stacked (8.36): with one camera left it is the law of one camera."""
    return image_velocity_step(scene, task, options, options.jacobian, np.zeros_like(task.rates))


LAW = Law(
    stereo,
    "image-based, in two cameras or more",
    one_camera="refused",
    options=("jacobian",),
    reasons=image_reasons,
    properties=LawProperties(
        centre="aside",
        face="not kept",
        works_on="pixels of two cameras or more",
        noise_at_rest="low",
        one_camera="use `image`",
        fails_when="large turns leave the image, or rest in a minimum; singular arm",
    ),
    colour="#0072b2",
    rank=10,
)
