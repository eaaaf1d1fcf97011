"""The rules of the house that a machine can check: imports go down, files stay small."""

from __future__ import annotations

import ast
import dataclasses
import functools
import re
from collections.abc import Callable
from pathlib import Path

import neuprim
from neuprim.core.model.schema import ParameterSpec

ROOT = Path(neuprim.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
LONGEST = 460


@functools.cache  # not when the file is imported, which every worker does
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(path: Path) -> set[str]:
    """Absolute names of all modules a file imports, anywhere in it, type-checking blocks and functions included."""
    package = (ROOT.name, *path.relative_to(ROOT).parent.parts)
    names: set[str] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            names |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    return names


def places(paths: list[Path], wrong: Callable[[ast.AST], bool]) -> list[str]:
    """Where a file has what is wrong."""
    found = [(path, node) for path in paths for node in ast.walk(tree(path)) if wrong(node)]
    return [f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}" for path, node in found]


ROOMS: dict[str, set[str]] = {
    "version": set(),
    "core": {"version"},
    "scenes": {"core"},
    "tasks": {"core", "scenes"},
    "webpage": {"core"},
    "plugins": {"core", "version"},
    "export": {"core", "plugins", "version", "webpage"},
    "inspect": {"core", "plugins"},
    "functional": {"core"},
    "report": {"core"},
    "config": {"core", "plugins", "version"},
    "conformance": {"config", "core", "plugins"},
    "runs": {"config", "core", "inspect", "plugins", "report", "version", "webpage"},
    "search": {"config", "core", "plugins", "report", "runs", "version"},
    "blender": {"core", "version"},
    "viewer": {"config", "core", "inspect", "plugins", "runs", "webpage"},
    "cli": {"blender", "config", "core", "inspect", "plugins", "runs", "search", "version", "viewer"},
}
"""Room of the package -> those it may import from."""

CORE: dict[str, set[str]] = {
    "errors": set(),
    "io": {"errors"},
    "validation": {"errors"},
    "settings": {"validation", "errors"},
    "metrics": {"compute", "errors"},
    "cameras": {"errors", "io"},
    "compute": {"errors", "io"},
    "environment": {"errors", "io"},
    "model": {"cameras", "validation", "compute", "errors", "settings"},
    "compression": {"errors", "io", "model"},
    "volumes": {"compute", "errors", "model"},
    "data": {"cameras", "validation", "compute", "errors", "io", "model", "volumes"},
    "task": {"validation", "data", "environment", "model", "render", "volumes"},
    "conditions": {"errors", "io", "model"},
    "light_conditions": {"cameras", "data", "environment", "errors", "io", "model"},
    "channels": {"data", "errors", "io", "task"},
    "checkpoint": {"compression", "errors", "io", "model", "task"},
    "extensions": {
        "cameras",
        "channels",
        "validation",
        "conditions",
        "data",
        "errors",
        "model",
        "settings",
        "task",
        "volumes",
    },
    "render": {"cameras", "compute", "errors", "metrics", "model", "settings"},
    "train": {"validation", "compute", "data", "errors", "extensions", "model", "render", "task", "volumes"},
}
"""The same inside ``core``, folders and single files alike."""

MOST_ROOMS = 18


def parts(path: Path) -> tuple[str, ...]:
    """Module name of a file, e.g. ("neuprim", "core", "errors")."""
    relative = path.relative_to(ROOT.parent).with_suffix("").parts
    return relative[:-1] if relative[-1] == "__init__" else relative


MODULES = {".".join(parts(f)): f for f in FILES}


def edges(path: Path) -> set[str]:
    """The modules of the package that a file imports from, anywhere in it; of ``from package import module`` the
    module."""
    names = {name for name in imported(path) if name in MODULES} - {".".join(parts(path)), ROOT.name}
    return {name for name in names if not any(other.startswith(name + ".") for other in names)}


def between(depth: int, allowed: dict[str, set[str]], inside: tuple[str, ...]) -> list[str]:
    """Imports from one room to another that the list does not have, of the rooms ``depth`` names down from
    ``inside``."""
    wrong = []
    for file in FILES:
        own = parts(file)
        if own[: len(inside)] != inside or len(own) <= depth or own[-1] == "__main__":
            continue
        for name in sorted(edges(file)):
            other = tuple(name.split("."))
            if other[: len(inside)] != inside or len(other) <= depth or other[depth] == own[depth]:
                continue
            if other[depth] not in allowed[own[depth]]:
                wrong.append(f"{file.relative_to(ROOT)} imports {name}")
    return wrong


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Sets of nodes that reach each other."""
    reach: dict[str, set[str]] = {}
    for node in graph:
        reach[node], todo = set(), [node]
        while todo:
            new = graph.get(todo.pop(), set()) - reach[node]
            reach[node] |= new
            todo += new
    circular = [node for node in graph if node in reach[node]]
    found = {tuple(sorted(n for n in circular if n in reach[node] and node in reach[n])) for node in circular}
    return [list(circle) for circle in sorted(found)]


def rooms_in(folder: Path) -> set[str]:
    packages = {path.parent.name for path in folder.glob("*/__init__.py")}
    return packages | {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}


def test_every_room_imports_only_what_the_list_allows() -> None:
    assert between(1, ROOMS, (ROOT.name,)) == []
    assert between(2, CORE, (ROOT.name, "core")) == []


def test_the_lists_name_what_is_there_and_run_down() -> None:
    assert set(ROOMS) == rooms_in(ROOT) and len(ROOMS) <= MOST_ROOMS
    assert set(CORE) == rooms_in(ROOT / "core")
    assert circles(ROOMS) == [] and circles(CORE) == []


def test_no_module_imports_itself_by_a_detour() -> None:
    """Imports for types only and imports inside functions count too; packages that only re-export are the door of their
    room."""
    assert circles({name: edges(file) for name, file in MODULES.items()}) == []


def test_tasks_do_not_know_each_other() -> None:
    names = rooms_in(ROOT / "tasks")
    assert between(2, {name: set() for name in names}, (ROOT.name, "tasks")) == []


def test_built_in_tasks_are_found_through_their_entry_points_like_anybody_s() -> None:
    outside = [f for f in FILES if not f.is_relative_to(ROOT / "tasks")]
    assert [f for f in outside if any(name.startswith("neuprim.tasks.") for name in imported(f))] == []


def test_nobody_imports_the_command_line() -> None:
    outside = [f for f in FILES if f.name != "__main__.py" and not f.is_relative_to(ROOT / "cli")]
    assert [f for f in outside if any(f"{name}.".startswith("neuprim.cli.") for name in imported(f))] == []


def test_runs_do_not_print() -> None:
    """What happens is told as events; ``print`` as a default says it past them."""
    runs = [f for f in FILES if f.is_relative_to(ROOT / "runs")]
    assert places(runs, lambda node: isinstance(node, ast.Name) and node.id == "print") == []


def test_files_stay_small() -> None:
    """A fused kernel may be longer, alone in its file."""
    long = []
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        kernels = any(name in text for name in ("@kernel\n", "@inline\n"))
        lines, most = len(text.splitlines()), int((1.5 if kernels else 1.05) * LONGEST)
        long += [f"{path.relative_to(ROOT)}: {lines} lines, at most {most}"] * (lines > most)
    assert long == []


def test_tests_do_not_import_tests() -> None:
    """What several of them need is in a module without ``test_`` in its name: else a change of one test is a change of
    others."""
    files = [f for folder in ("tests", "examples", "benchmarks") for f in (ROOT.parent / folder).rglob("*.py")]
    importing = re.compile(r"^\s*(from|import) [\w. ]*\btest_", re.MULTILINE)
    assert [f for f in files if importing.search(f.read_text(encoding="utf-8"))] == []


def test_every_property_of_a_parameter_decides_something() -> None:
    """What a plugin must say about its parameters is read by the core, or there is no need to say it."""
    read: set[str] = set()
    for path in FILES:
        if path.is_relative_to(ROOT / "core") and path.name != "schema.py":
            called = {id(node.func) for node in ast.walk(tree(path)) if isinstance(node, ast.Call)}
            attributes = [node for node in ast.walk(tree(path)) if isinstance(node, ast.Attribute)]
            read |= {n.attr for n in attributes if isinstance(n.ctx, ast.Load) and id(n) not in called}
    assert {field.name for field in dataclasses.fields(ParameterSpec)} - read - {"init"} == set()


def test_every_module_says_what_it_is_for() -> None:
    assert [file for file in FILES if tree(file).body and not ast.get_docstring(tree(file))] == []


def test_nothing_unpickles_or_evaluates() -> None:
    """No file of a user's is ever executed; torch's own unpickler may read one where it is told to take nothing but
    tensors."""

    def executes(node: ast.AST) -> bool:
        if not isinstance(node, ast.Call):
            return False
        name = ast.unparse(node.func)
        if name == "torch.load":
            return "weights_only=True" not in [ast.unparse(keyword) for keyword in node.keywords]
        return name in ("eval", "exec", "pickle.load", "pickle.loads", "yaml.load", "yaml.unsafe_load")

    assert places(FILES, executes) == []


# ---------------------------------------------------------------- tests lie where the code does

TESTS = Path(__file__).parent
OTHERS = {"docs", "fuzz", "numerics"}
"""Folders of tests without one of the package: the documentation, and what all renderers must agree on."""


def test_no_two_files_of_tests_have_one_name() -> None:
    """Folders of tests are no packages, so that the second of a name could not be collected."""
    names = [file.name for file in TESTS.rglob("test_*.py")]
    assert sorted(name for name in set(names) if names.count(name) > 1) == []


def test_every_folder_of_tests_is_one_of_the_package() -> None:
    found = {file.parent.relative_to(TESTS) for file in TESTS.rglob("test_*.py")} - {Path()}
    assert [folder for folder in found if folder.parts[0] not in OTHERS and not (ROOT / folder).is_dir()] == []
    assert all((TESTS / name).is_dir() and not (ROOT / name).exists() for name in OTHERS)


def test_tests_of_a_room_are_in_its_own_folder() -> None:
    found = [file.relative_to(TESTS) for room in (TESTS, TESTS / "core") for file in room.glob("test_*.py")]
    assert [f for f in found if (ROOT / f.parent / f.stem.removeprefix("test_") / "__init__.py").exists()] == []
