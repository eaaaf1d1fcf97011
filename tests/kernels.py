"""The compiled functions of the package, and what they are made of."""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import neuprim

PACKAGE = Path(neuprim.__file__).parent


def modules() -> list[ModuleType]:
    """Every module of the package, imported."""
    names = [m.name for m in pkgutil.walk_packages(neuprim.__path__, "neuprim.") if not m.name.endswith(".__main__")]
    return [neuprim, *(importlib.import_module(name) for name in names)]


def compiled_by(program: str) -> dict[str, list[str]]:
    """Kernel -> types of arguments for which a process of its own compiled it, or found it on disk, while it ran
    ``program``."""
    listing = (
        "import json, sys\n"
        "from numba.core.dispatcher import Dispatcher\n"
        "from numba.core.caching import FunctionCache\n"
        "found = {}\n"
        "for name, module in sorted(sys.modules.items()):\n"
        "    for value in vars(module).values() if name.startswith('neuprim.') else ():\n"
        "        if isinstance(value, Dispatcher) and isinstance(value._cache, FunctionCache) and value.signatures:\n"
        "            found[f'{value.py_func.__module__}.{value.py_func.__name__}'] = sorted(map(str, "
        "value.signatures))\n"
        "print(json.dumps(found))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"{program}\n{listing}"], capture_output=True, text=True, cwd=PACKAGE.parent, check=False
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, list[str]] = json.loads(done.stdout.splitlines()[-1])
    return found


class Source:
    """One module as text: what its names at the top level are imported from, or made of."""

    def __init__(self, module: str) -> None:
        origin = sys.modules[module].__file__
        assert origin is not None
        self.file = Path(origin)
        self.imported: dict[str, tuple[str, str]] = {}
        self.made_of: dict[str, set[str]] = {}
        for node in ast.parse(self.file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom):
                self.imported |= {alias.asname or alias.name: (node.module or "", alias.name) for alias in node.names}
            elif isinstance(node, ast.FunctionDef):
                self.made_of[node.name] = set().union(
                    *(_names(part) for part in node.body)
                )  # not the decorators: they only compile it
            elif isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for name in set().union(*(_names(target) for target in targets)):
                    self.made_of.setdefault(name, set()).update(_names(node))


def _names(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}


def _compiled_functions(module: ModuleType) -> list[tuple[str, str]]:
    from numba.core.dispatcher import Dispatcher

    return [
        (value.py_func.__module__, value.py_func.__name__)
        for value in vars(module).values()
        if isinstance(value, Dispatcher) and value.py_func.__module__ == module.__name__
    ]


def kernel_modules() -> list[ModuleType]:
    """Modules of the package with compiled functions."""
    return [module for module in modules() if _compiled_functions(module)]


def frozen_into_kernels(module: ModuleType) -> set[Path]:
    """Files of the package with a name that some compiled function of a module uses, directly or by way of others."""
    todo = _compiled_functions(module)
    sources: dict[str, Source] = {}
    seen: set[tuple[str, str]] = set()
    found: set[Path] = set()
    while todo:
        where, name = todo.pop()
        if (where, name) in seen or not where.startswith("neuprim."):
            continue
        seen.add((where, name))
        source = sources[where] = sources.get(where) or Source(where)
        if name in source.made_of:
            found.add(source.file)
            todo += [(where, other) for other in source.made_of[name]]
        elif name in source.imported:
            base, original = source.imported[name]
            whole = f"{base}.{original}"
            # of a module imported whole any name may be used
            todo += [(whole, n) for n in Source(whole).made_of] if whole in sys.modules else [(base, original)]
    return found
