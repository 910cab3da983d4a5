"""DH tables and URDFs from files: what is read, what is written, and every refusal by file, place and fix."""

import math
from dataclasses import replace

import numpy as np
import pytest
from robots_of_others import ODD_URDF, PUMA_TOML, UR5_CSV, UR5_URDF

from casacal import Conventions, Joint, Robot
from casacal.errors import ProblemError
from casacal.model.dh_file import conventions_toml, dh_file_text, quarter_turns, read_dh_file


@pytest.fixture
def file(tmp_path):
    def write(text, name):
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return tmp_path / name

    return write


def test_a_csv_table(file):
    table = read_dh_file(file(UR5_CSV, "ur5.csv"))
    assert (table.name, table.convention, table.parallel) == ("UR5", "standard", (2, 3))
    np.testing.assert_allclose(table.alpha, np.radians([90, 0, 0, 90, -90, 0]))
    assert table.a == (0, -425, -392.25, 0, 0, 0)
    assert table.d == (89.159, 0, 0, 109.15, 94.65, 82.3)
    assert table.joints[2] == Joint("revolute", -math.pi, math.pi)
    assert table.conventions is None


def test_a_toml_table_in_mixed_units(file):
    table = read_dh_file(file(PUMA_TOML, "puma.toml"))
    np.testing.assert_allclose(table.alpha, np.radians([90, 0, -90, 90, -90, 0]))
    np.testing.assert_allclose(table.a, [0, 431.8, 20.3, 0, 0, 0])
    assert table.joints[3] == Joint("revolute", math.radians(-110), math.radians(170))
    assert table.conventions.signs == (1, -1, -1, 1, 1, 1)
    np.testing.assert_allclose(table.conventions.offsets, np.radians([0, 90, -90, 0, 0, 0]))
    assert table.conventions.coupling == ((3, 2, -1.0),)


SLIDE = """# convention: modified;;;;;;;;;
# signs: 1 1 -1
# offsets_deg: 0; 90; 0
# offsets_m: 0 0 0.25
# coupling: 2 1 0.5; 1 2 -1
joint;alpha_rad;a_m;d_m;theta_rad;kind;lower_deg;upper_deg;lower_mm;upper_mm
1;0;0;0,4;0;R;-100;100;;
2;1,5;0,3;0;0;R;-90;90;;
3;0;0;0;0;P;;;0;200
"""


def test_a_spreadsheet_of_another_country_with_a_slide(file):
    table = read_dh_file(file(SLIDE.encode("utf-16"), "slide.csv"))
    assert table.name == "slide"
    assert table.convention == "modified"
    assert table.d == (400, 0, 0)
    assert table.joints[2] == Joint("prismatic", 0, 200)
    np.testing.assert_allclose(table.conventions.offsets, (0, math.pi / 2, 250))
    assert table.conventions.coupling == ((2, 1, 0.5), (1, 2, -1.0))


@pytest.mark.parametrize("name", ["again.csv", "again.toml"])
@pytest.mark.parametrize(("text", "source"), [(UR5_CSV, "a.csv"), (PUMA_TOML, "a.toml"), (SLIDE, "a.csv")])
def test_what_is_written_is_read_again(file, text, source, name):
    table = read_dh_file(file(text, source))
    again = read_dh_file(file(dh_file_text(table, name), name))
    for key in ("alpha", "a", "d", "theta"):
        np.testing.assert_allclose(getattr(again, key), getattr(table, key), rtol=1e-11)
    assert (again.name, again.convention, again.parallel) == (table.name, table.convention, table.parallel)
    for one, two in zip(again.joints, table.joints, strict=True):
        assert (one.kind, one.lower, one.upper) == (two.kind, pytest.approx(two.lower), pytest.approx(two.upper))
    if table.conventions is not None:
        np.testing.assert_allclose(again.conventions.matrix, table.conventions.matrix)
        np.testing.assert_allclose(again.conventions.offsets, table.conventions.offsets)


