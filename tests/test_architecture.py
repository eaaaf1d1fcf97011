"""The rules of the house that a machine can check: imports go down, files stay small."""

from __future__ import annotations

import ast
import dataclasses
import re
from pathlib import Path

import pytest

import neuprim
from neuprim.core.schema import ParameterSpec

ROOT = Path(neuprim.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
MODULES = {".".join((ROOT.name, *f.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): f for f in FILES}
LONGEST = 400


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
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in ("import_module", "__import__"):
            names |= {a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)}
    return names


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def offences(folder: str, forbidden: tuple[str, ...]) -> list[str]:
    files = [f for f in FILES if f.is_relative_to(ROOT / folder)]
    assert len(files) > 2, folder
    return [f"{f.relative_to(ROOT)} imports {n}" for f in files for n in sorted(imported(f)) if any(within(n, bad) for bad in forbidden)]


def test_core_knows_no_task_plugin_or_command() -> None:
    allowed = ("neuprim.core", "neuprim.__version__")
    files = [f for f in FILES if f.is_relative_to(ROOT / "core")]
    wrong = [
        f"{f.relative_to(ROOT)} imports {n}"
        for f in files
        for n in sorted(imported(f))
        if within(n, "neuprim") and n != "neuprim" and not any(within(n, good) for good in allowed)
    ]
    assert wrong == []


def test_tasks_know_no_command_plugin_or_other_task() -> None:
    above = (
        "neuprim.cli",
        "neuprim.run",
        "neuprim.evaluate",
        "neuprim.report",
        "neuprim.config",
        "neuprim.plugins",
        "neuprim.doctor",
        "neuprim.progress",
    )
    for task in sorted(p.name for p in (ROOT / "tasks").iterdir() if (p / "__init__.py").exists()):
        others = tuple(f"neuprim.tasks.{p.name}" for p in (ROOT / "tasks").iterdir() if p.is_dir() and p.name != task)
        assert offences(f"tasks/{task}", (*above, *others)) == []


def test_formats_and_inspectors_know_no_command() -> None:
    above = (
        "neuprim.cli",
        "neuprim.run",
        "neuprim.evaluate",
        "neuprim.report",
        "neuprim.exporting",
        "neuprim.inspecting",
        "neuprim.trained",
    )
    for folder in ("plugins/export", "plugins/inspect"):
        assert offences(folder, above) == []


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
    wrong = [str(f.relative_to(ROOT)) for f in FILES if f.name != "__main__.py" and any(within(n, "neuprim.cli") for n in imported(f))]
    assert wrong == []


def test_the_checker_sees_every_form_of_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "core" / "render").mkdir(parents=True)
    file = tmp_path / "core" / "render" / "x.py"
    for text in (
        "import neuprim.tasks.static",
        "from neuprim.tasks import static",
        "from neuprim import tasks",
        "def f():\n    from neuprim.tasks.static import TASK",
        "import importlib\nimportlib.import_module('neuprim.tasks.static')",
    ):
        file.write_text(text)
        assert any(within(n, "neuprim.tasks") for n in imported(file)), text
    file.write_text("from ...tasks import static")
    assert any(n.endswith(".tasks.static") for n in imported(file))
    file.write_text("from .settings import RenderSettings")
    assert any(n.endswith("core.render.settings") for n in imported(file))


def needed_at_run_time(path: Path) -> set[str]:
    """Modules of the package that a file imports, anywhere in it but for type checking."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            node.body = [ast.Pass()]
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {n if (n := f"{node.module}.{alias.name}") in MODULES else node.module for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & MODULES.keys()


def test_no_module_imports_itself_by_way_of_others() -> None:
    """Imports inside functions count: a cycle that they hide is still one. The root package is left out, being behind every import."""
    graph = {name: needed_at_run_time(file) - {ROOT.name, name} for name, file in MODULES.items() if name != ROOT.name}
    size = len(graph) + 1
    while len(graph) < size:  # leave out what needs nothing, and what nothing needs
        size = len(graph)
        needed = set().union(*graph.values())
        graph = {name: needs & graph.keys() for name, needs in graph.items() if needs & graph.keys() and name in needed}
    assert graph == {}


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
    """What several of them need is in a module without ``test_`` in its name: else a change of one test is a change of others."""
    folder = Path(__file__).parent
    wrong = [
        f"{f.relative_to(folder)}:{node.lineno}"
        for f in sorted([*folder.rglob("*.py"), *(folder.parent / "examples").rglob("*.py"), *(folder.parent / "benchmarks").rglob("*.py")])
        for node in ast.walk(ast.parse(f.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
        if any(part.startswith("test_") for part in name.split("."))
    ]
    assert wrong == []


def test_what_says_that_it_returns_something_does() -> None:
    silent = []
    for f in FILES:
        for node in ast.walk(ast.parse(f.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef) or not re.search(r"(?:^|[.;:] )returns\b", ast.get_docstring(node) or "", re.I):
                continue
            gives = any(isinstance(n, ast.Yield | ast.YieldFrom) or (isinstance(n, ast.Return) and n.value) for n in ast.walk(node))
            abstract = any(ast.unparse(d).endswith("abstractmethod") for d in node.decorator_list)
            silent += [f"{f.relative_to(ROOT)}:{node.lineno} {node.name}"] * (not gives and not abstract)
    assert silent == []


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
    """No file of a user's is ever executed."""
    wrong = []
    for f in FILES:
        for node in ast.walk(ast.parse(f.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("eval", "exec"):
                wrong.append(f"{f.relative_to(ROOT)}:{node.lineno}")
            if isinstance(node, ast.Call) and ast.unparse(node.func) in (
                "torch.load",
                "pickle.load",
                "pickle.loads",
                "yaml.load",
                "yaml.unsafe_load",
            ):
                wrong.append(f"{f.relative_to(ROOT)}:{node.lineno}")
    assert wrong == []
