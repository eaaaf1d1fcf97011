"""The rules of the house that a machine can check: imports go down, files stay small."""

from __future__ import annotations

import ast
import dataclasses
from pathlib import Path

import neuprim
from neuprim.core.model.schema import ParameterSpec

ROOT = Path(neuprim.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
LONGEST = 460


def imported(path: Path) -> set[str]:
    """Absolute names of all modules a file imports, anywhere in it, type-checking blocks and functions included."""
    package = (ROOT.name, *path.relative_to(ROOT).parent.parts)
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join([*package[: len(package) - node.level + 1], *([node.module] if node.module else [])])
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in (
            "import_module",
            "__import__",
        ):
            names |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    return names


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


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
    "viewer": {"config", "core", "inspect", "plugins", "runs", "search", "webpage"},
    "cli": {"config", "core", "inspect", "plugins", "runs", "search", "version", "viewer"},
}
"""Room of the package -> those it may import from."""

CORE: dict[str, set[str]] = {
    "errors": set(),
    "notices": set(),
    "io": {"errors"},
    "validation": {"errors"},
    "settings": {"validation", "errors"},
    "metrics": {"errors"},
    "cameras": {"errors", "io"},
    "compute": {"io", "notices"},
    "environment": {"errors", "io"},
    "model": {"cameras", "validation", "compute", "errors", "settings"},
    "compression": {"errors", "io", "model"},
    "volumes": {"compute", "errors", "model"},
    "data": {"cameras", "validation", "compute", "errors", "io", "model", "notices", "volumes"},
    "layers": {"errors", "io", "render"},
    "task": {"validation", "data", "environment", "layers", "model", "volumes"},
    "conditions": {"errors", "model"},
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
    "render": {"cameras", "compute", "errors", "metrics", "model", "notices", "settings"},
    "train": {"validation", "compute", "data", "errors", "model", "render", "task", "volumes"},
    "used_settings": {"validation", "errors", "extensions", "task", "train"},
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
        seen, todo = set(), [node]
        while todo:
            for other in graph.get(todo.pop(), ()):
                if other not in seen:
                    seen.add(other)
                    todo.append(other)
        reach[node] = seen
    found = {
        tuple(sorted(n for n in graph if n in reach[node] and node in reach[n]))
        for node in graph
        if node in reach[node]
    }
    return [list(circle) for circle in sorted(found)]


def test_every_room_imports_only_what_the_list_allows() -> None:
    assert between(1, ROOMS, (ROOT.name,)) == []
    assert between(2, CORE, (ROOT.name, "core")) == []


def test_the_lists_name_what_is_there_and_run_down() -> None:
    there = {
        p.stem if p.suffix == ".py" else p.name
        for p in ROOT.iterdir()
        if p.suffix == ".py" or (p / "__init__.py").exists()
    }
    assert set(ROOMS) == there - {"__init__", "__main__"} and len(ROOMS) <= MOST_ROOMS
    core = {
        p.stem if p.suffix == ".py" else p.name
        for p in (ROOT / "core").iterdir()
        if p.suffix == ".py" or (p / "__init__.py").exists()
    }
    assert set(CORE) == core - {"__init__"}
    assert circles(ROOMS) == [] and circles(CORE) == []


def test_no_module_imports_itself_by_a_detour() -> None:
    """Imports for types only and imports inside functions count too; packages that only re-export are the door of their
    room."""
    assert circles({name: edges(file) for name, file in MODULES.items()}) == []


def test_tasks_do_not_know_each_other() -> None:
    names = sorted(p.name for p in (ROOT / "tasks").iterdir() if (p / "__init__.py").exists())
    assert between(2, {name: set() for name in names}, (ROOT.name, "tasks")) == []


def test_nothing_imports_a_built_in_task_by_name() -> None:
    """Built-in tasks are found through the entry-point group, like anybody's."""
    wrong = [
        f"{f.relative_to(ROOT)} imports {n}"
        for f in FILES
        if not f.is_relative_to(ROOT / "tasks")
        for n in imported(f)
        if n.startswith("neuprim.tasks.")
    ]
    assert wrong == []


def test_nobody_imports_the_command_line() -> None:
    outside = [f for f in FILES if f.name != "__main__.py" and not f.is_relative_to(ROOT / "cli")]
    wrong = [str(f.relative_to(ROOT)) for f in outside if any(within(n, "neuprim.cli") for n in imported(f))]
    assert wrong == []


def test_runs_do_not_print() -> None:
    """What happens is told as events; ``print`` as a default says it past them."""
    wrong = [
        f"{f.relative_to(ROOT)}:{node.lineno}"
        for f in FILES
        if f.is_relative_to(ROOT / "runs")
        for node in ast.walk(ast.parse(f.read_text(encoding="utf-8")))
        if isinstance(node, ast.Name) and node.id == "print"
    ]
    assert wrong == []


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
    folder = Path(__file__).parent
    wrong = [
        f"{f.relative_to(folder)}:{node.lineno}"
        for f in sorted(
            [
                *folder.rglob("*.py"),
                *(folder.parent / "examples").rglob("*.py"),
                *(folder.parent / "benchmarks").rglob("*.py"),
            ]
        )
        for node in ast.walk(ast.parse(f.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
        if any(part.startswith("test_") for part in name.split("."))
    ]
    assert wrong == []


def test_every_property_of_a_parameter_decides_something() -> None:
    """What a plugin must say about its parameters is read by the core, or there is no need to say it."""
    read = {
        node.attr
        for f in FILES
        if f.is_relative_to(ROOT / "core") and f.name != "schema.py"
        for tree in [ast.parse(f.read_text(encoding="utf-8"))]
        for called in [{id(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)}]
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load) and id(node) not in called
    }
    callables = {"init"}
    assert {field.name for field in dataclasses.fields(ParameterSpec)} - read - callables == set()


def test_every_module_says_what_it_is_for() -> None:
    silent = [
        str(f.relative_to(ROOT))
        for f in FILES
        if f.read_text(encoding="utf-8").strip() and not ast.get_docstring(ast.parse(f.read_text(encoding="utf-8")))
    ]
    assert silent == []


def test_nothing_unpickles_or_evaluates() -> None:
    """No file of a user's is ever executed; torch's own unpickler may read one where it is told to take nothing but
    tensors."""
    wrong = []
    for f in FILES:
        for node in ast.walk(ast.parse(f.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("eval", "exec"):
                wrong.append(f"{f.relative_to(ROOT)}:{node.lineno}")
            tensors_alone = isinstance(node, ast.Call) and "weights_only=True" in [
                ast.unparse(k) for k in node.keywords
            ]
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "torch.load" and not tensors_alone:
                wrong.append(f"{f.relative_to(ROOT)}:{node.lineno}")
            if isinstance(node, ast.Call) and ast.unparse(node.func) in (
                "pickle.load",
                "pickle.loads",
                "yaml.load",
                "yaml.unsafe_load",
            ):
                wrong.append(f"{f.relative_to(ROOT)}:{node.lineno}")
    assert wrong == []
