"""Reading a URDF: its XML, tag by tag; what is nearly a tag, or says a thing twice, is refused."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from casacal.errors import ProblemError
from casacal.robots.files.urdf import ZERO, Triple, UrdfFile, UrdfJoint, numbers_in

ATTRIBUTES = {
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "parent": ("link",),
    "child": ("link",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "mimic": ("joint", "multiplier", "offset"),
}
"""Parts of a joint that matter here, and what they may say."""
EXPAND = "Expand it first: xacro ARM.urdf.xacro > ARM.urdf"
PLACING = ("origin", "axis", "parent", "child")  # those in which nothing may be overlooked


def read_urdf(path: str | Path) -> UrdfFile:
    """Read a URDF (see wiki.ros.org/urdf/XML).

    Raises ProblemError for a file that cannot be read, broken XML, xacro, names that are missing or come twice, and
    numbers that are none; what is wrong with one joint of the chain is said by `check_joint`.
    """
    file = str(path)
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise ProblemError(f"{file}: there is no such file", "Check the path of the URDF") from None
    except OSError as error:
        raise ProblemError(f"{file}: cannot be read ({error.strerror})", "Give a readable URDF") from None
    reader = _Reader(file)
    try:
        reader.parser.Parse(data, True)
    except expat.ExpatError as error:
        said = expat.ErrorString(error.code)
        raise ProblemError(f"{file}, line {error.lineno}: broken XML ({said})", "Mend the file") from None
    except (LookupError, ValueError) as error:  # an encoding that nobody knows, or that expat does not
        raise ProblemError(f"{file}: its encoding cannot be read ({error})", "Save it as UTF-8") from None
    return reader.finished()


@dataclass
class _Reader:
    """Collects links and joints while expat walks through the file."""

    file: str
    path: list[str] = field(default_factory=list)
    name: str = ""
    links: list[str] = field(default_factory=list)
    joints: list[UrdfJoint] = field(default_factory=list)
    seen: set[tuple[int, str]] = field(default_factory=set)  # parts of joints, by how many joints there are

    def __post_init__(self) -> None:
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = lambda _: self.path.pop()
        self.parser.EntityDeclHandler = lambda *_: self._refuse("declares an entity", "Write out its value")

    def finished(self) -> UrdfFile:
        for kind, names in (("link", self.links), ("joint", [joint.name for joint in self.joints])):
            for name, count in Counter(names).items():
                if count > 1:
                    raise ProblemError(f"{self.file}: two {kind}s are named '{name}'", "Rename one of them")
        children, links = dict[str, str](), set(self.links)
        for joint in self.joints:
            where = f"{self.file}, line {joint.line}: joint '{joint.name}'"
            for what, link in (("parent", joint.parent), ("child", joint.child)):
                if not link:
                    raise ProblemError(f"{where} has no {what}", f"Add <{what} link=>")
                if link not in links:
                    fix = f"Add <link name='{link}'>"
                    raise ProblemError(f"{where} has the {what} '{link}', which is no link", fix)
            if joint.child in children:
                fix = "A URDF is a tree: give each link one joint above it"
                raise ProblemError(f"{where} and joint '{children[joint.child]}' both hold link '{joint.child}'", fix)
            children[joint.child] = joint.name
        return UrdfFile(self.file, self.name or Path(self.file).stem, tuple(self.links), tuple(self.joints))

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.path.append(tag)
        if tag.startswith("xacro:"):
            self._refuse(f"is xacro (<{tag}>)", EXPAND)
        if len(self.path) > 3:  # what other programs keep inside the parts of a joint, however deep
            return
        self._spelling(tag, attributes)
        if len(self.path) == 1:
            if tag != "robot":
                self._refuse(f"begins with <{tag}>, a URDF with <robot>", "Give a URDF")
            self.name = attributes.get("name", "")
        elif self.path[:-1] == ["robot"] and tag == "link":
            self.links.append(self._text(attributes, "name", "a link"))
        elif self.path[:-1] == ["robot"] and tag == "joint":
            name = self._text(attributes, "name", "a joint")
            kind = self._text(attributes, "type", f"joint '{name}'")
            self.joints.append(UrdfJoint(name, kind, self.parser.CurrentLineNumber))
        elif self.path[:-1] == ["robot", "joint"]:
            self._part(self.joints[-1], tag, attributes)

    def _spelling(self, tag: str, attributes: dict[str, str]) -> None:
        """Refuse what is nearly a tag or an attribute that matters, or an attribute that moves things unseen."""
        if self.path[:-1] not in ([], ["robot"], ["robot", "joint"]):
            return
        known = ("robot",) if len(self.path) == 1 else ("link", "joint") if len(self.path) == 2 else tuple(ATTRIBUTES)
        for name in known:
            if tag != name and tag.lower() == name:
                self._refuse(f"has <{tag}>", f"Write <{name}>")
        if len(self.path) < 3 or tag not in ATTRIBUTES:
            return
        for name in attributes:
            if name not in ATTRIBUTES[tag]:
                meant = [each for each in ATTRIBUTES[tag] if each == name.lower()]
                if meant or tag in PLACING:
                    fix = f"Write {meant[0]}=" if meant else f"It may have {', '.join(ATTRIBUTES[tag])}"
                    self._refuse(f"gives <{tag}> of joint '{self.joints[-1].name}' the attribute {name}=", fix)

    def _part(self, joint: UrdfJoint, tag: str, attributes: dict[str, str]) -> None:
        """Take in one part of a joint, the last one begun."""
        whose = f"<{tag}> of joint '{joint.name}'"
        if tag in ATTRIBUTES:
            if (len(self.joints), tag) in self.seen:
                self._refuse(f"gives joint '{joint.name}' a second <{tag}>", "Leave one of them")
            self.seen.add((len(self.joints), tag))
        if tag == "origin":
            xyz, rpy = (self._triple(attributes, key, whose, ZERO) for key in ("xyz", "rpy"))
            joint = replace(joint, xyz=xyz, rpy=rpy)
        elif tag == "axis":
            joint = replace(joint, axis=self._triple(attributes, "xyz", whose, joint.axis))
        elif tag == "parent":
            joint = replace(joint, parent=self._text(attributes, "link", whose))
        elif tag == "child":
            joint = replace(joint, child=self._text(attributes, "link", whose))
        elif tag == "limit":
            lower, upper = (self._numbers(attributes.get(key, "0"), whose, 1)[0] for key in ("lower", "upper"))
            joint = replace(joint, limits=(lower, upper))
        elif tag == "mimic":
            joint = replace(joint, mimics=attributes.get("joint", "?"))
        self.joints[-1] = joint

    def _triple(self, attributes: dict[str, str], key: str, whose: str, default: Triple) -> Triple:
        if key not in attributes:
            return default
        x, y, z = self._numbers(attributes[key], f"{key} of {whose}", 3)
        return x, y, z

    def _numbers(self, text: str, whose: str, count: int) -> list[float]:
        if "${" in text or "$(" in text:
            self._refuse(f"is xacro ({whose} is '{text}')", EXPAND)
        values = numbers_in(text, count)
        if not values:
            self._refuse(f"has {whose} '{text}'", f"Give {count} number{'s' if count > 1 else ''} in metres or radians")
        return values

    def _text(self, attributes: dict[str, str], key: str, whose: str) -> str:
        if not attributes.get(key):
            self._refuse(f"gives {whose} no {key}", f"Add {key}=")
        return attributes[key]

    def _refuse(self, what: str, fix: str) -> NoReturn:
        raise ProblemError(f"{self.file}, line {self.parser.CurrentLineNumber}: the file {what}", fix)