def test_beta_is_read_and_written(file):
    text = UR5_CSV.replace("theta_deg,kind", "theta_deg,beta_deg,kind").replace(",0,revolute", ",0,0.5,revolute")
    text = text.replace("1,90,0,89.159,0,0.5", "1,90,0,89.159,0,").replace("109.15,0,0.5", "109.15,0,")
    text = text.replace("94.65,0,0.5", "94.65,0,").replace("82.3,0,0.5", "82.3,0,0")
    table = read_dh_file(file(text, "a.csv"))
    np.testing.assert_allclose(table.beta, np.radians([0.5, 0.5]))
    for name in ("b.csv", "b.toml"):
        np.testing.assert_allclose(read_dh_file(file(dh_file_text(table, name), name)).beta, table.beta)
    with pytest.raises(ProblemError, match="line 11: row 6 has beta but is not named in parallel"):
        read_dh_file(file(text.replace("82.3,0,0,", "82.3,0,0.1,"), "c.csv"))


def test_the_block_alone(file):
    conventions = Conventions((1, -1, 1), (0.0, math.pi / 2, 20.0), ((3, 2, -1.0),))
    joints = Robot("r", "RRP", lambda p, q: q, {}).axes
    text = conventions_toml(conventions, joints)
    assert "offsets_deg = [0, 90, 0]" in text
    assert "offsets_mm = [0, 0, 20]" in text
    bare = replace(read_dh_file(file(PUMA_TOML, "puma.toml")), conventions=None)
    plain = Conventions((1, -1, 1, 1, 1, 1), (0.0, math.pi / 2, 0.0, 0.0, 0.0, 0.0))
    for meant in (plain, replace(plain, coupling=((3, 2, -1.0),))):
        block = file(dh_file_text(bare, "a.toml") + "\n" + conventions_toml(meant), "block.toml")
        assert read_dh_file(block).conventions == meant


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("# convention: standard\n", "", "does not say its convention"),
        ("standard", "Craig", "has the convention 'Craig'"),
        ("# convention", "# conventions", "line 3: there is no key 'conventions'. Write '# convention: ...'"),
        ("# parallel: 2, 3", "# parallel: 2, 4", "Row 4 of 'UR5' is declared parallel"),
        ("# parallel: 2, 3", "# parallel: two", "line 4: 'two' is not a number"),
        ("# parallel: 2, 3", "# parallel: 2.5", "Give whole numbers"),
        ("# parallel: 2, 3", "# name: again", "'name' comes a second time"),
        ("# parallel: 2, 3", "# signs: 1 1", "2 joints|offset|sign"),
        ("# parallel: 2, 3", "# signs: 2 1 1 1 1 1", "Use 1 or -1"),
        ("# parallel: 2, 3", "# coupling: 3 2", "joint, joint and factor"),
        ("# parallel: 2, 3", "# coupling: 3 9 1", "two different joints of 1 to 6"),
        (
            "# parallel: 2, 3",
            "# signs: 1 1 -1 1 1",
            r"^\S*bad.csv: signs has 5 numbers for 6 joints. Give one per joint",
        ),
        ("# parallel: 2, 3", "# signs: 2 1 1 1 1 1", r"^\S*bad.csv: The joint signs are"),
        ("# parallel: 2, 3", "# offsets_deg: 1 2", "offsets_deg has 2 numbers for 6 joints"),
        ("# parallel: 2, 3", "# offsets_mm: 1 0 0 0 0 0", "gives 1 for joint 1, which is revolute"),
        ("alpha_deg", "alpha", "there is no field 'alpha'. Say the unit: alpha_deg or alpha_rad"),
        ("theta_deg,", "gamma_deg,", "there is no field 'gamma_deg'"),
        ("alpha_deg", "alpha_rad", "line 6: alpha_rad is 90"),
        ("1,90,", "1,1.5708,", "line 6: alpha_deg is 1.5708, which is 1 quarter turns"),
        ("1,90,", "1,270,", "line 6: alpha_deg is 270; a twist is within half a turn. Write -90, which is the same"),
        ("1,90,", "1,9000,", "line 6: alpha_deg is 9000; a twist"),
        ("_mm", "_m", "the largest length is 425000 mm"),
        ("1,90,", "1,,", "line 6: there is no alpha"),
        ("1,90,", "1,ninety,", "line 6, 'alpha_deg': 'ninety' is not a number"),
        ("\n2,0,", "\n3,0,", "line 7: this is joint 3. Number"),
        ("1,90,0,89.159,0,revolute", "1,90,0,89.159,0,ball", "the kind is 'ball'"),
        ("1,90,0,89.159,0,revolute", "1,90,0,89.159,0,prismatic", "a prismatic joint has lower_deg"),
        ("-360,360\n2", "360,-360\n2", "line 6: A joint has the limits 360 to -360 degrees. Give"),
        ("-360,360\n2", ",360\n2", "line 6: there is no lower"),
        ("1,90,0,89.159,0,revolute,-360,360", "1,90", "the line has 2 cells"),
    ],
)
def test_bad_csv_is_refused_by_line(file, old, new, words):
    assert old in UR5_CSV
    path = file(UR5_CSV.replace(old, new, 1) if old != "_mm" else UR5_CSV.replace(old, new), "bad.csv")
    with pytest.raises(ProblemError, match=words) as refused:
        read_dh_file(path)
    assert "bad.csv" in str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"standard"', "standard", "this is not TOML"),
        ('convention = "standard"', "", "does not say its convention"),
        ("parallel = [2]", "parallel = 2", "Write it like"),
        ("parallel = [2]", "paralel = [2]", "Did you mean 'parallel'"),
        ("[conventions]", "[convention_block]", "there is no field 'convention_block'"),
        ("signs =", "sign =", "Did you mean 'signs'"),
        ("coupling = [[3, 2, -1.0]]", "coupling = [3, 2, -1.0]", "coupling is"),
        ("coupling = [[3, 2, -1.0]]", "coupling = [[3, 2]]", "coupling is"),
        ("a_m = 0.4318", 'a_m = "0.4318"', "joint 2: a_m is '0.4318'"),
        ("a_m = 0.4318", "a_m = nan", "joint 2: a_m is nan"),
        ("a_m = 0.4318", "a_m = " + "4" * 5000, "a whole number has thousands of digits"),
        ("a_m = 0.4318", "a_m = " + "4" * 400, "joint 2: a_m is 4"),
        ("a_m = 0.4318", "a_m = 431.8", "the largest length is 431800 mm"),
        ("[[joint]]", "[joint]", "Write .*joint|not TOML"),
        ("lower_deg = -110\n", "", "joint 4: there is no lower"),
    ],
)
def test_bad_toml_is_refused_by_joint(file, old, new, words):
    assert old in PUMA_TOML
    path = file(PUMA_TOML.replace(old, new, 1), "bad.toml")
    with pytest.raises(ProblemError, match=words) as refused:
        read_dh_file(path)
    assert "bad.toml" in str(refused.value)


