"""The arrows between packages run one way, third-party libraries stay where they belong, every package is listed."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAY_IMPORT = {
    "factors": set(),
    "io": {"factors"},
    "frontends": {"factors"},
    "estimator": {"factors", "io", "frontends"},
    "simulation": {"factors", "io", "frontends", "estimator"},
}
BANNED = {
    "factors": {"cv2", "mcap", "rosbags", "open3d", "typer", "rich"},
    "io": {"gtsam", "open3d", "typer", "rich"},
    "frontends": {"mcap", "rosbags", "typer"},
    "estimator": {"open3d"},
}
MAY_READ_A_CLOCK = (
    "io/live",
    "estimator/commands/",
    "estimator/stopwatch.py",
    "estimator/stream/",
    "simulation/commands/",
    "simulation/campaign_run.py",
)
"""Live sources, and the stopwatches of commands and campaigns; everywhere else time is data."""


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imports(path: Path) -> Iterator[tuple[str, int, bool]]:
    """Absolute module name (relative ones resolved to `surecut.*`), line, and whether it stands inside a function."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = ["surecut", *path.relative_to(ROOT).parts[:-1]]
    inner = {id(node) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for node in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno, id(node) in inner
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            yield name, node.lineno, id(node) in inner
            for alias in node.names:
                yield f"{name}.{alias.name}", node.lineno, id(node) in inner


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_packages_import_downwards_only(package):
    wrong = []
    for path in files(package):
        for name, line, _ in imports(path):
            parts = name.split(".")
            if parts[0] == "surecut" and len(parts) > 1 and parts[1] not in {package, *MAY_IMPORT[package]}:
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {name}")
    assert not wrong


@pytest.mark.parametrize("package", BANNED)
def test_libraries_stay_where_they_belong(package):
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in files(package)
        for name, line, _ in imports(path)
        if name.split(".")[0] in BANNED[package]
    ]
    assert not wrong


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_open3d_is_imported_inside_functions_only(package):
    wrong = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in files(package)
        for name, line, inside in imports(path)
        if name.split(".")[0] == "open3d" and not inside
    ]
    assert not wrong


def clocks(path: Path) -> Iterator[int]:
    """Lines that import `time` or ask for the present moment."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and node.attr in ("now", "utcnow", "today"):
            yield node.lineno
    yield from (line for name, line, _ in imports(path) if name == "time")


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_time_is_data(package):
    wrong = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in files(package)
        for line in clocks(path)
        if not str(path.relative_to(ROOT)).startswith(MAY_READ_A_CLOCK)
    ]
    assert not wrong


def test_every_package_is_listed():
    """Folders of scenarios too: setuptools warns at every installation otherwise."""
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    scenarios = list((ROOT / "simulation").rglob("*.yaml"))
    folders = {path.parent.relative_to(ROOT) for package in MAY_IMPORT for path in [*files(package), *scenarios]}
    expected = {"surecut." + ".".join(folder.parts): str(folder) for folder in folders}
    assert set(setuptools["packages"]) == set(expected)
    assert setuptools["package-dir"] == expected


def test_io_never_shadows_the_standard_library():
    assert not (ROOT / "io" / "__init__.py").exists()


@pytest.mark.parametrize("package", [name for name in MAY_IMPORT if name != "io"])
def test_package_files_hold_a_docstring_only(package):
    for path in (ROOT / package).rglob("__init__.py"):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        assert len(body) == 1, path
        assert isinstance(body[0], ast.Expr), path


def test_commands_listed_in_the_project_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for name, target in project["entry-points"]["surecut.commands"].items():
        module, _, attribute = target.partition(":")
        path = ROOT.joinpath(*module.split(".")[1:]).with_suffix(".py")
        names = {
            node.name if isinstance(node, ast.FunctionDef) else node.targets[0].id
            for node in ast.parse(path.read_text(encoding="utf-8")).body
            if isinstance(node, ast.FunctionDef)
            or (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name))
        }
        assert attribute in names, name
