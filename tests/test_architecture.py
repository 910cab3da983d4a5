"""The house: imports point one way, files stay small, nothing hidden; found by reading the source."""

import ast
import re
from functools import cache

import pytest
from conftest import ROOT

PACKAGE = ROOT / "casacal"
FILES = sorted(PACKAGE.rglob("*.py"))
ORDER = [
    "public",
    "kinematics",
    "discrepancy",
    "wording",
    "errors",
    "threads",
    "values",
    "user_code",
    "files",
    "linalg",
    "pages",
    "data",
    "kernels",
    "model",
    "fit",
    "uncertainty",
    "study",
    "effects",
    "deployment",
    "programs",
    "simulation",
    "planning",
    "calibration",
    "verification",
    "shopfloor",
    "doctor",
    "changes",
    "tablet",
    "cli",
    "__main__",
]
"""The packages and modules of casacal/, from the ground up: each imports only what stands before it, or itself."""
PLACE = {name: place for place, name in enumerate(ORDER)}
EXTRAS = {
    "study.runs": {"dask", "distributed"},
    "data.archives": {"openpyxl"},
    "shopfloor.gauges": {"serial"},
    "cli.completion": {"shtab"},
    "tablet.server": {"starlette", "uvicorn"},
    "shopfloor.controllers": {"httpx"},
}
"""Packages that only some users need, and where they are asked for."""
GROUND = set(ORDER[: ORDER.index("data")])
EARLIER = {"kinematics", "discrepancy"}
"""Modules that send users of earlier names on to where these are now."""
CORE = {"data", "kernels", "model", "fit", "uncertainty", "study"}
EFFECTS = re.compile(r"(?<![a-z])(kit|sag|backlash|effect)s?(?![a-z])", re.I)
SYMBOLIC = {"fit.kernel_rows", "fit.ipopt", "fit.symbolic"}
"""Where rows become graphs, and the reference; all else in fit/, estimators above all, knows numbers alone."""


def name_of(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def _is_module(dotted):
    """Whether `from a import b` takes a module of casacal rather than a name in one."""
    place = ROOT.joinpath(*dotted.split("."))
    return dotted.startswith("casacal.") and (place.with_suffix(".py").is_file() or (place / "__init__.py").is_file())


@cache
def imports(path):
    """Modules of casacal (dotted, without the prefix) and foreign packages that a file imports at any depth."""
    own, foreign = set(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [
                f"{node.module}.{a.name}" if _is_module(f"{node.module}.{a.name}") else node.module for a in node.names
            ]
        for name in names:
            if name.split(".")[0] == "casacal":
                own.add(name.removeprefix("casacal").removeprefix("."))
            else:
                foreign.add(name.split(".")[0])
    return own - {""}, foreign


def test_imports_point_down_one_ordered_list():
    for path in FILES:
        name = name_of(path)
        if not name:
            continue
        place = PLACE[name.split(".")[0]]
        for other in imports(path)[0]:
            assert PLACE[other.split(".")[0]] <= place, f"{name} imports {other}, which stands above it"


def about_effects(text):
    """Lines of the source that speak of what an arm does beside its geometry; Kish's design effect is another thing."""
    return [line for line in text.splitlines() if EFFECTS.search(line.replace("design effect", ""))]


def test_the_core_knows_terms_and_no_effects():
    """What terms there are stands above it: `effects` could be deleted, and nothing here would notice."""
    for path in FILES:
        name = name_of(path)
        if name.split(".")[0] in CORE:
            assert not [other for other in imports(path)[0] if other.split(".")[0] == "effects"], name
            words = about_effects(path.read_text(encoding="utf-8"))
            assert name.split(".")[0] == "uncertainty" or not words, name  # where variance components are estimated
    for planted in ("problem.with_kit", "# Backlash, say", "EFFECTS = 1", "by how much it sags", "sag: float"):
        assert about_effects(planted)


def test_a_constant_is_said_once_in_its_file():
    """The second `TRIED` of a file gave its first users another number."""
    for path in FILES:
        names = []
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            for target in targets:
                each = target.elts if isinstance(target, ast.Tuple) else [target]
                names += [name.id for name in each if isinstance(name, ast.Name) and name.id.isupper()]
        assert len(names) == len(set(names)), (name_of(path), sorted(names))


def test_no_cache_goes_from_object_to_object():
    """What was worked out is handed along as an argument."""
    for path in FILES:
        found = re.search(r"(vars\((?!module)\w+\)|__dict__)(\.update|\[[^\]]*\] =)", path.read_text(encoding="utf-8"))
        assert not found, path


def test_no_module_asks_for_a_public_name():
    """Such an import would wait for the lock of `casacal.public` while it holds a lock of Python's own."""
    on_demand = {f"casacal.{path.parent.name}" for path in PACKAGE.glob("*/__init__.pyi")} | {"casacal"}
    assert "casacal.fit" in on_demand
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module in on_demand:
                assert all(_is_module(f"{node.module}.{alias.name}") for alias in node.names), name_of(path)
            assert not (isinstance(node, ast.Import) and any(alias.name == "casacal" for alias in node.names))


def test_the_list_names_what_exists():
    found = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in FILES} - {"__init__"}
    assert found == set(ORDER)
    assert len(list(PACKAGE.glob("*.py"))) <= 12, "a package for each noun: few modules lie flat"


def test_there_are_no_cycles():
    graph = {name_of(path): imports(path)[0] for path in FILES if name_of(path)}
    done, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path, name])
        if name in done or name not in graph:
            return
        path.append(name)
        for other in graph[name]:
            visit(other)
        done.add(path.pop())

    for name in graph:
        visit(name)


def test_every_class_name_stands_once():
    """One name, one meaning: also where an underscore says that a class is its file's own."""
    found = {}
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                name, place = node.name.lstrip("_"), f"{name_of(path)}, line {node.lineno}"
                assert name not in found, f"{name} is a class in {found[name]} and in {place}"
                found[name] = place


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_files_and_functions_stay_small(path):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 900
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            docstring = ast.get_docstring(node, clean=False) or ""
            body = node.end_lineno - node.lineno + 1 - len(docstring.splitlines())
            assert body <= 52, f"{node.name} has {body} lines"
            assert node.args.kwarg is None, f"{node.name} takes **{node.args.kwarg.arg if node.args.kwarg else ''}"


def test_below_the_seam_there_is_no_casadi():
    for path in FILES:
        name = name_of(path)
        if name.split(".")[0] in {"fit", "uncertainty", "linalg"} and name not in SYMBOLIC:
            assert "casadi" not in imports(path)[1], name


def test_only_declared_packages_are_imported():
    allowed = {"casadi", "numpy", "scipy", "pandas", "matplotlib", "jinja2", "markupsafe"}
    standard = __import__("sys").stdlib_module_names
    for path in FILES:
        extra = EXTRAS.get(name_of(path), set())
        assert imports(path)[1] <= allowed | standard | extra, name_of(path)


def test_the_library_does_not_print_and_knows_no_problem_or_study():
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        if name_of(path).split(".")[0] != "cli":
            assert not re.search(r"\bprint\(", text), path
        assert not re.search(r"^\s*(from|import) (problems|studies)\b", text, re.M), path


def test_no_derivative_is_a_difference_quotient():
    for path in FILES:
        assert "2-point" not in path.read_text(encoding="utf-8")
        assert not re.search(r"approx_derivative|approx_fprime|finite_diff", path.read_text(encoding="utf-8"))