@pytest.mark.parametrize("name", ["none.csv", "none.toml"])
def test_files_that_are_not_there(tmp_path, name):
    with pytest.raises(ProblemError, match="no such file"):
        read_dh_file(tmp_path / name)


LINK = '<link name="{0}"/>'


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<axis xyz=", '<mimic joint="rail"/><axis xyz=', "line 3: joint 'rail' mimics 'rail'"),
        ('type="continuous"', 'type="planar"', "joint 'spin' is of type 'planar'"),
        ('type="continuous"', 'type="floating"', "joint 'spin' is of type 'floating'"),
        ('type="continuous"', "", "joint 'spin' no type"),
        ('<axis xyz="0 -1 0"/>', '<axis xyz="0 0 0"/>', "joint 'spin' has the axis 0 0 0"),
        ('xyz="0 -1 0"', 'xyz="0 -1"', "xyz of <axis> of joint 'spin' '0 -1'. Give 3 numbers"),
        ('xyz="0.1 -0.2 0.3"', 'xyz="100 -200 300"', "A URDF is in metres, not mm"),
        ('xyz="0.1 -0.2 0.3"', 'xyz="0.1 -0.2 nan"', "Give 3 numbers"),
        ('xyz="0.1 -0.2 0.3"', 'xyz="${a} 0 0"', "is xacro"),
        ("<axis xyz=", '<xacro:include filename="a"/><axis xyz=', "is xacro"),
        ('rpy="0 0 1"', 'rpy="0 0 90"', "joint 'plate' has rpy 0 0 90. A URDF has radians, not degrees"),
        ('lower="-1" upper="2"', 'lower="-170" upper="170"', "A URDF has radians, not degrees"),
        ('lower="-0.5" upper="1.5"', 'lower="-500" upper="1500"', "A URDF has metres, not mm"),
        ('lower="-1" upper="2"', 'lower="2" upper="-1"', "limits 2 to -1. Give lower below upper"),
        ('lower="-1" upper="2"', "", "limits 0 to 0"),
        ('<limit lower="-1" upper="2"/>', "", "is revolute and has no limits"),
        ('<origin rpy="-2 0.5 3"/>', '<origin rpy="-2 0.5 3"/><origin/>', "second <origin>"),
        ('<parent link="c"/>', "", "joint 'swing' has no parent"),
        ('<child link="d"/>', '<child link="z"/>', "the child 'z', which is no link"),
        ('<child link="d"/>', '<child link="c"/>', "joint 'swing' and joint 'spin' both hold link 'c'"),
        ('name="spin"', 'name="rail"', "two joints are named 'rail'"),
        ('<link name="a"/>', '<link name="b"/>', "two links are named 'b'"),
        ('<link name="a"/>', '<link name="a"/><link name="lamp"/>', "2 links that could be the tip: 'lamp', 'e'"),
        ("</robot>", "", "broken XML"),
        ("<robot name", '<?xml version="1.0" encoding="klingon"?><robot name', "encoding cannot be read"),
        ('<robot name="odd">', '<!DOCTYPE r [<!ENTITY x "1">]><robot name="odd">', "declares an entity"),
        ("robot", "sdf", "begins with <sdf>"),
    ],
)
def test_bad_urdfs_are_refused_by_joint(file, old, new, words):
    assert old in ODD_URDF
    text = ODD_URDF.replace(old, new) if old == "robot" else ODD_URDF.replace(old, new, 1)
    with pytest.raises(ProblemError, match=words) as refused:
        Robot.from_urdf(file(text, "bad.urdf"))
    assert "bad.urdf" in str(refused.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "2 links that could be the tip|the tip"),
        ({"tip": "tool"}, "no link named 'tool'"),
        ({"tip": "tool0", "base": "finger"}, "'tool0' does not hang on link 'finger'"),
        ({"tip": "finger"}, "joint 'gripper' mimics 'elbow'"),
        ({"tip": "inertia"}, "no joint moves"),
    ],
)
def test_links_are_named_or_asked_for(file, options, words):
    text = UR5_URDF.replace('<link name="finger"/>', '<link name="finger"/><link name="camera"/>')
    camera = '<joint name="cam" type="fixed"><parent link="w3"/><child link="camera"/></joint>'
    text = text.replace("<transmission", camera + "<transmission")
    with pytest.raises(ProblemError, match=words):
        Robot.from_urdf(file(text, "arm.urdf"), **options)


