"""EDS files as editors, makers' tools and crashes leave them: what is good is read, the rest is listed."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from corrupted import corrupted_copies
from stereoservo.messages.text_files import Remark
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.canopen.cia402_configuration import SHIPPED_EDS, load_eds
from stereoservo_drivers.canopen.eds_files import MOST_BYTES, number_in, read_eds

SHIPPED = SHIPPED_EDS.read_text()
DATA = Path(os.environ.get("STEREOSERVO_DATA", Path(__file__).parents[4] / "shared" / "data"))
SMALL = Path(__file__).parents[2] / "sim/emulators/bus/cia402/small.eds"
Objects = dict[tuple[int, int], dict[str, object]]


def objects(dictionary: canopen.ObjectDictionary) -> Objects:
    """All that is known of each value, by index and sub-index; sub-index -1: of the object as a whole."""
    found: Objects = {}
    for index, described in dictionary.items():
        members = [described] if isinstance(described, ODVariable) else described.subindices.values()
        found[index, -1] = {"kind": type(described).__name__, "name": described.name}
        for each in members:
            found[index, each.subindex] = {key: value for key, value in vars(each).items() if key != "parent"}
    return found


WHOLE = objects(canopen.import_od(str(SHIPPED_EDS)))

Read = Callable[[str | bytes], tuple[Objects, list[Remark]]]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    def run(content: str | bytes) -> tuple[Objects, list[Remark]]:
        path = tmp_path / "drive.eds"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        dictionary, remarks = read_eds(path)
        return objects(dictionary), remarks

    return run


def with_line(new: str, before: str = "VendorNumber=") -> str:
    """The shipped file with a line before the first that begins with ``before``."""
    at = SHIPPED.index(f"\n{before}") + 1
    return f"{SHIPPED[:at]}{new}\n{SHIPPED[at:]}"


def in_place(old: str, new: str) -> str:
    assert old in SHIPPED
    return SHIPPED.replace(old, new, 1)


def test_a_good_file_has_no_remarks(read: Read) -> None:
    assert read(SHIPPED) == (WHOLE, [])


@pytest.mark.parametrize(
    ("content", "line", "told"),
    [
        (with_line("VendorName2=Antriebe Müller GmbH").encode("cp1252"), 20, "0xfc is not UTF-8: .* code page 1252"),
        (with_line("VendorName2=Antriebe Müller GmbH\x81").encode("latin-1"), 20, "code page 1252"),
        (SHIPPED.encode("utf-16"), 1, "UTF-16-LE"),
        (b"\xfe\xff" + SHIPPED.encode("utf-16-be"), 1, "UTF-16-BE"),
        (SHIPPED.encode("utf-16-le"), 1, "UTF-16-LE"),
        (SHIPPED.encode() + bytes(512), 0, "512 zero bytes"),
        (in_place("VendorNumber=0x53455256", "VendorNumber=001"), 20, "'VendorNumber=001': read as 1"),
        (in_place("ProductNumber=0x00000402", "ProductNumber=0010"), 22, r"read as 10 \(octal, .*: 8\)"),
        (in_place("RevisionNumber=0x00010000", "RevisionNumber=one"), 23, "'RevisionNumber=one': not a number"),
        (with_line("this line is a remark\n"), 20, "'this line is a remark': neither a header nor KEY=VALUE"),
        (f"a line of a tool = 5\n{SHIPPED}", 1, "before any section"),
        (with_line("ParameterName=Device type", "ObjectType="), None, None),
        (with_line("ObjectType=0x9", "DataType=0x0007"), 60, "ObjectType of .1000. again: the first, '0x7', is used"),
        (f"{SHIPPED}\n[1000]\nParameterName=Other\nDataType=0x5\nAccessType=rw\n", 1849, "as in line 57"),
        (in_place("[6040]", "[6040"), 1494, "without ']'"),
        (in_place("[6040]", "6040]"), 1494, r"without '\['"),
        (in_place("[6040]", "[ 0x6040 ]  trailing"), 1494, "'trailing': neither a header"),
        (in_place("[1018sub1]", "[1018 SUB01]"), None, None),
        (in_place("Device type\nObjectType=0x7\n", "Device type\n"), None, None),
        (in_place("Identity object\nObjectType=0x9\n", "Identity object\n"), None, None),
        (in_place("ObjectType=0x7\nDataType=0x0007\nAccessType=ro", "ObjectType=0x77\nDataType=0x0007\nAccessType=ro"),
         59, "ObjectType=119"),
        (SHIPPED.replace("\n", "\r\n"), None, None),
        (SHIPPED.replace("\n", "\r"), None, None),
        ("\n".join(f"\t {line} " for line in SHIPPED.split("\n")), None, None),
        (SHIPPED.replace("=", " = ").replace("DataType", "datatype"), None, None),
        (SHIPPED.replace("ParameterName", "PARAMETERNAME").replace("AccessType=ro", "AccessType=RO"), None, None),
        ("\ufeff" + SHIPPED, None, None),
        (SHIPPED[SHIPPED.index("[DummyUsage]") :], 0, "no .DeviceInfo."),
    ],
)  # fmt: skip
def test_one_oddity_changes_no_object_and_is_told(
    read: Read, content: str | bytes, line: int | None, told: str | None
) -> None:
    found, remarks = read(content)
    assert found == WHOLE
    assert [remark.line for remark in remarks] == ([] if line is None else [line])
    if told is not None:
        assert re.search(told, str(remarks[0])), remarks


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("7", 7), ("0x7", 7), ("0X0007", 7), ("007", 7), ("0089", 89), ("0010", 10), ("10h", 16), ("$1F", 31),
        ("16#1F", 31), ('"0x7"', 7), ("0x 00 07", 7), ("0x7UL", 7), ("7;five", 7), ("7 // five", 7), ("7#five", 7),
        ("00FF", 255), ("7.0", 7), ("+7", 7), ("-5", -5), ("TRUE", 1), ("no", 0), ("", None), ("0x", None),
        ("beef", None), ("12g", None), ("1.5", None), ("٣", None), ("9" * 5000, None),
    ],
)  # fmt: skip
def test_numbers(text: str, number: int | None) -> None:
    assert number_in(text) == number


@pytest.mark.parametrize("value", ["0" * 5000, "07" * 5000, "9" * 5000, "0x" + "f" * 5000, "$NODEID", "[", "\x1c;"])
@pytest.mark.parametrize("key", ["ObjectType", "DataType", "PDOMapping", "DefaultValue", "VendorNumber"])
def test_absurd_values_cost_at_most_their_object(read: Read, key: str, value: str) -> None:
    at = SHIPPED.index(f"\n{key}=")
    found = read(f"{SHIPPED[:at]}\n{key}={value}{SHIPPED[SHIPPED.index(chr(10), at + 1) :]}")[0]
    assert {index for index, _ in WHOLE} - {index for index, _ in found} <= {0x1000}
    assert {index for index, _ in found} <= {index for index, _ in WHOLE}


@pytest.mark.parametrize("data_type", ["07", "7h", "0x 0007", '"0x0007"', "0x0007;unsigned", "0x0007  ; unsigned"])
def test_forms_of_a_data_type(read: Read, data_type: str) -> None:
    assert read(in_place("DataType=0x0007", f"DataType={data_type}"))[0] == WHOLE


def test_one_bad_object_costs_that_one_alone(read: Read) -> None:
    found, remarks = read(in_place("[1000]\nParameterName=Device type\nObjectType=0x7\nDataType=0x0007",
                                   "[1000]\nParameterName=Device type\nObjectType=0x7\nDataType=long"))  # fmt: skip
    assert found == {key: value for key, value in WHOLE.items() if key[0] != 0x1000}
    assert [remark.line for remark in remarks] == [57, 60]
    assert "'DataType=long': not a number" in str(remarks[1])


def test_a_missing_header_takes_nothing_else_along(read: Read) -> None:
    found, remarks = read(in_place("[6041]\n", ""))
    assert found == {key: value for key, value in WHOLE.items() if key[0] != 0x6041}
    assert ["1 of 70 listed objects" in str(remarks[0]), "0x6041" in str(remarks[0])] == [True, True]
    assert "the header of this object is missing" in str(remarks[1])


def test_members_whose_object_is_missing_are_kept_if_the_lists_name_it(read: Read) -> None:
    identity = "[1018]\nParameterName=Identity object\nObjectType=0x9\n"
    found, remarks = read(in_place(identity, ""))
    assert found.keys() == WHOLE.keys()
    assert any("taken for a record" in str(remark) for remark in remarks)
    found, remarks = read(in_place(identity, identity.replace("1018", "9018")))  # or it would be there twice
    assert {index for index, _ in found} == {index for index, _ in WHOLE} - {0x1018} | {0x9018}
    assert any("[1018] is missing: skipped" in str(remark) for remark in remarks)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.77, 0.9, 0.99])
def test_a_cut_file_is_read_up_to_the_cut(read: Read, share: float) -> None:
    cut = SHIPPED[: round(len(SHIPPED) * share)]
    found, remarks = read(cut)
    complete = {
        int(line[1:5], 16) for line in cut[: cut.rindex("\n[")].split("\n") if line[:1] == "[" and line[5:] == "]"
    }
    of_last = int(cut[cut.rindex("\n[") :][2:6], 16)
    assert {index for index, _ in found} - {of_last} == complete - {of_last}
    assert all(value == WHOLE[key] for key, value in found.items() if key[0] != of_last)
    assert share < 0.5 or any("are missing" in remark.assumed for remark in remarks)


def test_compact_arrays_and_types_of_the_file_itself(tmp_path: Path) -> None:
    text = (
        "[DeviceInfo]\n[A0]\nParameterName=Own type\nObjectType=0x5\n"
        "[A0sub1]\nParameterName=Type\nDefaultValue=0x0005\n"
        "[2000]\nParameterName=Own\nDataType=0x00A0\nAccessType=ro\n[2001]\nParameterName=Far\nDataType=0x99\nAccessType=ro\n"
        "[1003]\nParameterName=Errors\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=3\n"
        "[1003Name]\nNrOfEntries=3\n1=First\n2=Second\n3=Third\n[DeviceComissioning]\nNodeID=0x05\nBaudrate=500\n"
        "[1014]\nParameterName=Emergency\nDataType=7\nAccessType=rw\nDefaultValue=$NODEID+0x80\n"
    )
    path = tmp_path / "own.dcf"
    path.write_text(text)
    found = read_eds(path)[0]
    assert objects(found) == objects(canopen.import_od(str(path)))
    assert (found[0x2000].data_type, found[0x1003][3].name, found[0x1014].default) == (5, "Third", 0x85)
    assert read_eds(path, 7)[0][0x1014].default == 0x87


@pytest.mark.parametrize("name", ["epos2", "epos4", "erb415", "everest_xcr", "eyou", "schunk_lwa4p", "technosoft"])
def test_makers_files_give_what_they_gave(name: str) -> None:
    path = DATA / "eds" / f"{name}.eds"
    if not path.is_file():
        pytest.skip(f"no {path}; $STEREOSERVO_DATA names the folder of the makers' EDS files")
    found, remarks = read_eds(path)
    former = canopen.import_od(str(path))
    assert objects(found) == objects(former)
    of, was = found.device_information, former.device_information
    assert (of.vendor_number, of.product_number) == (was.vendor_number, was.product_number)
    unlisted = "2 of 89 objects are in none of the file's lists, the first 0x606A: taken all the same"
    assert [str(remark) for remark in remarks] == [unlisted] * (name == "erb415")


@pytest.mark.parametrize(
    "case",
    [
        "12_eds_windows_1252/cp1252_umlaut",
        "13_eds_vendor_number_001/vendor_001",
        "16_eds_line_without_equals/line_without_=",
    ],
)
def test_reported_files(case: str) -> None:
    path = DATA / "reports" / f"case_{case}.eds"
    if not path.is_file():
        pytest.skip(f"no {path}; $STEREOSERVO_DATA names the folder of the reported cases")
    assert objects(load_eds(path)) == WHOLE


@pytest.mark.parametrize(("path", "count"), [(SHIPPED_EDS, 60), (SMALL, 340)])
def test_corrupted_files_lose_objects_and_gain_none_untold(tmp_path: Path, path: Path, count: int) -> None:
    whole, usual = read_eds(path)
    damaged, told = tmp_path / "damaged.eds", 0
    for data in corrupted_copies(path.read_bytes(), count, 9):
        damaged.write_bytes(data)
        try:
            found, remarks = read_eds(damaged)
        except DriverError:
            continue
        assert len(found) > 0
        assert len(found) <= len(whole) or "in none of the file's lists" in "".join(map(str, remarks))
        told += remarks != usual
    assert told > count // 2


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "begins with b''"),
        (b"<?xml version='1.0'?>\n<ISO15745Profile>\n", r"line 1: .*before any section"),
        (b"\x7fELF\x02\x01\x01\nno\n", "line 1: .*neither a header"),
        (b"[FileInfo]\nFileName=x.eds\n", r"begins with b'\[FileInfo\]"),
        (b"[6040]\nParameterName=Control word\nAccessType=rw\n", r"line 1: '\[6040\]': without a data type"),
        (bytes(MOST_BYTES + 1), f"larger than {MOST_BYTES} bytes"),
    ],
)
def test_refused_with_the_first_line(read: Read, content: bytes, told: str) -> None:
    with pytest.raises(DriverError, match=told) as refusal:
        read(content)
    assert refusal.value.code == "eds"
