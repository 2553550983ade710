"""Which libraries the processes of a daemon load: in fresh interpreters, as the processes themselves are."""

import pickle
import subprocess
import sys

import pytest

from stereoservo.control.law_registry import LAWS, LawRegistry
from stereoservo.daemon.kernel_compilation import example_settings
from stereoservo.messages.goals import FeatureTarget, Goal

KERNELS = ("numba", "llvmlite")


def _loaded(code: str, *libraries: str, given: bytes = b"") -> set[str]:
    """Those of ``libraries`` that a fresh interpreter has loaded after ``code``."""
    ask = f"{code}\nimport sys\nprint(*({set(libraries)!r} & set(sys.modules)))"
    ran = subprocess.run([sys.executable, "-c", ask], input=given, capture_output=True, check=True)
    return set(ran.stdout.decode().split())


@pytest.mark.parametrize(
    ("module", "libraries"),
    [
        ("stereoservo.client", ("numpy", "scipy", "cv2", *KERNELS)),
        ("stereoservo.daemon.supervisor", ("scipy", "cv2", "zenoh", *KERNELS)),
        ("stereoservo.gateway.process", ("scipy", "cv2", "matplotlib", *KERNELS)),
        ("stereoservo.daemon.vision", ("scipy", "zenoh", *KERNELS)),
        ("stereoservo.daemon.servo", ("scipy.linalg", "scipy.optimize", "scipy.stats", "cv2", "zenoh")),
    ],
)
def test_a_process_imports_only_what_it_needs(module: str, libraries: tuple[str, ...]) -> None:
    assert _loaded(f"import {module}", *libraries) == set()


def test_a_kernel_loads_the_compiler() -> None:
    assert _loaded("import stereoservo.numerics.linear", *KERNELS) == set(KERNELS)


def test_goals_are_checked_by_descriptions_of_laws() -> None:
    target = FeatureTarget({"left": dict.fromkeys(range(3), (10.0, 10.0))})
    goals = [Goal("00000000-0000", target, law=name, cameras=("left",)) for name in (*LAWS, "none")]
    given = pickle.dumps((LAWS.descriptions(), {"none": "broken"}, example_settings(), goals))
    code = """if True:
        import pickle, sys
        from stereoservo.control.law_registry import LAWS
        from stereoservo.gateway.validation import GoalContext, check_goal
        laws, errors, settings, goals = pickle.load(sys.stdin.buffer)
        LAWS.adopt(laws, errors)
        problems = [check_goal(goal, GoalContext(settings, (), None)) for goal in goals]
        accepted = {goal.law for goal, found in zip(goals, problems) if not found}
        assert accepted == {name for name, law in LAWS.items() if law.one_camera != "refused"}, problems
        assert "installed but broken: broken" in problems[-1][0], problems[-1]
    """
    assert _loaded(code, "scipy", *KERNELS, given=given) == set()


def test_adopted_laws_keep_order_and_properties_and_are_not_stepped() -> None:
    there = LawRegistry()
    there.adopt(LAWS.descriptions(), {})
    assert tuple(there) == tuple(LAWS)
    assert there.having("profile") == LAWS.having("profile")
    with pytest.raises(RuntimeError, match="cannot step"):
        there[next(iter(there))].step(None, None, None)