def test_a_loop_has_no_root(file):
    loop = '<robot name="l"><link name="a"/><link name="b"/>' + "".join(
        f'<joint name="j{one}" type="continuous"><parent link="{one}"/><child link="{two}"/></joint>'
        for one, two in ("ab", "ba")
    )
    with pytest.raises(ProblemError, match="loop"):
        Robot.from_urdf(file(loop + "</robot>", "loop.urdf"))


@pytest.mark.parametrize("name", ["ur5.csv", "slide.csv", "puma.toml", "odd.urdf"])
def test_damaged_files_are_read_or_refused_in_a_sentence(file, name):
    text = {"ur5.csv": UR5_CSV, "slide.csv": SLIDE, "puma.toml": PUMA_TOML, "odd.urdf": ODD_URDF}[name].encode()
    rng = np.random.default_rng(11)
    pieces = (
        b"nan",
        b"-1",
        b"",
        b'"',
        b"<",
        b"#",
        b",",
        b";",
        b"[",
        b"\n",
        b"\x00",
        b"\xff",
        b"true",
        b"9" * 30,
        b"[]",
    )
    refused = 0
    for _ in range(150):
        start = int(rng.integers(len(text)))
        piece = pieces[rng.integers(len(pieces))]
        path = file(text[:start] + piece + text[start + int(rng.integers(8)) :], name)
        try:
            Robot.from_urdf(path) if name.endswith("urdf") else Robot.from_dh_file(path)
        except ProblemError:
            refused += 1
    assert refused > 30


