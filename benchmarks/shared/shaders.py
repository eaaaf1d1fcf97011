"""Instructions of a page's fragment shader, counted in what a compiler leaves of it."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

__all__ = ["LISTEN", "instructions"]

LISTEN = """
globalThis.sources = [];
const give = WebGL2RenderingContext.prototype.shaderSource;
WebGL2RenderingContext.prototype.shaderSource = function (shader, text) {
  sources.push(text);
  return give.call(this, shader, text);
};
"""
"""Run before a page's own scripts: keeps the texts of its shaders in ``sources``."""

_TOOLS = ("glslangValidator", "spirv-opt", "spirv-dis")
_STATED = {
    "#version 300 es": "#version 450",
    "uniform int mode;": "const int mode = COLOUR;",
    "if (cut > tm - h)": "if (false)",
}
"""What is known of a chord that is drawn for its colour, away from the near plane."""

_FREE = frozenset(
    "Variable Load Store CompositeConstruct CompositeExtract CompositeInsert VectorShuffle CopyObject AccessChain Phi Label Branch SelectionMerge LoopMerge "
    "Function FunctionEnd Return ReturnValue Kill Unreachable".split()
)
"""What moves values or says where to go on: nothing that a card computes."""


def instructions(sources: Sequence[str]) -> dict[str, int] | None:
    """{arithmetic, texels} of one chord that is drawn for its colour; both sides of choices count. None without the
    compilers."""
    if not all(map(shutil.which, _TOOLS)):
        return None
    (text,) = {source for source in sources if "float profile(float v)" in source}
    for old, new in _STATED.items():
        if old not in text:
            raise ValueError(f"the page's fragment shader has no {old!r}")
        text = text.replace(old, new)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "splat.frag").write_text(text)
        for command in (
            ("glslangValidator", "-G", "--aml", "--amb", "-o", "whole.spv", "splat.frag"),
            ("spirv-opt", "-O", "whole.spv", "-o", "short.spv"),
            ("spirv-dis", "--raw-id", "short.spv", "-o", "short.txt"),
        ):
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.PIPE)
        return _counted((folder / "short.txt").read_text())


def _counted(assembly: str) -> dict[str, int]:
    """A component of a vector counts as one, a dot product as its components, a texel once."""
    width = {name: int(size) for name, size in re.findall(r"(%\S+) = OpTypeVector %\S+ (\d)", assembly)}
    kind = dict(re.findall(r"(%\S+) = Op\w+ (%\S+)", assembly))
    arithmetic = texels = 0
    for line in assembly[assembly.index("OpFunction ") :].splitlines():
        words = line.split()
        name = next((word[2:] for word in words if word.startswith("Op")), "")
        if not name or name in _FREE:
            continue
        if name == "ImageFetch":
            texels += 1
        elif name == "Dot":
            arithmetic += width[kind[words[4]]]
        else:
            arithmetic += width.get(words[3], 1) if words[1] == "=" else 1
    return {"arithmetic": arithmetic, "texels": texels}
