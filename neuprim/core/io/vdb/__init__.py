"""Read and write OpenVDB files with numpy, zlib and the package ``blosc``, without the OpenVDB library.

Every failure is a DataError that names the file, what was found and what was expected. Memory is allocated only for
data that a file's bytes can hold, whatever the file claims.
"""

from neuprim.core.io.vdb.grid import DENSE_LIMIT, Bounds, VdbGrid, VdbTiles, vdb_scale_transform
from neuprim.core.io.vdb.header import FileHeader, GridHeader, read_header
from neuprim.core.io.vdb.read import LEAF_LIMIT, VdbFrame, VdbSequence, list_vdb_files, read_grid, read_grids
from neuprim.core.io.vdb.write import COMPRESSIONS, write_vdb

__all__ = [
    "COMPRESSIONS",
    "DENSE_LIMIT",
    "LEAF_LIMIT",
    "Bounds",
    "FileHeader",
    "VdbGrid",
    "GridHeader",
    "VdbTiles",
    "VdbFrame",
    "VdbSequence",
    "read_grid",
    "read_grids",
    "read_header",
    "vdb_scale_transform",
    "list_vdb_files",
    "write_vdb",
]