@pytest.mark.parametrize("written", ["1.570796327", "1.5708", "1.571", "-3.14159265", "4.712389", "-1.57079632679"])
def test_quarter_turns_in_rad_are_what_they_were_rounded_from(written):
    turns = float(written) / (math.pi / 2)
    assert quarter_turns(float(written)) == round(turns) * math.pi / 2


@pytest.mark.parametrize(
    "written", ["1.57", "1.5709", "1.5707", "0.0", "0.001", "1.570797", "2.0", "1.5707963267948966"]
)
def test_other_angles_in_rad_stay_as_they_are(written):
    assert quarter_turns(float(written)) == float(written)


def test_small_angles_are_no_rounded_quarter_turns(file):
    for value in (4.5e-06, -3.2e-06, 9.9e-6, 1e-5, 1e-3):
        assert quarter_turns(value) == value
    text = "# convention: standard\nalpha_rad,a_mm,d_mm,theta_rad\n4.5e-06,100,0,0\n1.5708,200,0,0\n0,100,0,0\n"
    assert read_dh_file(file(text, "arm.csv")).alpha == (4.5e-06, math.pi / 2, 0.0)


def test_decimal_commas_of_a_table_are_those_of_its_conventions(file):
    rows = "alpha_deg;a_mm;d_mm;theta_deg\n90,5;100;0;0\n0;200;0;0\n"
    head = "# convention: standard\n# signs: 1,-1\n"
    found = read_dh_file(file(f"{head}# offsets_deg: 0,5; 90\n# coupling: 2 1 0,25\n{rows}", "a.csv")).conventions
    np.testing.assert_allclose(np.degrees(found.offsets), [0.5, 90])
    assert (found.signs, found.coupling) == ((1, -1), ((2, 1, 0.25),))
    with pytest.raises(ProblemError, match="offsets_deg has 1 numbers for 2 joints"):
        read_dh_file(file(f"{head}# offsets_deg: 0,5\n{rows}", "b.csv"))


def test_a_name_of_two_lines_is_one_in_a_table_that_is_read_back(file, tmp_path):
    table = replace(read_dh_file(file(UR5_CSV, "ur5.csv")), name="My\narm;")
    (tmp_path / "b.csv").write_text(dh_file_text(table, "b.csv"))
    assert read_dh_file(tmp_path / "b.csv").name == "My arm"


def test_numbers_beyond_all_others_and_pairs_for_triples_are_refused():
    huge = 10**400
    for make in (
        lambda: Joint(upper=huge),
        lambda: Conventions((1, 1), (huge, 0)),
        lambda: Conventions((1, 1), coupling=((1, 2),)),
        lambda: Conventions((1, 1), coupling=((1.0, 2.0, 1.0),)),
        lambda: Conventions((1, 1), coupling=((1, 2, huge),)),
        lambda: Robot.from_urdf("a\0b.urdf"),
    ):
        with pytest.raises(ProblemError):
            make()
