"""The structure of the code: its figures stay within their limits (`house_figures.py` prints all)."""

import importlib.util
import sys
from pathlib import Path

import pytest


def _loaded(name):
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


house = _loaded("house_figures")
pictures = _loaded("house_pictures")


def test_modules_do_not_import_each_other_in_circles():
    assert house.circle_figure().items == ()


def test_few_modules_have_one_importer():
    """These only become fewer: whoever joins one to its importer lowers `ONE_IMPORTER` and `ONE_IN_FOLDER`."""
    for figure in house.importer_figures():
        assert figure.within, (figure.name, figure.value, figure.items)


def test_importers_are_counted_in_functions_and_as_entry_points(product_of, tmp_path):
    (tmp_path / "pyproject.toml").write_text('[project.entry-points."a"]\nb = "stereoservo.plugin:make"\n')
    product_of("one/user.py", "def late():\n    from stereoservo.one import piece\nimport stereoservo.plugin\n")
    product_of("one/piece.py", "")
    product_of("plugin.py", "from stereoservo import shared\n")
    product_of("shared.py", "")
    product_of("other.py", "from stereoservo.shared import name\nimport stereoservo.one.user\n")
    single, beside = house.importer_figures()
    assert set(single.items) == {
        "stereoservo.one.piece <- stereoservo.one.user", "stereoservo.one.user <- stereoservo.other",
    }  # fmt: skip
    assert beside.items == ("stereoservo.one.piece",)


def test_the_product_does_not_grow_unseen():
    """Whoever makes it smaller lowers `CODE_LINES`, `FILES`, `LAYOUT_EXCEPTIONS`; whoever needs more says why."""
    for figure in house.size_figures():
        assert figure.within, figure


def test_lines_of_code_are_those_that_hold_code():
    text = '"""Doc\nstring."""\n\n# comment\nx = 1  # one\n\n\ndef f():\n    """Doc."""\n    return """a\n\nb"""\n'
    assert house.code_lines(text) == 5


def test_modules_are_not_longer_than_the_limit():
    assert house.module_figure().items == ()


def test_no_function_is_beyond_its_limit():
    assert house.function_figure().items == ()


def test_functions_have_few_parameters():
    """Verbs of the command line that have more only become fewer: whoever takes one away lowers `VERBS`."""
    others, verbs = house.parameter_figures()
    assert others.items == ()
    assert verbs.value == house.VERBS, verbs.items


@pytest.fixture
def product_of(tmp_path, monkeypatch):
    """Makes a module with a text, at a path below the service, all that the product is."""

    def product(path, text):
        module = tmp_path / "service/stereoservo" / path
        module.parent.mkdir(parents=True, exist_ok=True)
        module.write_text(text)
        monkeypatch.setattr(house, "ROOT", tmp_path)
        monkeypatch.setattr(house, "PRODUCT", (tmp_path / "service/stereoservo",))

    return product


def test_every_function_but_a_verb_has_its_parameters_counted(product_of):
    ten = ", ".join("abcdefghij")
    product_of(
        "cli/module.py",
        f"def few({ten}): ...\ndef many(z, /, {ten}): ...\ndef by_name(a, *, b, c, d, e, f, g, h, i, j, k): ...\n"
        f"class One:\n    def few(self, {ten}): ...\n    async def many(self, z, {ten}): ...\n"
        f"def verb(z: TextOption, {ten}): ...\n",
    )
    others, verbs = ([item.partition(" ")[2] for item in figure.items] for figure in house.parameter_figures())
    assert sorted(others) == ["by_name: 11", "many: 11", "many: 11"]
    assert verbs == ["verb: 11"]


def test_kernels_have_few_arguments():
    assert house.argument_figure().items == ()


