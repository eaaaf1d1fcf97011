"""Instructions of a compiled kernel, and of its loops, as ``nvdisasm`` lists them.

``nvdisasm`` is a program of CUDA's that needs no driver: ``pip install nvidia-cuda-nvdisasm``, or any CUDA toolkit.
"""

from __future__ import annotations

import re
import shutil
import site
import subprocess
from collections import Counter
from pathlib import Path

__all__ = ["Loop", "find_nvdisasm", "flops", "hot_loop", "listed"]

Loop = Counter[str]
"""Instructions by name, without what stands after the name's first dot."""

_LABEL, _LINE = re.compile(r"\s*(\.L_\w+):"), re.compile(r"/\*[0-9a-f]{4,}\*/\s+(.*?);")
_JUMP, _GUARD = re.compile(r"BRA.*`\((\.L_\w+)\)"), re.compile(r"@!?U?P\w+\s+")


def find_nvdisasm() -> str | None:
    """Of the environment's packages, else on the PATH; None where there is none."""
    roots = [Path(place) for place in site.getsitepackages()]
    found = [str(path) for root in roots for path in sorted(root.glob("nvidia/*/bin/nvdisasm"))]
    return found[0] if found else shutil.which("nvdisasm")


def listed(nvdisasm: str, cubin: Path) -> str:
    """What it prints of a cubin's code."""
    return subprocess.run([nvdisasm, "-c", str(cubin)], capture_output=True, text=True, check=True).stdout


def _name(instruction: str) -> str:
    return _GUARD.sub("", instruction).split()[0].split(".")[0]


def hot_loop(text: str, of: str) -> tuple[Loop, int]:
    """The innermost loop with the most instructions called ``of``, from the target of a backward jump to the jump; and
    how many there are in all.

    Raises:
        ValueError: no loop has any.
    """
    lines: list[str] = []
    labels: dict[str, int] = {}
    for line in text.splitlines():
        if label := _LABEL.match(line):
            labels[label[1]] = len(lines)
        if instruction := _LINE.search(line):
            lines.append(instruction[1])
    bodies = []
    for i, instruction in enumerate(lines):
        jump = _JUMP.search(instruction)
        if jump and labels.get(jump[1], i + 1) < i:
            bodies.append(Counter(_name(line) for line in lines[labels[jump[1]] : i + 1]))
    bodies = [body for body in bodies if body[of]]
    if not bodies:
        raise ValueError(f"no loop with {of}")
    most = max(body[of] for body in bodies)
    return min((body for body in bodies if body[of] == most), key=lambda body: body.total()), len(lines)


def flops(loop: Loop) -> int:
    """Floating-point operations: two for a multiplication with an addition."""
    return 2 * loop["FFMA"] + loop["FMUL"] + loop["FADD"]
