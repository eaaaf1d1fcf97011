"""Models in few bytes: codes of a few bits a number, the file that holds them, and the way back for every command.

``bits`` says how many, ``columns`` and ``rotations`` what a code stands for, ``order`` in which order primitives are,
``sections`` how codes become bytes, ``file`` how these lie on disk, ``codec`` how a model is taken apart.
"""

from neuprim.core.compression.bits import LEVELS, USUAL_LEVEL, BitTable, bit_table
from neuprim.core.compression.codec import (
    Schemes,
    Stored,
    bits_in_words,
    encode,
    file_order,
    folded,
    rounded,
    schemes,
    schemes_within,
)
from neuprim.core.compression.file import CONFIG, is_compressed, read_compressed, read_head, write_compressed
from neuprim.core.compression.sections import TEXT, Section

__all__ = [
    "CONFIG",
    "LEVELS",
    "TEXT",
    "USUAL_LEVEL",
    "BitTable",
    "Schemes",
    "Section",
    "Stored",
    "bit_table",
    "bits_in_words",
    "encode",
    "file_order",
    "folded",
    "is_compressed",
    "read_compressed",
    "read_head",
    "rounded",
    "schemes",
    "schemes_within",
    "write_compressed",
]
