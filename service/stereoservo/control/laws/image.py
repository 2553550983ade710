"""Control law ``image``: image-based servoing in any number of cameras; one is sufficient (thesis 8.26).

The Jacobian is evaluated at points predicted by the kinematics (8.29, 8.30), so that control continues when a camera
drops out.
"""

from __future__ import annotations

from stereoservo.control.law import Law, LawProperties, LawStep, Options, Scene, Task
from stereoservo.control.laws.stereo import image_kernel, image_reasons, image_velocity_step, standing


def image(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(s* − s)`` over the markers that are seen and required, in any number of cameras (8.26)."""
    return image_velocity_step(scene, task, options, options.jacobian, standing(task.rates.shape))


LAW = Law(
    image,
    "image-based, in the cameras that see: for one camera",
    one_camera="suffices",
    options=("jacobian",),
    reasons=image_reasons,
    kernel=image_kernel,
    properties=LawProperties(
        centre="far aside",
        face="not kept",
        works_on="pixels of the cameras that see",
        noise_at_rest="higher, along the ray",
        one_camera="made for it",
        fails_when="large turns: often",
    ),
    colour="#cc79a7",
    rank=20,
)
