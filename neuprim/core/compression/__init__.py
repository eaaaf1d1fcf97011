"""Quantized models in ``.neuprim`` files: ``codec`` turns models into sections, ``file`` reads and writes the
container."""

from neuprim.core.compression.codec import (
    Quantizers,
    StoredSize,
    canonical_model,
    encode_sections,
    fake_quantize,
    fit_quantizers,
    fit_quantizers_to_error,
    format_quantizer_bits,
    storage_order,
)
from neuprim.core.compression.file import CONFIG, is_compressed, read_compressed, read_model_header, write_compressed
from neuprim.core.compression.quantizers import DEFAULT_LEVEL, LEVELS, BitTable, bit_table
from neuprim.core.compression.sections import TEXT, CompressedSection

__all__ = [
    "CONFIG",
    "DEFAULT_LEVEL",
    "LEVELS",
    "TEXT",
    "BitTable",
    "Quantizers",
    "CompressedSection",
    "StoredSize",
    "bit_table",
    "canonical_model",
    "encode_sections",
    "fake_quantize",
    "fit_quantizers",
    "fit_quantizers_to_error",
    "format_quantizer_bits",
    "is_compressed",
    "read_compressed",
    "read_model_header",
    "storage_order",
    "write_compressed",
]
