"""Print the size of the code: lines, files, single-sibling imports, repeated module names, long parameter lists.

``python tools/size.py`` prints one table for this checkout; ``--list`` also names the files and functions that count.
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter, defaultdict
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
PACKAGE = CHECKOUT / "neuprim"
KERNEL_DECORATORS = ("njit", "jit", "kernel", "inline", "strict", "func", "overload", "vectorize")
MAX_PARAMETERS = 8


def count_lines(folder: Path) -> int:
    """Total lines of all Python files below ``folder``."""
    return sum(len(path.read_text().splitlines()) for path in folder.rglob("*.py"))


def imported_modules(path: Path) -> set[str]:
    """Full names of the modules of this package that the file at ``path`` imports."""
    package = list(path.relative_to(CHECKOUT).with_suffix("").parts)[:-1]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module or "") if part)
            names |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return {name for name in names if name.startswith("neuprim")}


def single_sibling_files() -> list[str]:
    """Files that exactly one file imports, where that file is in the same folder (or is a folder's ``__init__``)."""
    modules = {".".join(path.relative_to(CHECKOUT).with_suffix("").parts): path for path in PACKAGE.rglob("*.py")}
    importers: dict[str, set[str]] = defaultdict(set)
    for module, path in modules.items():
        for name in imported_modules(path):
            if name in modules and name != module:
                importers[name].add(module)
    single = []
    for module, path in modules.items():
        if path.name != "__init__.py" and len(importers[module]) == 1:
            (importer,) = importers[module]
            if modules[importer].parent == path.parent:
                single.append(str(path.relative_to(CHECKOUT)))
    return sorted(single)


def repeated_names() -> list[str]:
    """Files whose base name occurs more than once in the package (without ``__init__`` and ``__main__``)."""
    paths = [path for path in PACKAGE.rglob("*.py") if not path.name.startswith("__")]
    counts = Counter(path.name for path in paths)
    return sorted(str(path.relative_to(CHECKOUT)) for path in paths if counts[path.name] > 1)


def long_parameter_lists() -> list[str]:
    """Functions with more than eight parameters, without those that numba or Warp compiles."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not _is_kernel(node):
                arguments = node.args
                names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
                count = len([name for name in names if name not in ("self", "cls")])
                if count > MAX_PARAMETERS:
                    found.append(f"{path.relative_to(CHECKOUT)}:{node.lineno} {node.name} ({count})")
    return found


def _is_kernel(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(name in ast.unparse(decorator) for decorator in node.decorator_list for name in KERNEL_DECORATORS)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="name the files and functions that count")
    lists = {
        "files imported by exactly one sibling": single_sibling_files(),
        "modules whose base name is used more than once": repeated_names(),
        "functions with more than eight parameters, outside kernels": long_parameter_lists(),
    }
    rows = {
        "lines of neuprim/": count_lines(PACKAGE),
        "files of neuprim/": len(list(PACKAGE.rglob("*.py"))),
        **{name: len(found) for name, found in lists.items()},
        "lines of tests/": count_lines(CHECKOUT / "tests"),
        "lines of benchmarks/": count_lines(CHECKOUT / "benchmarks"),
    }
    arguments = parser.parse_args()
    for name, value in rows.items():
        print(f"{name:60} {value:7,}")
    if arguments.list:
        for name, found in lists.items():
            print(f"\n{name}", *found, sep="\n  ")


if __name__ == "__main__":
    main()