def test_arguments_of_every_kind_of_kernel_are_counted(product_of):
    seven = ", ".join("abcdefg")
    product_of(
        "module.py",
        f"@kernel\ndef few(a, b, c, d, e, f): ...\n@reassociating_kernel\ndef many({seven}): ...\n"
        f"@kernel\ndef by_name(a, b, c, d, *, e, f, g): ...\ndef no_kernel({seven}): ...\n",
    )
    assert house.kernel_arguments() == {"service/stereoservo/module.py": ["many 7", "by_name 7"]}


@pytest.fixture(scope="module")
def paths():
    return house.path_figures()


def test_paths_enter_few_files(paths):
    """What is beyond what is asked only becomes less: whoever makes it so lowers it in `TODAY`, or takes it out."""
    for figure in paths:
        asked = figure.name.partition(" (asked ")[0]
        if asked in house.TODAY:
            assert figure.value <= figure.limit, (figure.name, figure.items)
        else:
            assert figure.within, (figure.name, figure.items)
    names = {figure.name.partition(" (asked ")[0] for figure in paths}
    assert set(house.TODAY) <= names


def test_a_path_goes_from_the_camera_driver_to_the_joint_driver(paths):
    image = {figure.name.partition(" (asked ")[0]: set(figure.items) for figure in paths}
    run, read = (image[f"files from image to velocity as {how}"] for how in ("run", "read"))
    assert run < read
    assert {
        "drivers/stereoservo_drivers/simulated_camera.py",
        "drivers/stereoservo_drivers/detectors/dots.py",
        "service/stereoservo/daemon/vision.py",
        "service/stereoservo/daemon/seqlock.py",
        "service/stereoservo/daemon/servo.py",
        "service/stereoservo/core/servo_core.py",
        "service/stereoservo/control/laws/stereo.py",
        "drivers/stereoservo_drivers/simulated_arm.py",
    } <= run
    assert not [file for file in read if file.startswith("sim/")]


def test_the_pictures_in_the_design_page_are_those_of_the_code():
    """`python tests/house_pictures.py` draws them again."""
    text = pictures.DESIGN.read_text("utf-8")
    assert pictures.drawn(text, pictures.PACKAGES) == pictures.draw_packages()
    assert pictures.drawn(text, pictures.IMAGE_PATH) == pictures.draw_image_path(house.image_path())


def test_a_path_counts_files_and_hops():
    from stereoservo.core.ingest import nominal_period_ns
    from stereoservo.messages.reasons import Reason

    path = house.traced(lambda: Reason("A", "info"))
    assert path == (frozenset(), 0, ())

    class Settings:
        rate_hz = 250.0

    file = "service/stereoservo/core/ingest.py"
    path = house.traced(lambda: nominal_period_ns(Settings()))
    assert path == (frozenset({file}), 0, ((file, "nominal_period_ns"),))
    assert path.read == path.files


def test_a_path_on_which_a_kernel_is_loaded_is_no_figure():
    from stereoservo.numerics.compilation import kernel

    @kernel
    def twice(x):
        return 2 * x

    assert twice(1) == 2
    with house.nothing_loaded():
        assert twice(2) == 4
    with pytest.raises(RuntimeError, match="twice"), house.nothing_loaded():
        twice(1.0)


def test_kernels_of_kernels_are_those_that_numba_reaches():
    """By the values of names, as the cache of kernels has them, not by the source."""
    from stereoservo.control.laws import cartesian3
    from stereoservo.core import command
    from stereoservo.numerics import compilation, kernel_cache

    roots = [command.command, cartesian3.LAW.kernel]
    seen, waiting = set(), [root.py_func for root in roots]
    while waiting:
        function = waiting.pop()
        if function not in seen:
            seen.add(function)
            waiting.extend(kernel_cache._named_by(function)[1])
    names = {(f.__module__, f.__qualname__) for f in seen} & set(compilation.KERNELS)
    files = {house._dotted(path): house._name(path) for path in house.modules()}
    asked = {(files[root.py_func.__module__], root.py_func.__qualname__) for root in roots}
    assert len(names) > 20
    assert house.called_kernels(asked) == {(files[module], name) for module, name in names}
